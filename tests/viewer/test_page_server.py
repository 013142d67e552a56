# SPDX-License-Identifier: Apache-2.0
"""The page's server, asked over HTTP: what is shown, edits, two pages at once, pages that read slowly or are gone."""

from __future__ import annotations

import base64
import http.client
import json
import shutil
import socket
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ggslam.errors import ConfigError
from ggslam.jobs.view.serve import serve_run
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder
from ggslam.runs.verification import verify_run
from ggslam.system.tuning import overridden
from ggslam.viewer.page_requests import RequestTuning
from ggslam.viewer.page_server import PageServer

MAX_SPLATS = 3000


class Page:
    """A page, as a browser asks for it."""

    def __init__(self, server: PageServer) -> None:
        self._server, self._query = server, urlsplit(server.address).query

    def ask(self, method: str, path: str, values: Any = None) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self._server.port, timeout=60)
        body = None if values is None else json.dumps(values)
        separator = "&" if "?" in path else "?"
        connection.request(method, f"{path}{separator}{self._query}", body, {"Host": f"localhost:{self._server.port}"})
        return connection.getresponse()

    def get(self, path: str) -> bytes:
        answer = self.ask("GET", path)
        assert answer.status == 200, (path, answer.read())
        return answer.read()

    def scene(self) -> dict[str, Any]:
        return json.loads(self.get("/scene"))

    def post(self, action: str, values: Any, method: str = "POST") -> Any:
        answer = self.ask(method, f"/{action}", values)
        assert answer.status == 200
        content = answer.read()
        return json.loads(content) if answer.headers["Content-Type"] == "application/json" else content


@pytest.fixture
def served(run: RunFolder, tmp_path: Path) -> Iterator[tuple[PageServer, ViewedRun]]:
    copy = RunFolder(Path(shutil.copytree(run.path, tmp_path / "room")))
    server, model = serve_run(copy, port=0, max_splats=MAX_SPLATS)
    yield server, model
    server.close()


def objects(*ids: int) -> list[dict[str, Any]]:
    return [{"mode": "set", "shape": {"kind": "objects", "ids": list(ids)}}]


def sphere(center: Any, radius: float) -> list[dict[str, Any]]:
    return [{"mode": "set", "shape": {"kind": "sphere", "center": list(map(float, center)), "radius": radius}}]


def test_what_a_page_is_shown(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    page = Page(server)
    scene = page.scene()
    assert [o["id"] for o in scene["objects"]] == [o.id for o in model.objects()]
    assert scene["chunks"][0]["count"] == MAX_SPLATS and scene["editable"] and not scene["live"]
    assert abs(scene["floor"]["height"] - model.floor) < 1e-9 if scene["floor"]["found"] else model.floor is None
    data = page.get("/splats?chunk=map&level=0")
    size = struct.unpack("<I", data[:4])[0]
    header = json.loads(data[4 : 4 + size])
    columns = np.frombuffer(zlib.decompress(data[4 + size :]), np.uint8).reshape(-1, header["count"]).astype(float)
    centers = np.array(header["low"]) + (columns[0:6:2] + 256 * columns[1:6:2]).T / 65535 * np.subtract(
        header["high"], header["low"])  # fmt: skip
    assert np.abs(centers - model.centers()).max() < 1e-3
    picture = cv2.imdecode(np.frombuffer(page.get("/frame?number=0"), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape[1] > 300
    assert b"<canvas" in page.get("/") and page.ask("GET", "/nothing").status == 404
    assert page.ask("GET", "/frame?number=99999").status == 409


def test_a_selection_is_of_all_gaussians_and_told_of_those_shown(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    record = model.objects()[1]
    answer = Page(server).post("select", {"selection": sphere(record.centroid, 0.4)})
    means = model.gaussians().means.numpy().astype(float)
    expected = ((means - record.centroid) ** 2).sum(1) <= 0.4**2
    bits = np.unpackbits(np.frombuffer(base64.b64decode(answer["bits"]), np.uint8), bitorder="little")[:MAX_SPLATS]
    assert answer["count"] == expected.sum() > answer["shown"] == bits.sum()
    assert np.array_equal(bits.astype(bool), expected[model.shown_rows()])


def test_edits_undo_redo_and_save(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    page, count = Page(server), len(model.gaussians())
    first, second = model.objects()[0].id, model.objects()[1]
    whole = page.post("edit", {"kind": "remove", "selection": objects(first)})
    assert first not in [o["id"] for o in page.scene()["objects"]] and len(whole["edits"]) == 1
    part = page.post("edit", {"kind": "remove", "selection": sphere(second.centroid, 0.1)})
    left = len(model.gaussians())
    assert part["edits"][1].startswith("removed ") and left < count
    assert page.post("undo", {})["redo"] == 1 and len(model.gaussians()) > left
    assert page.post("redo", {})["redo"] == 0 and len(model.gaussians()) == left
    page.post("edit", {"kind": "recolor", "selection": sphere(second.centroid, 0.3), "color": "#ff0000"})
    part_of_it = sphere(second.centroid, 0.3)
    made = page.post("edit", {"kind": "assign", "selection": part_of_it, "object": "new", "name": "odd"})
    new = next(o for o in page.scene()["objects"] if o["name"] == "odd")
    assert "odd" in made["edits"][-1] and new["gaussians"] > 0
    T = np.eye(4)
    T[:3, 3] = [0.5, 0, 0]
    before = np.array(new["centroid"])
    page.post("edit", {"kind": "move", "selection": objects(new["id"]), "T": T.ravel().tolist()})
    moved = next(o for o in page.scene()["objects"] if o["id"] == new["id"])
    assert np.allclose(np.array(moved["centroid"]) - before, [0.5, 0, 0], atol=0.02)
    said = page.post("save", {"target": "saved", "inpaint": False})["text"]
    saved = RunFolder.open(model.save_folder() / "saved")
    assert str(saved.path) in said and verify_run(saved.path).good
    assert saved.object_table().record(new["id"]).name == "odd"
    shown, kept = model.gaussians().means.numpy(), saved.gaussians().means.numpy()
    distance = cKDTree(shown).query(kept)[0]
    assert distance.max() < 1e-4 and 0 <= len(shown) - len(kept) < 0.01 * count  # traces of the object go, too
    assert len(saved.mark().edits) == 5


def test_a_crop_keeps_what_lies_in_the_box(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    box = {"kind": "box", "center": [0, 0, 2.0], "axes": np.eye(3).tolist(), "size": [2.0, 4.0, 2.0]}
    inside = (np.abs(model.gaussians().means.numpy() - [0, 0, 2]) <= [1, 2, 1]).all(1).sum()
    Page(server).post("edit", {"kind": "keep", "selection": [{"mode": "set", "shape": box}]})
    assert len(model.gaussians()) == inside
    assert sum(o.gaussians for o in model.objects()) <= inside


WRONG: tuple[tuple[str, Any, str], ...] = (
    ("edit", {}, "selection: expected"),
    ("edit", {"kind": "x", "selection": objects(1)}, "edit: expected"), ("edit", {"kind": "remove"}, "selection"),
    ("edit", [], "expected an object"),
    ("edit", {"kind": "remove", "selection": sphere([99, 99, 99], 0.1)}, "nothing is selected"),
    ("edit", {"kind": "remove", "selection": [{"mode": "set", "shape": {"kind": "all"}}]}, "all of the map"),
    ("edit", {"kind": "rename", "object": 1}, "name: expected a text"),
    ("edit", {"kind": "rename", "object": 60000, "name": "x"}, "60000"),
    ("edit", {"kind": "move", "selection": objects(1), "T": [1] * 16}, "rigid"),
    ("edit", {"kind": "move", "selection": objects(1), "T": [10**400, *np.eye(4).ravel().tolist()[1:]]}, "rigid"),
    ("edit", {"kind": "recolor", "selection": objects(1), "color": "url(x)"}, "color"),
    ("picture", {"width": 64, "height": 48, "focal": 10**400}, "focal"),
    ("undo", {}, "no edit"), ("redo", {}, "no edit"), ("save", {"target": "x"}, "nothing was edited"),
    ("picture", {"width": 10**9, "height": 10}, "picture"), ("export", {"object": 60000}, "60000"),
    ("annotations", {"annotations": [{"point": [0, 0], "text": "x"}]}, "annotations.0.point"),
    ("camera-keys", {"keys": [{"time": "x"}]}, "camera_keys.json"), ("shutdown", {}, "cannot ask"),
)  # fmt: skip


@pytest.mark.parametrize(("action", "values", "told"), WRONG, ids=range(len(WRONG)))
def test_what_cannot_be_done_is_told_and_changes_nothing(
    served: tuple[PageServer, ViewedRun], action: str, values: Any, told: str
) -> None:
    server, model = served
    before = model.gaussians().means.numpy().copy()
    assert told in Page(server).post(action, values)["error"]
    assert np.array_equal(model.gaussians().means.numpy(), before) and not model.edits()


def test_notes_and_keys_are_kept_beside_the_run(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    page, text = Page(server), "<b>mug</b> \u2028 \x1b[2J"
    page.post("annotations", {"annotations": [{"point": [0.1, 0.2, 0.3], "text": text}]}, "PUT")
    key = {"time": 0.0, "position": [0, 0, 0], "look_at": [0, 0, 1], "up": [0, -1, 0], "fov": 1.0}
    page.post("camera-keys", {"fps": 30, "keys": [key, {**key, "time": 2}]}, "PUT")
    scene = page.scene()
    assert scene["annotations"] == [{"point": [0.1, 0.2, 0.3], "text": text}] and len(scene["camera_keys"]) == 2
    assert verify_run(model.folder.path).good
    page.post("edit", {"kind": "rename", "object": model.objects()[0].id, "name": "thing"})
    page.post("save", {"target": "noted"})
    kept = json.loads((model.save_folder() / "noted" / "annotations.json").read_text())
    assert kept["annotations"][0]["text"] == text
    (model.folder.path / "annotations.json").write_text("{" * 1000)
    assert page.scene()["annotations"] == []
    (model.folder.path / "annotations.json").write_text('{"annotations": [], "more": ' + "[" * 900 + "]" * 900 + "}")
    assert page.scene()["annotations"] == []


def test_several_objects_move_as_one_group(served: tuple[PageServer, ViewedRun]) -> None:
    """Also what they turn about, and that they leave holes, is as `ggslam edit` has it."""
    server, model = served
    ids = [o.id for o in model.objects()][1:3]
    owners = model.gaussians().object_id.numpy()
    before = model.gaussians().means.numpy()[np.isin(owners, ids)].astype(float)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [0.3, 0.0, -0.2]
    Page(server).post("edit", {"kind": "move", "selection": objects(*ids), "T": T.ravel().tolist()})
    assert [(e.kind, e.objects, e.selection) for e in model._edits] == [("move", ",".join(map(str, ids)), "")]
    distance = cKDTree(model.gaussians().means.numpy()).query(before @ T[:3, :3].T + T[:3, 3])[0]
    assert np.mean(distance < 1e-4) > 0.98  # floaters stay


@pytest.mark.parametrize("headers", ["Content-Length: " + "9" * 5000, "Content-Length: 2\r\nContent-Length: 3"])
def test_lengths_that_are_none(served: tuple[PageServer, ViewedRun], headers: str) -> None:
    server, model = served
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        path = f"/edit?{urlsplit(server.address).query}"
        connection.sendall(f"POST {path} HTTP/1.1\r\nHost: localhost:{server.port}\r\n{headers}\r\n\r\n".encode())
        assert connection.recv(100).split()[1] in (b"411", b"413")


def test_a_request_that_drips_is_cut_off(served: tuple[PageServer, ViewedRun]) -> None:
    server, _ = served
    with overridden(RequestTuning, request_s=1.0), socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.settimeout(20)
        connection.sendall(b"GET / HTTP/1.1\r\n")
        start = time.monotonic()
        with pytest.raises(ConnectionError):
            while time.monotonic() - start < 15:
                connection.sendall(b"X: y\r\n")
                time.sleep(0.1)
    assert Page(server).ask("GET", "/").status == 200


def test_messages_are_not_nested_without_end(served: tuple[PageServer, ViewedRun]) -> None:
    values: Any = 1
    for _ in range(900):
        values = [values]
    assert Page(served[0]).ask("POST", "/annotations", {"annotations": values}).status == 400


def test_pictures_and_files(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    page, T = Page(server), model.frame_poses[0]
    ask = {"width": 320, "height": 200, "focal": 200.0, "T_world_camera": T.ravel().tolist(), "hidden": []}
    picture = cv2.imdecode(np.frombuffer(page.post("picture", ask), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (200, 320, 3) and picture.std() > 10
    everything = [0, *(o.id for o in model.objects())]
    black = cv2.imdecode(np.frombuffer(page.post("picture", {**ask, "hidden": everything}), np.uint8), cv2.IMREAD_COLOR)
    assert black is not None and black.max() == 0
    answer = page.ask("GET", f"/export?object={model.objects()[0].id}")
    assert answer.read().startswith(b"ply") and "attachment" in answer.headers["Content-Disposition"]


def events(server: PageServer) -> socket.socket:
    listening = socket.create_connection(("127.0.0.1", server.port), timeout=20)
    query = urlsplit(server.address).query
    listening.sendall(f"GET /events?{query} HTTP/1.1\r\nHost: localhost:{server.port}\r\n\r\n".encode())
    text = b""
    while b"connected" not in text:
        text += listening.recv(4096)
    return listening


def test_every_page_hears_what_another_did(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    with events(server) as one, events(server) as other:
        assert server.watchers == 2
        Page(server).post("edit", {"kind": "rename", "object": model.objects()[0].id, "name": "thing"})
        for listening in (one, other):
            news = json.loads(listening.recv(4096).decode().split("data: ")[1])
            assert news == {"what": ["scene", "splats"], "version": 1}
    end = time.monotonic() + 20
    while server.watchers and time.monotonic() < end:  # it is noticed when something is told
        server.tell("text")
        time.sleep(0.05)
    assert server.watchers == 0


def test_a_page_that_reads_nothing_costs_nothing(served: tuple[PageServer, ViewedRun]) -> None:
    server, _ = served
    with events(server):
        began = time.monotonic()
        for k in range(20_000):
            server.tell("text", text=f"{k}" * 100)
        assert time.monotonic() - began < 20
        assert Page(server).scene()["title"] == "room"


def test_one_of_two_saves_to_one_name_is_told_so(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    page = Page(server)
    page.post("edit", {"kind": "rename", "object": model.objects()[0].id, "name": "thing"})
    for target in (".hidden", "-rf", ".."):
        assert "a name is needed" in page.post("save", {"target": target})["error"]
    answers: list[Any] = []
    save = [threading.Thread(target=lambda: answers.append(page.post("save", {"target": "twice"}))) for _ in range(3)]
    for thread in save:
        thread.start()
    for thread in save:
        thread.join()
    assert sorted("text" in answer for answer in answers) == [False, False, True]


def test_pages_edit_in_turn(served: tuple[PageServer, ViewedRun]) -> None:
    server, model = served
    ids, said = [o.id for o in model.objects()[:6]], list[Any]()

    def remove(object_id: int) -> None:
        said.append(Page(server).post("edit", {"kind": "remove", "selection": objects(object_id)}))

    threads = [threading.Thread(target=remove, args=(i,)) for i in ids]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(model.edits()) == 6 and not set(ids) & {o.id for o in model.objects()}
    assert sorted(len(answer["edits"]) for answer in said) == [1, 2, 3, 4, 5, 6]


def test_a_taken_port_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match="`port`"):
            PageServer(port=taken.getsockname()[1])


def test_only_this_machine_can_connect() -> None:
    server = PageServer(port=0)
    try:
        assert server.host == "127.0.0.1" and server.address.startswith("http://localhost:")
    finally:
        server.close()
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", server.port), timeout=2)


@pytest.mark.parametrize("host", ["", "nonsense.invalid", "8.8.8.8"])
def test_an_address_of_elsewhere_is_told(host: str) -> None:
    with pytest.raises(ConfigError, match="`host`"):
        PageServer(host, 0)
