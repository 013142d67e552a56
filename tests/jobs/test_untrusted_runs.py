# SPDX-License-Identifier: Apache-2.0
"""Runs, stores and recordings made to reach outside their folder: every command refuses them, or works, and nothing
outside is read, changed or deleted."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam

from ggslam.errors import FormatError, GgslamError
from ggslam.runs.folder import RunFolder
from ggslam.submaps.grid import GridStore, SubmapSettings

STAGED = ".staged-1-00000000"
SECRET = "the content of a file outside"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    """A folder that must stay as it is, beside the attacker's."""
    folder = tmp_path / "home"
    (folder / "papers").mkdir(parents=True)
    (folder / "papers" / "thesis.txt").write_text(SECRET)
    (folder / "map.ply").write_text(SECRET)
    before = listing(folder)
    yield folder
    assert listing(folder) == before


def listing(folder: Path) -> dict[str, tuple[str, int]]:
    return {
        str(path.relative_to(folder)): (path.read_text() if path.is_file() else "", path.stat().st_mode)
        for path in sorted(folder.rglob("*"))
    }


def change_mark(run: Path, **entries: object) -> None:
    mark = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**mark, **entries}))


def stale(name: str) -> Callable[[Path, Path], None]:
    def attack(run: Path, home: Path) -> None:
        (run / ".staged-1-00000000").mkdir()
        (run / ".staged-1-00000000" / "run.json").write_text((run / "run.json").read_text())
        change_mark(run, saving={"from": ".staged-1-00000000", "stale": [name.replace("HOME", str(home))]})

    return attack


def staged_from_home(run: Path, home: Path) -> None:
    (run / ".staged-1-00000000").symlink_to(home)
    change_mark(run, saving={"from": ".staged-1-00000000", "stale": []})


def staged_elsewhere(run: Path, home: Path) -> None:
    change_mark(run, saving={"from": "../home", "stale": []})


def link(name: str, target: str) -> Callable[[Path, Path], None]:
    def attack(run: Path, home: Path) -> None:
        path = run / name
        path.parent.mkdir(exist_ok=True)
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.symlink_to(home / target if target else home)

    return attack


def staged_file_from_home(run: Path, home: Path) -> None:
    staged_files(run)
    (run / STAGED / "map.ply").symlink_to(home / "map.ply")


def staged_folder_from_home(run: Path, home: Path) -> None:
    staged_files(run)
    (run / STAGED / "renders").symlink_to(home / "papers")


def staged_files(run: Path) -> None:
    """A saving that was cut off."""
    (run / STAGED).mkdir()
    (run / STAGED / "run.json").write_text((run / "run.json").read_text())
    change_mark(run, saving={"from": STAGED, "stale": []})


def cells_from_home(run: Path, home: Path) -> None:
    for name in ("cells", "cells.new"):
        (run / name).symlink_to(home)


ATTACKS: dict[str, Callable[[Path, Path], None]] = {
    "a staged file is a link": staged_file_from_home, "a staged folder is a link": staged_folder_from_home,
    "cells are links": cells_from_home, "a hidden link": link(".staged-1-00000000", ""),
    "checkpoints are a link": link("checkpoints", ""),
    "stale parent": stale(".."), "stale path": stale("../home/map.ply"), "stale absolute": stale("HOME"),
    "stale dot": stale("."), "stale empty": stale(""), "staging is a link": staged_from_home,
    "staging has a path": staged_elsewhere, "map is a link": link("map.ply", "map.ply"),
    "run.json is a link": link("run.json", "papers/thesis.txt"), "report is a link": link("report.html", "map.ply"),
    "renders is a link": link("renders", ""), "plots is a link": link("plots", ""),
    "volumes is a link": link("volumes", ""),
    "a picture is a link": link("renders/0.png", "papers/thesis.txt"),
    "config is a link": link("config.yaml", "papers/thesis.txt"),
    "metrics is a link": link("metrics.json", "papers/thesis.txt"),
    "objects is a link": link("objects.json", "papers/thesis.txt"),
    "a link to a device": lambda run, home: link("votes.npz", "../../../../../../../../dev/zero")(run, home),
}  # fmt: skip


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS.keys())
def test_a_run_from_elsewhere_stays_in_its_folder(
    room_run: RunFolder, tmp_path: Path, home: Path, attack: Callable[[Path, Path], None]
) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    attack(run, home)
    commands: list[tuple[object, ...]] = [
        ("export", run, "--out", tmp_path / "out.ply"), ("edit", run, "--rename", "1", "mug", "--in-place"),
        ("run", tmp_path / "no-recording", "--out", run, "--overwrite"), ("verify", run), ("verify", run, "--accept"),
        ("localize", run, tmp_path / "no-recording"), ("eval", run, "--no-lpips"),
    ]  # fmt: skip
    if (run / "report.html").is_symlink() or (run / "plots").is_symlink():
        commands.append(("report", run))
    for command in commands:
        done = ggslam(*command)
        assert done.returncode in (0, 2) and SECRET not in done.stdout + done.stderr
    assert not (tmp_path / "out.ply").exists() or SECRET not in (tmp_path / "out.ply").read_text(errors="replace")


@pytest.mark.parametrize("attack", [stale(".."), staged_elsewhere], ids=["parent", "elsewhere"])
def test_a_saving_that_no_run_began_is_refused(
    room_run: RunFolder, tmp_path: Path, home: Path, attack: Callable[[Path, Path], None]
) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    attack(run, home)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    for command in (("report", run), ("verify", run), ("export", run, "--out", tmp_path / "out.ply")):
        done = ggslam(*command)
        assert done.returncode == 2 and "run.json: 'saving' names what no run would" in done.stderr
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_a_pipe_in_a_run_is_not_waited_for(room_run: RunFolder, tmp_path: Path) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    (run / "map.ply").unlink()
    os.mkfifo(run / "map.ply")
    done = ggslam("export", run, "--out", tmp_path / "out.ply")
    assert done.returncode == 2 and "not a regular file" in done.stderr


def test_names_from_a_run_move_no_cursor(room_run: RunFolder, tmp_path: Path) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "a\x1b[2Jrun"))
    (run / "objects.json").write_text("{")
    done = ggslam("report", run)
    assert "\x1b[2J" not in done.stdout + done.stderr and "\\x1b[2J" in done.stdout + done.stderr


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "store"
    with GridStore.create(path, SubmapSettings()) as made:
        made.put((0, 0, 0), {"points.pcd": b"1"})
        made.put((1, 0, 0), {"points.pcd": b"2"})
    return path


def store_index(path: Path) -> Path:
    return next(entry for entry in path.iterdir() if entry.suffix in (".sqlite", ".db", ".sqlite3"))


@pytest.mark.parametrize("place", ["cells", "cells/0_0_0", "cells/0_0_0/1", "cells/0_0_0/1/points.pcd", "index"])
def test_a_store_with_links_touches_nothing(store: Path, home: Path, place: str) -> None:
    path = store_index(store) if place == "index" else store / place
    if not path.exists():
        path = next((store / "cells" / "0_0_0").iterdir())
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    path.symlink_to(home / "map.ply" if path.suffix else home)
    with pytest.raises(FormatError, match=path.name), GridStore.open(store, write=True) as opened:
        opened.get((0, 0, 0), "points.pcd")
        opened.put((0, 0, 0), {"points.pcd": b"3"})


@pytest.mark.parametrize(
    ("column", "value"), [("version", "../../../home"), ("name", "../../../home/map.ply"), ("x", "../../home")]
)
def test_an_index_with_paths_for_numbers(store: Path, home: Path, column: str, value: str) -> None:
    connection = sqlite3.connect(store_index(store))
    connection.execute("PRAGMA ignore_check_constraints = ON")
    for table in ("parts", "cells"):
        try:
            connection.execute(f"UPDATE {table} SET {column} = ? WHERE x = 0", (value,))
        except sqlite3.Error:
            continue
    connection.commit()
    connection.close()
    try:
        with GridStore.open(store, write=True) as opened:
            for key in opened.cells():
                opened.get(key, "points.pcd")
                opened.put(key, {"points.pcd": b"3"})
    except (GgslamError, KeyError) as error:  # KeyError: no such part
        assert SECRET not in str(error)


def test_a_recording_that_names_files_elsewhere(tmp_path: Path, home: Path) -> None:
    from ggslam.errors import SequenceError
    from ggslam.sequences import open_sequence

    recording = tmp_path / "recording"
    (recording / "rgb").mkdir(parents=True)
    (recording / "depth").mkdir()
    (recording / "rgb.txt").write_text("0.0 ../home/map.ply\n1.0 ../home/map.ply\n")
    (recording / "depth.txt").write_text("0.0 depth/0.png\n1.0 depth/1.png\n")
    np.zeros(1).tofile(recording / "depth" / "0.png")
    with pytest.raises(SequenceError, match=r"home/map\.ply"):
        open_sequence(recording)


def sums(folder: Path) -> dict[str, bytes | str]:
    """All that is in a folder, where links lead included."""
    return {
        str(path.relative_to(folder)): str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*")) if path.is_symlink() or path.is_file()
    }  # fmt: skip


@pytest.mark.parametrize("attack", [staged_from_home, staged_file_from_home, staged_folder_from_home],
                         ids=["folder", "file", "inner folder"])  # fmt: skip
def test_what_verifies_a_run_from_elsewhere_moves_nothing_through_links(
    room_run: RunFolder, tmp_path: Path, home: Path, attack: Callable[[Path, Path], None]
) -> None:
    run = Path(shutil.copytree(room_run.path, tmp_path / "run"))
    attack(run, home)
    before = sums(run)
    for command in (("verify", run), ("verify", run, "--accept")):
        done = ggslam(*command)
        assert done.returncode == 2 and "nothing was moved or deleted" in done.stderr and STAGED in done.stderr
        assert "may be deleted" in done.stderr and done.stderr.count("error") == 1
    assert sums(run) == before


@pytest.mark.parametrize("place", ["", "map.ply", "mesh.ply"])
def test_volumes_from_elsewhere_move_nothing_through_links(
    room_run: RunFolder, tmp_path: Path, home: Path, place: str
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "volumes.json").write_text(json.dumps({"saving": {"from": STAGED, "stale": ["mesh.ply"]}, "files": []}))
    if place:
        (out / STAGED).mkdir()
        (out / STAGED / "volumes.json").write_text("{}")
        (out / (f"{STAGED}/{place}" if place == "map.ply" else place)).symlink_to(home / "map.ply")
    else:
        (out / STAGED).symlink_to(home)
    before = sums(out)
    done = ggslam("volumes", room_run.path, "--out", out, "--voxel", "0.1")
    assert done.returncode == 2 and "nothing was moved or deleted" in done.stderr
    assert sums(out) == before


@pytest.mark.parametrize("inner", [False, True], ids=["the folder", "a state"])
def test_a_run_is_not_resumed_through_links(
    room: Path, room_run: RunFolder, tmp_path: Path, inner: bool
) -> None:
    """Their states would be replaced by this run's."""
    other = tmp_path / "other" / "checkpoints"
    other.mkdir(parents=True)
    for name in ("start.json", "state-000001.bin"):
        (other / name).write_text("{}")
    run, before = tmp_path / "run", sums(other)
    run.mkdir()
    if inner:
        (run / "checkpoints").mkdir()
        (run / "checkpoints" / "start.json").write_text("{}")
        (run / "checkpoints" / "state-000001.bin").symlink_to(other / "state-000001.bin")
    else:
        (run / "checkpoints").symlink_to(other)
    done = ggslam("run", "--resume", run)
    assert done.returncode == 2 and "is a link to" in done.stderr and "may be deleted" in done.stderr
    again = ggslam("run", room, "--out", run, "--overwrite", "--stop", 2)
    assert again.returncode == 2 and "is a link to" in again.stderr
    assert sums(other) == before


@pytest.mark.parametrize(("name", "words"), [
    ("frames.csv", ("edit", "--rename", "ID", "bob", "--in-place")),
    ("renders/huge.png", ("edit", "--rename", "ID", "bob", "--in-place")),
    ("steps.csv", ("refine", "--steps", "1")),
])  # fmt: skip
def test_a_file_of_holes_is_not_copied(
    room_run: RunFolder, tmp_path: Path, name: str, words: tuple[str, ...]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(room_run.path, run)
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).write_bytes(b"")
    os.truncate(run / name, 50 << 30)
    some = str(room_run.segmented_map().table.objects[0].id)

    def state() -> dict[Path, tuple[int, int, int]]:
        found = {path: path.stat() for path in run.rglob("*") if path.is_file()}
        return {path: (stat.st_ino, stat.st_size, stat.st_mtime_ns) for path, stat in found.items()}

    before = state()
    done = ggslam(words[0], run, *(some if word == "ID" else word for word in words[1:]))
    assert done.returncode == 2 and f"{name}: too large for what it is: 53,687,091,200 bytes" in done.stderr
    assert state() == before
