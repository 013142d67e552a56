# SPDX-License-Identifier: Apache-2.0
"""Two clients send cells to one server: the store is that of both visits added here; bad clients leave nothing."""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam

from ggslam.errors import ConfigError
from ggslam.jobs.submaps.cell_server import CellServer, Sent, send_store
from ggslam.submaps.cell_messages import Kind, cell_to_body, receive_message, send_message, send_text
from ggslam.submaps.cell_points import POINTS, encode_points
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings

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
        CellServer(store, "127.0.0.1", 0, TOKEN) as server,
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
