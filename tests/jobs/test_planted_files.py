# SPDX-License-Identifier: Apache-2.0
"""Pipes, devices, sockets and folders where files are expected, given or planted: no command waits for them, each says
in one line what is wrong."""

from __future__ import annotations

import os
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Done, ggslam

from ggslam.runs.folder import RunFolder
from ggslam.runs.records.changes import ChangeRecord, ChangesRecord

SECONDS = 10
"""That a command may take, with other processes beside it: reading a pipe takes for ever."""


def bind(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's name may have 107 bytes
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def link_to_pipe(path: Path) -> None:
    os.mkfifo(path.with_name("a-pipe"))
    path.symlink_to("a-pipe")


STRANGE: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo, "device": lambda path: path.symlink_to("/dev/zero"), "socket": bind, "folder": Path.mkdir,
    "linked pipe": link_to_pipe,
}  # fmt: skip


@contextmanager
def in_time() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise AssertionError(f"waited for {SECONDS} s")

    former = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


def refusal(*words: object) -> str:
    """The one line with which a command refuses."""
    with in_time():
        done: Done = ggslam(*words)
    errors = [line for line in done.stderr.splitlines() if "error:" in line]
    assert done.returncode == 2 and len(errors) == 1 and "Traceback" not in done.stderr, done
    return errors[0]


def plant(kind: str, path: Path) -> Path:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    STRANGE[kind](path)
    return path


GIVEN: dict[str, tuple[str, ...]] = {
    "run": ("run", "X", "--out", "OUT"), "run --map": ("run", "ROOM", "--out", "OUT", "--map", "X"),
    "run --config": ("run", "ROOM", "--out", "OUT", "--config", "X"),
    "run --camera": ("run", "ROOM", "--out", "OUT", "--camera", "X"),
    "run --depth-camera": ("run", "ROOM", "--out", "OUT", "--depth-camera", "X"),
    "run --masks": ("run", "ROOM", "--out", "OUT", "--masks", "X"), "run --resume": ("run", "--resume", "X"),
    "eval": ("eval", "X"), "eval --sequence": ("eval", "RUN", "--sequence", "X"), "render": ("render", "X"),
    "export": ("export", "X", "--out", "OUT.ply"), "batch": ("batch", "X", "--out", "OUT"), "report": ("report", "X"),
    "changes OLD": ("changes", "X", "RUN", "--out", "OUT"), "changes NEW": ("changes", "RUN", "X", "--out", "OUT"),
    "compare A": ("compare", "X", "RUN"), "compare B": ("compare", "RUN", "X"),
    "edit": ("edit", "X", "--remove", "1", "--out", "OUT"), "encode": ("encode", "X", "OUT.bin"),
    "decode": ("decode", "X", "OUT.ply"), "localize MAP": ("localize", "X", "ROOM"),
    "localize SEQUENCE": ("localize", "RUN", "X"), "merge": ("merge", "X", "RUN", "--out", "OUT"),
    "refine": ("refine", "X"), "submaps": ("submaps", "X"), "submaps --out": ("submaps", "X", "--out", "OUT"),
    "update OLD": ("update", "X", "RUN", "--out", "OUT"), "update NEW": ("update", "RUN", "X", "--out", "OUT"),
    "view": ("view", "X", "--html", "OUT.html"), "view --changes": ("view", "RUN", "--changes", "X"),
    "volumes": ("volumes", "X", "--out", "OUT"), "verify": ("verify", "X"), "inspect": ("inspect", "X"),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["pipe", "device", "socket"])
@pytest.mark.parametrize("words", GIVEN.values(), ids=GIVEN.keys())
def test_what_is_given_is_a_file_or_a_folder(
    words: tuple[str, ...], kind: str, room: Path, room_run: RunFolder, tmp_path: Path
) -> None:
    path = plant(kind, tmp_path / "x")
    known = {"X": path, "ROOM": room, "RUN": room_run.path}
    line = refusal(*(known.get(word, tmp_path / word if word.startswith("OUT") else word) for word in words))
    assert str(path) in line
    assert [p for p in tmp_path.rglob("*") if not p.is_dir()] == [path]


@pytest.mark.parametrize("kind", ["pipe", "folder"])
@pytest.mark.parametrize(
    "ending", ["ply", "pcd", "sog", "spz", "splat", "glb", "gltf", "usda", "usdz", "ggz", "ggc", "bin", "npy"]
)
def test_what_has_the_name_of_a_map_is_a_file(kind: str, ending: str, tmp_path: Path) -> None:
    path = plant(kind, tmp_path / f"x.{ending}")
    assert str(path) in refusal("export", path, "--out", tmp_path / "out.ply")
    assert str(path) in refusal("compare", path, path)
    assert str(path) in refusal("decode" if ending in ("ggz", "ggc", "bin") else "encode", path, tmp_path / "out.ply")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "linked pipe"])
@pytest.mark.parametrize("ending", ["bag", "db3", "mcap", "r3d", "mp4"])
def test_what_has_the_name_of_a_recording_is_a_file(kind: str, ending: str, tmp_path: Path) -> None:
    path = plant(kind, tmp_path / f"x.{ending}")
    assert str(path) in refusal("inspect", path)


@pytest.mark.parametrize("kind", ["pipe", "socket", "linked pipe"])
@pytest.mark.parametrize(
    "name", ["map.ply", "keyframes.json", "objects.json", "run.json", "renders/compare000000.png", "changes/0.png"]
)
def test_a_run_holds_files(name: str, kind: str, room_run: RunFolder, tmp_path: Path) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    plant(kind, run / name)
    for words in (
        ("export", run, "--out", tmp_path / "a.ply"), ("report", run), ("view", run, "--html", tmp_path / "a.html"),
        ("edit", run, "--remove", "1", "--out", tmp_path / "b"), ("eval", run), ("encode", run, tmp_path / "a.bin"),
        ("merge", run, room_run.path, "--out", tmp_path / "c"), ("compare", run, run),
        ("refine", run, "--out", tmp_path / "d"),
    ):  # fmt: skip
        line = refusal(*words)
        assert "not a regular file" in line or name == "run.json"


@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "folder"])
@pytest.mark.parametrize("name", ["camera.yaml", "rgb/000003.png", "depth/000003.png"])
def test_a_recording_holds_files(name: str, kind: str, room: Path, tmp_path: Path) -> None:
    recording = Path(shutil.copytree(room, tmp_path / "recording"))
    path = plant(kind, recording / name)
    for words in (("inspect", recording), ("run", recording, "--out", tmp_path / "run")):
        line = refusal(*words)
        assert str(path) in line and "not a regular file" in line


@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "linked pipe"])
def test_a_folder_of_changes_holds_files(kind: str, room_run: RunFolder, tmp_path: Path) -> None:
    changes = tmp_path / "changes"
    changes.mkdir()
    ChangesRecord(changes=[ChangeRecord(kind="moved", name="mug", confidence=0.9, picture="0.png")]).write(changes)
    plant(kind, changes / "0.png")
    line = refusal("view", room_run.path, "--changes", changes)
    assert "not a regular file" in line or "outside" in line


def test_pictures_of_a_run_have_the_size_of_its_camera(room_run: RunFolder, tmp_path: Path) -> None:
    """Larger ones than scoring writes are not decoded."""
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    camera = room_run.sequence().camera_of(0)
    (run / "renders").mkdir(exist_ok=True)
    picture = run / "renders" / "compare000000.png"
    assert cv2.imwrite(str(picture), np.zeros((3 * camera.height + 13, 3 * camera.width + 12, 3), np.uint8))
    line = refusal("report", run)
    assert f"claims {3 * camera.width + 12}x{3 * camera.height + 13} pixels" in line
