# SPDX-License-Identifier: Apache-2.0
"""Two clients send cells to one server: the store is that of both visits added here; bad clients leave nothing."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from command_line import ggslam, refuse

from ggslam.errors import ConfigError
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS
from ggslam.jobs.submaps.cell_server import CellServer, Sent, address_of, listen, send_store, shown_address
from ggslam.localization.places import PLACES
from ggslam.localization.scan_places import SCAN_PLACES
from ggslam.localization.scan_views import CODE_BYTES
from ggslam.scene.arrays import arrays_to_bytes
from ggslam.submaps.cell_messages import (
    Kind,
    MessageTuning,
    cell_to_body,
    receive_message,
    send_message,
    send_text,
)
from ggslam.submaps.cell_points import POINTS, encode_points
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore, is_being_written
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.atomic import write_failure
from ggslam.system.tuning import overridden

TOKEN = "of the test"
SETTINGS = SubmapSettings(spacing=1.0)


def writes(first: int, last: int, at: float, seed: int) -> list[CellWrite]:
    """Cells `first` to `last` along x."""
    rng, found = np.random.default_rng(seed), []
    for x in range(first, last):
        points = (rng.random((200, 3)) - 0.5 + [x, 0, 0]).astype(np.float32)
        found.append(CellWrite((x, 0, 0), {POINTS: encode_points({"points": points})}, at, {POINTS: 200}))
    return found


def add(path: Path, visit: str, cells: list[CellWrite]) -> Path:
    """A visit is added to a store as recordings are: cells that are due."""
    store = GridStore.open(path, write=True) if path.exists() else GridStore.create(path, SETTINGS)
    with store:
        store.begin_visit(visit)
        store.put_cells([cell for cell in cells if store.due(cell.key, cell.recorded_at or 0.0)])
    return path


def content(path: Path) -> dict[tuple[int, int, int], object]:
    with GridStore.open(path) as store:
        assert list(store.problems()) == []
        records = {key: store.cell(key) for key in store.cells()}
        return {
            key: (r.visit, r.recorded_at, {name: (p.count, store.get(key, name)) for name, p in r.parts.items()})
            for key, r in records.items()
        }


@pytest.fixture
def server(tmp_path: Path) -> Iterator[CellServer]:
    with (
        GridStore.create(tmp_path / "server.grid", SETTINGS) as store,
        CellServer(store, listen("127.0.0.1", 0), TOKEN) as server,
    ):
        yield server


def test_two_clients_at_once_give_the_store_of_both_visits(tmp_path: Path, server: CellServer) -> None:
    cells = {"a": writes(0, 12, 100.0, 0), "b": writes(8, 20, 1000.0, 1)}  # 8 to 11 twice, b's over T later
    for name, own in cells.items():
        add(tmp_path / f"{name}.grid", name, own)
    expected = content(add(add(tmp_path / "both.grid", "a", cells["a"]), "b", cells["b"]))
    assert len(expected) == 20
    sent: dict[str, Sent] = {}

    def send(name: str) -> None:
        sent[name] = send_store(tmp_path / f"{name}.grid", *server.address, TOKEN)

    threads = [threading.Thread(target=send, args=(name,)) for name in cells]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert content(tmp_path / "server.grid") == expected
    assert sent["b"].written == 12 and sent["b"].kept == 0 and 8 <= sent["a"].written <= 12
    assert sent["a"].written + sent["a"].kept == 12
    assert sent["b"].bytes > sum(len(w.parts[POINTS]) for w in cells["b"])


def test_cells_are_sent_while_they_are_recorded(tmp_path: Path, server: CellServer) -> None:
    cells = writes(0, 6, 0.0, 0)
    with GridStore.create(tmp_path / "own.grid", SETTINGS) as store:
        store.begin_visit("a")
        store.put_cells(cells[:3])
        sender = threading.Thread(target=send_store, args=(tmp_path / "own.grid", *server.address, TOKEN))
        sender.start()
        wait_for(lambda: len(content(tmp_path / "server.grid")) == 3)
        store.put_cells([*writes(0, 1, 5.0, 9), *cells[3:]])  # one of them anew
        wait_for(lambda: len(content(tmp_path / "server.grid")) == 6)
        assert sender.is_alive()  # as long as somebody writes
    sender.join(20)
    assert not sender.is_alive() and content(tmp_path / "server.grid") == content(tmp_path / "own.grid")


def wait_for(happens: Callable[[], bool]) -> None:
    until = time.monotonic() + 30
    while not happens():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_client_that_dies_leaves_whole_cells(tmp_path: Path, server: CellServer) -> None:
    cells = writes(0, 3, 0.0, 0)
    with socket.create_connection(server.address) as connection:
        send_text(connection, Kind.HELLO, {"token": TOKEN, "spacing": 1.0, "axes": "xyz"})
        assert receive_message(connection) == (Kind.OK, b"{}")
        for cell in cells[:2]:
            send_message(connection, Kind.CELL, cell_to_body(cell, "cut"))
            receive_message(connection)
        body = cell_to_body(cells[2], "cut")
        connection.sendall(struct.pack("<4sBBII", b"GGSC", 1, 2, len(body), zlib.crc32(body)) + body[: len(body) // 2])
    with socket.create_connection(server.address) as connection:  # it serves the next one
        send_text(connection, Kind.HELLO, {"token": TOKEN, "spacing": 1.0, "axes": "xyz"})
        assert receive_message(connection) == (Kind.OK, b"{}")
    assert list(content(tmp_path / "server.grid")) == [(0, 0, 0), (1, 0, 0)]


GOOD = writes(0, 1, 0.0, 0)[0]
BODY = cell_to_body(GOOD, "bad")


def head(
    kind: int, body: bytes, magic: bytes = b"GGSC", version: int = 1, length: int | None = None, crc: int = 0
) -> bytes:
    size = len(body) if length is None else length
    return struct.pack("<4sBBII", magic, version, kind, size, crc or zlib.crc32(body)) + body


def cell(**changed: object) -> bytes:
    length = struct.unpack_from("<I", BODY)[0]
    text = json.dumps({**json.loads(BODY[4 : 4 + length]), **changed}).encode()
    return struct.pack("<I", len(text)) + text + BODY[4 + length :]


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (head(2, BODY, magic=b"HTTP"), "begins with"), (head(2, BODY, version=2), "version 2"),
        (head(9, BODY), "kind 9"), (head(2, b"", length=1 << 31, crc=1), "at most"),
        (head(2, BODY, crc=5), "checksum"), (head(1, b"{}"), "expected a cell"), (head(2, b""), "no JSON"),
        (head(2, b"\xff" * 64), "no JSON"), (head(2, cell(key=[0, 0, 2**40])), "no cell"),
        (head(2, cell(key=[0, 0])), "no cell"), (head(2, cell(visit="")), "no cell"),
        (head(2, cell(recorded_at="x")), "no cell"), (head(2, cell(parts=[])), "no cell"),
        (head(2, cell(parts=[["../x", len(GOOD.parts[POINTS]), 1]])), "no cell"),
        (head(2, cell(parts=[[POINTS, 5, 1]])), "bytes"), (head(2, BODY + b"more"), "bytes"),
        (head(2, cell_to_body(CellWrite((0, 0, 0), {POINTS: b"no points"}, 0.0), "bad")), "cell (0, 0, 0)"),
    ],
)  # fmt: skip
def test_a_bad_message_is_refused_and_leaves_nothing(
    message: bytes, reason: str, tmp_path: Path, server: CellServer
) -> None:
    with socket.create_connection(server.address, 10) as connection:
        send_text(connection, Kind.HELLO, {"token": TOKEN, "spacing": 1.0, "axes": "xyz"})
        receive_message(connection)
        connection.sendall(message)
        answer = receive_message(connection)
    assert answer is not None and answer[0] is Kind.REFUSED and reason in answer[1].decode()
    assert content(tmp_path / "server.grid") == {}
    with GridStore.open(tmp_path / "server.grid") as store:
        assert store.visits() == []


def test_other_tokens_and_grids_are_refused(tmp_path: Path, server: CellServer) -> None:
    own = add(tmp_path / "own.grid", "a", writes(0, 2, 0.0, 0))
    with pytest.raises(ConfigError, match="token"):
        send_store(own, *server.address, "guessed")
    GridStore.create(tmp_path / "other.grid", SubmapSettings(spacing=2.0)).close()
    with pytest.raises(ConfigError, match="spacing"):
        send_store(tmp_path / "other.grid", *server.address, TOKEN)
    assert content(tmp_path / "server.grid") == {}
    assert send_store(own, *server.address, TOKEN).written == 2


def test_the_command_sends_and_tells_who_does_not_listen(tmp_path: Path, server: CellServer) -> None:
    own, (host, port) = add(tmp_path / "own.grid", "a", writes(0, 2, 0.0, 0)), server.address
    done = ggslam("submaps", own, "--send", f"{host}:{port}", "--token", TOKEN)
    assert done.returncode == 0 and "2 cells written" in done.stdout, done.stderr
    assert content(tmp_path / "server.grid") == content(own)
    for words, reason in ((("--send", "nowhere"), "HOST:PORT"), (("--send", f"{host}:{port}"), "token")):
        done = ggslam("submaps", own, *words)
        assert done.returncode == 2 and reason in done.stderr


def test_the_command_serves_until_ctrl_c_and_a_killed_client_leaves_whole_cells(tmp_path: Path) -> None:
    own = add(tmp_path / "own.grid", "a", writes(0, 30, 0.0, 0))
    command = [sys.executable, "-m", "ggslam", "submaps"]
    serve = [*command, str(tmp_path / "new.grid"), "--serve", "0", "--token", TOKEN, "--spacing", "1"]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            port = line.split(" cells at 127.0.0.1:")[1].split()[0]
            send = [*command, str(own), "--send", port, "--token", TOKEN]
            with subprocess.Popen(send, stdout=subprocess.DEVNULL) as client:
                wait_for(lambda: len(content(tmp_path / "new.grid")) > 0)
                client.kill()
            left = content(tmp_path / "new.grid")
            assert left.items() <= content(own).items()
            done = ggslam("submaps", own, "--send", port, "--token", TOKEN)
            assert done.returncode == 0, done.stderr
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    assert content(tmp_path / "new.grid") == content(own)


# --- what clients may not do -----------------------------------------------------------------------------------------


def greeted(server: CellServer) -> socket.socket:
    """A connection that told the token."""
    connection = socket.create_connection(server.address, 10)
    send_text(connection, Kind.HELLO, {"token": TOKEN, "spacing": 1.0, "axes": "xyz"})
    assert receive_message(connection) == (Kind.OK, b"{}")
    return connection


def points(*rows: list[float], kind: type = np.float32) -> bytes:
    return encode_points({"points": np.array(rows, kind)})


def gaussians(count: int = 3, **changed: np.ndarray) -> bytes:
    arrays = {
        "means": np.zeros((count, 3), "f4"), "quaternions": np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        "log_scales": np.zeros((count, 3), "f4"), "opacity_logits": np.zeros(count, "f4"),
        "sh": np.zeros((count, 1, 3), "f4"), "features": np.zeros((count, 0), "f4"),
        "object_id": np.zeros(count, "i4"), **changed,
    }  # fmt: skip
    return arrays_to_bytes(**arrays)


POSES, FAR_POSES = np.eye(4)[None], np.eye(4)[None] + np.pad([[5.0]], ((0, 3), (3, 0)))


def places(poses: np.ndarray = POSES) -> bytes:
    return arrays_to_bytes(
        poses=poses, counts=np.zeros(1, "i4"), codes=np.zeros((1, 8), "u1"), descriptors=np.zeros((0, 32), "u1"),
        points=np.zeros((0, 3), "f4"), camera=np.ones(6),
    )  # fmt: skip


def scan_places(x: float = 0.0) -> bytes:
    return arrays_to_bytes(
        positions=np.array([[x, 0, 0]]), floors=np.zeros(1, "f4"), codes=np.zeros((1, CODE_BYTES), "u1")
    )


NAN = float("nan")


@pytest.mark.parametrize(
    ("part", "data", "count", "at", "reason"),
    [
        (POINTS, points([0, 0, 0]), 1, 1e308, "no cell"), (POINTS, points([0, 0, 0]), 1, -1.1e15, "no cell"),
        ("index.sqlite", b"x", 1, 0.0, "no part"), ("p.bin", b"x", 1, 0.0, "no part"),
        (PLACES, b"x", 1, 0.0, PLACES), (SCAN_PLACES, b"x", 1, 0.0, SCAN_PLACES),
        (POINTS, points([NAN, 0, 0]), 1, 0.0, "finite"), (POINTS, points([0, 0, 0]), 2**31 - 1, 0.0, "things"),
        (POINTS, points([1000, 0, 0]), 1, 0.0, "outside"), (POINTS, points([0, -1000, 0]), 1, 0.0, "outside"),
        (POINTS, points([1e30, 0, 0], kind=np.float64), 1, 0.0, "outside"),
        (GAUSSIANS, gaussians(), 4, 0.0, "things"),
        (GAUSSIANS, gaussians(means=np.full((3, 3), 9, "f4")), 3, 0.0, "outside"),
        (GAUSSIANS, gaussians(log_scales=np.full((3, 3), NAN, "f4")), 3, 0.0, "finite"),
        (GAUSSIANS, gaussians(quaternions=np.ones((1, 4), "f4")), 3, 0.0, "quaternions"),
        (PLACES, places(), 2, 0.0, "things"), (PLACES, places(FAR_POSES), 1, 0.0, "outside"),
        (SCAN_PLACES, scan_places(), 2, 0.0, "things"), (SCAN_PLACES, scan_places(5.0), 1, 0.0, "outside"),
    ],
)  # fmt: skip
def test_what_is_no_cell_is_refused_and_leaves_nothing(
    part: str, data: bytes, count: int, at: float, reason: str, tmp_path: Path, server: CellServer
) -> None:
    with greeted(server) as connection:
        write = CellWrite((0, 0, 0), {part: data}, at, {part: count})
        send_message(connection, Kind.CELL, cell_to_body(write, "bad"))
        answer = receive_message(connection)
    assert answer is not None and answer[0] is Kind.REFUSED and reason in answer[1].decode(), answer
    assert content(tmp_path / "server.grid") == {}
    with GridStore.open(tmp_path / "server.grid") as store:
        assert store.visits() == []


def test_what_cells_have_is_taken(tmp_path: Path, server: CellServer) -> None:
    seen = points([-80, 20, 0], [0, 0, 0])
    parts = {POINTS: seen, GAUSSIANS: gaussians(), PLACES: places(), SCAN_PLACES: scan_places()}
    counts = {POINTS: 2, GAUSSIANS: 3, PLACES: 1, SCAN_PLACES: 1}
    own = add(tmp_path / "own.grid", "a", [CellWrite((0, 0, 0), parts, 5.0, counts)])
    assert send_store(own, *server.address, TOKEN).written == 1
    assert content(tmp_path / "server.grid") == content(own)


@pytest.mark.parametrize("at", [1e308, float("inf"), NAN])
def test_a_store_refuses_a_time_that_it_could_not_read_again(tmp_path: Path, at: float) -> None:
    with GridStore.create(tmp_path / "a.grid", SETTINGS) as store:
        with pytest.raises(ConfigError, match="recorded_at"):
            store.put((0, 0, 0), {POINTS: points([0, 0, 0])}, at)
        store.put((0, 0, 0), {POINTS: points([0, 0, 0])}, np.float64(3))
    assert content(tmp_path / "a.grid")[0, 0, 0] is not None


def test_no_large_body_is_read_before_the_token_was_told(server: CellServer) -> None:
    with socket.create_connection(server.address, 10) as connection:
        connection.sendall(head(Kind.CELL, b"", length=1 << 27, crc=1))
        answer = receive_message(connection)
    assert answer is not None and answer[0] is Kind.REFUSED and "HELLO" in answer[1].decode()


def test_silent_connections_do_not_keep_an_honest_client_waiting(tmp_path: Path, server: CellServer) -> None:
    own = add(tmp_path / "own.grid", "a", writes(0, 2, 0.0, 0))
    with ExitStack() as silent:
        for _ in range(17):
            silent.enter_context(socket.create_connection(server.address, 10))
        begin = time.monotonic()
        assert send_store(own, *server.address, TOKEN).written == 2
    assert time.monotonic() - begin < 15


def test_a_client_that_dribbles_is_let_go(server: CellServer) -> None:
    with overridden(MessageTuning, timeout_s=0.5), greeted(server) as connection:
        message, begin = head(Kind.CELL, BODY), time.monotonic()
        with pytest.raises(OSError):
            for byte in message[:100]:
                connection.sendall(bytes([byte]))
                time.sleep(0.1)
    assert time.monotonic() - begin < 8


@pytest.mark.parametrize("begun", [0, 4, 50])
def test_the_server_ends_at_once_and_tells_its_clients(tmp_path: Path, begun: int) -> None:
    store = GridStore.create(tmp_path / "server.grid", SETTINGS)
    with store, ExitStack() as clients:
        with CellServer(store, listen("127.0.0.1", 0), TOKEN) as server:
            clients.enter_context(socket.create_connection(server.address, 10))  # says nothing
            waiting = clients.enter_context(greeted(server))
            waiting.sendall(head(Kind.CELL, BODY)[:begun])
            time.sleep(0.3)
            begin = time.monotonic()
        assert time.monotonic() - begin < 8
        answer = receive_message(waiting)
    assert answer is not None and answer[0] is Kind.REFUSED and "the server ends" in answer[1].decode()


def test_a_number_in_the_lock_is_not_taken_for_a_writer(tmp_path: Path, server: CellServer) -> None:
    own = add(tmp_path / "own.grid", "a", writes(0, 2, 0.0, 0))
    (own / "lock").write_text(str(os.getpid()))  # of a writer that was killed: another process has its number now
    assert not is_being_written(own)
    sender = threading.Thread(target=send_store, args=(own, *server.address, TOKEN), daemon=True)
    sender.start()
    sender.join(20)
    assert not sender.is_alive()
    with GridStore.open(own, write=True):
        assert is_being_written(own)


def test_of_cells_with_one_name_of_a_visit_the_newer_one_stays(tmp_path: Path, server: CellServer) -> None:
    new = add(tmp_path / "new.grid", "part", writes(0, 2, 50.0, 0))
    old = add(tmp_path / "old.grid", "part", writes(0, 3, 20.0, 1))
    assert send_store(new, *server.address, TOKEN).written == 2
    sent = send_store(old, *server.address, TOKEN)
    assert (sent.written, sent.kept) == (1, 2)
    kept = content(tmp_path / "server.grid")
    assert {key: kept[key] for key in content(new)} == content(new)
    assert send_store(new, *server.address, TOKEN).written == 2  # the same once more


def test_a_full_disk_of_the_server_is_not_the_clients_fault(
    tmp_path: Path, server: CellServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, put_cells = add(tmp_path / "own.grid", "a", writes(0, 5, 0.0, 0)), GridStore.put_cells

    def full(store: GridStore, cells: list[CellWrite]) -> None:
        if len(store.cells()) == 3:
            raise write_failure(store.path, OSError(errno.ENOSPC, "No space left on device"))
        put_cells(store, cells)

    monkeypatch.setattr(GridStore, "put_cells", full)
    done = ggslam("submaps", own, "--send", f"127.0.0.1:{server.address[1]}", "--token", TOKEN)
    assert done.returncode == 1 and "No space left" in done.stderr and "3 cells written before" in done.stderr, done


def test_a_bad_address_leaves_no_store(tmp_path: Path, server: CellServer) -> None:
    for address in ("nowhere", f"127.0.0.1:{server.address[1]}", "1:2:3", "[::1", "256.1.1.1.1:5"):
        done = ggslam("submaps", tmp_path / "new.grid", "--serve", address, "--token", TOKEN)
        assert done.returncode == 2 and not (tmp_path / "new.grid").exists(), done


def test_addresses_with_colons_stand_in_brackets(tmp_path: Path) -> None:
    assert address_of("[::1]:7102") == ("::1", 7102) and address_of("7102") == ("127.0.0.1", 7102)
    assert shown_address("::1", 7102) == "[::1]:7102" and address_of("a.b:1") == ("a.b", 1)
    try:
        listener = listen("::1", 0)
    except ConfigError:
        pytest.skip("this machine has no IPv6")
    own = add(tmp_path / "own.grid", "a", writes(0, 2, 0.0, 0))
    with GridStore.create(tmp_path / "six.grid", SETTINGS) as store, CellServer(store, listener, TOKEN) as server:
        done = ggslam("submaps", own, "--send", shown_address(*server.address), "--token", TOKEN)
        assert done.returncode == 0 and "2 cells written" in done.stdout, done


@pytest.mark.parametrize(
    ("option", "others"),
    [
        ("--serve", ["--visit", "a"]), ("--serve", ["--since", "a"]), ("--serve", ["--json"]),
        ("--serve", ["--scale", "0.5"]), ("--serve", ["--body", "x.urdf"]), ("--send", ["--spacing", "2"]),
        ("--send", ["--visit", "a"]), ("--send", ["--set", "submaps.spacing=2"]), ("--send", ["--at", "3"]),
    ],
)  # fmt: skip
def test_options_without_effect_are_refused(tmp_path: Path, option: str, others: list[str]) -> None:
    done = ggslam("submaps", tmp_path / "new.grid", option, "127.0.0.1:0", "--token", TOKEN, *others)
    refuse(done, option, others[0], "cannot go with it")
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "new.grid").exists()


def test_a_store_is_served_again_with_its_own_cells(tmp_path: Path) -> None:
    GridStore.create(tmp_path / "own.grid", SubmapSettings(spacing=3.0, refresh=7.0)).close()
    with mock.patch("ggslam.jobs.view.serve.wait_for_interrupt") as waits:
        done = ggslam("submaps", tmp_path / "own.grid", "--serve", "0", "--token", TOKEN, "--radius", "2")
    assert done.returncode == 0 and waits.called, done
