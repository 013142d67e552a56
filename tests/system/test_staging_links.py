# SPDX-License-Identifier: Apache-2.0
"""Nothing is moved, replaced or deleted through a link, wherever in a folder it is and wherever it leads."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ggslam.errors import RunFolderError
from ggslam.system import staging
from ggslam.system.array_file import write_array_file
from ggslam.system.atomic import write_text
from ggslam.system.links import refuse_links_below, remove_folder
from ggslam.system.staging import finish_saving, leftovers, make_staging, new_staging, publish

MARKER = "run.json"


def dead_process() -> int:
    """Number of a process that is not there any more."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


DEAD = dead_process()


def contents(folder: Path) -> dict[str, str]:
    """All that is in a folder: names, where links lead, sums of files."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"link to {path.readlink()}"
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """Somebody's folder, which happens to look like one that waits to be put into place."""
    folder = tmp_path / "victim"
    (folder / "renders").mkdir(parents=True)
    for name in ("map.ply", MARKER, "thesis.txt", "renders/0.png"):
        (folder / name).write_text(f"{name} of mine")
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run whose saving was interrupted: map.ply and renders/ wait."""
    folder = tmp_path / "run"
    hidden = folder / f".staged-{DEAD}-0123abcd"
    (hidden / "renders").mkdir(parents=True)
    (folder / "renders").mkdir()
    for name in ("map.ply", MARKER, "renders/1.png"):
        (hidden / name).write_text("{}")
    for name in ("map.ply", "points.ply", "renders/0.png"):
        (folder / name).write_text("old")
    record = {"saving": {"from": hidden.name, "stale": ["points.ply", "volumes"]}}
    (folder / MARKER).write_text(json.dumps(record))
    return folder


def test_what_was_interrupted_is_finished(run: Path) -> None:
    finish_saving(run, MARKER)
    assert sorted(contents(run)) == ["map.ply", "renders", "renders/1.png", MARKER]
    assert (run / "map.ply").read_text() == "{}"


def waiting(run: Path) -> Path:
    return next(run.glob(".staged-*"))


def swap(path: Path, target: Path | str) -> None:
    """Puts a link in the place of a file or folder."""
    if path.is_dir() and not path.is_symlink():
        path.rename(path.parent.parent / f"{path.name.strip('.')}-aside")
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(target)


PLACES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "staged folder": (waiting, ""),
    "staged file": (lambda run: waiting(run) / "map.ply", "thesis.txt"),
    "staged marker": (lambda run: waiting(run) / MARKER, MARKER),
    "staged folder of pictures": (lambda run: waiting(run) / "renders", "renders"),
    "staged picture": (lambda run: waiting(run) / "renders" / "1.png", "thesis.txt"),
    "staged picture deep down": (lambda run: waiting(run) / "a" / "b", "renders"),
    "file at the target": (lambda run: run / "map.ply", "map.ply"),
    "folder at the target": (lambda run: run / "renders", "renders"),
    "stale file": (lambda run: run / "points.ply", "thesis.txt"),
    "stale folder": (lambda run: run / "volumes", "renders"),
}
KINDS: dict[str, Callable[[Path, Path], Path | str]] = {
    "absolute": lambda link, target: target.resolve(),
    "relative": lambda link, target: os.path.relpath(target, link.parent),
    "dangling": lambda link, target: target.with_name("nothing"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", PLACES)
def test_a_link_stops_a_saving_from_elsewhere(run: Path, victim: Path, place: str, kind: str) -> None:
    find, target = PLACES[place]
    path = find(run)
    swap(path, KINDS[kind](path, victim / target))
    mine, before = contents(victim), contents(run)
    with pytest.raises(RunFolderError, match="link") as refused:
        finish_saving(run, MARKER)
    assert "\n" not in str(refused.value) and refused.value.exit_code == 2
    assert contents(victim) == mine and contents(run) == before


def test_the_marker_may_not_be_a_link(run: Path, victim: Path) -> None:
    (run / MARKER).rename(victim / "other.json")
    swap(run / MARKER, victim / "other.json")
    mine, before = contents(victim), contents(run)
    with pytest.raises(RunFolderError, match=r"run\.json: .*link.*other\.json"):
        finish_saving(run, MARKER)
    assert contents(victim) == mine and contents(run) == before


def test_a_user_may_name_a_link_to_the_whole_folder(run: Path, tmp_path: Path) -> None:
    (tmp_path / "my-run").symlink_to(run)
    finish_saving(tmp_path / "my-run", MARKER)
    assert sorted(contents(run)) == ["map.ply", "renders", "renders/1.png", MARKER]


@pytest.mark.parametrize("process", [DEAD, os.getpid()], ids=["dead", "alive"])
@pytest.mark.parametrize("leads_to", ["victim", "run", "nothing"])
def test_a_link_named_as_a_leftover_is_told_and_kept(
    tmp_path: Path, run: Path, victim: Path, process: int, leads_to: str
) -> None:
    link = tmp_path / "out" / f".staged-{process}-00000000"
    link.parent.mkdir()
    link.symlink_to(tmp_path / leads_to)
    mine, before = contents(victim), contents(run)
    assert link not in leftovers(link.parent)
    with pytest.raises(RunFolderError, match=rf"{link.name}: .*link.*{leads_to}"):
        new_staging(link.parent)
    assert contents(victim) == mine and contents(run) == before and link.is_symlink()


@pytest.mark.parametrize("place", ["map.ply", "renders", MARKER, "points.ply"])
def test_a_link_at_the_target_stops_publishing(tmp_path: Path, victim: Path, place: str) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / place).symlink_to(victim / (place if (victim / place).exists() else "thesis.txt"))
    new = make_staging(target)
    for name in ("map.ply", MARKER):
        (new / name).write_text("{}")
    (new / "renders").mkdir()
    mine = contents(victim)
    with pytest.raises(RunFolderError, match=rf"{place}: .*link"):
        publish(new, target, MARKER, ["points.ply"], {})
    assert contents(victim) == mine and sorted(contents(target)) == [place]


def test_a_name_that_no_file_can_have_stops_a_saving_before_it_begins(run: Path) -> None:
    record = {"saving": {"from": waiting(run).name, "stale": ["points.ply", "\ud800"]}}
    (run / MARKER).write_text(json.dumps(record))
    before = contents(run)
    with pytest.raises(RunFolderError, match="'saving'") as refused:
        finish_saving(run, MARKER)
    assert contents(run) == before and refused.value.exit_code == 2 and str(refused.value).encode()


def test_files_of_another_folder_are_not_published(tmp_path: Path, run: Path, victim: Path) -> None:
    (tmp_path / "out").mkdir()
    mine, before = contents(victim), contents(run)
    for other in (waiting(run), tmp_path / "out" / "..", tmp_path / "out" / "sub"):
        with pytest.raises(RunFolderError, match="files of another folder"):
            staging._exchange(other, tmp_path / "out", MARKER, [])
    assert contents(victim) == mine and contents(run) == before


def test_own_files_do_not_follow_links_and_users_files_do(tmp_path: Path, victim: Path) -> None:
    (tmp_path / "link.txt").symlink_to(victim / "thesis.txt")
    mine = contents(victim)
    with pytest.raises(RunFolderError, match=r"link\.txt: .*link"):
        write_text(tmp_path / "link.txt", "new", follow=False)
    assert contents(victim) == mine
    write_text(tmp_path / "link.txt", "new")
    assert (victim / "thesis.txt").read_text() == "new" and (tmp_path / "link.txt").is_symlink()


def test_a_temporary_name_that_is_a_link_is_not_written_through(tmp_path: Path, victim: Path) -> None:
    (tmp_path / f".state.bin.{os.getpid()}").symlink_to(victim / "thesis.txt")
    mine = contents(victim)
    write_array_file(tmp_path / "state.bin", {}, []).finish()
    assert contents(victim) == mine and (tmp_path / "state.bin").read_bytes()[:8] == b"ggstate1"


def test_only_a_folder_of_ones_own_is_removed(tmp_path: Path, victim: Path) -> None:
    (tmp_path / "own").symlink_to(victim)
    mine = contents(victim)
    with pytest.raises(RunFolderError, match="own: .*link"):
        remove_folder(tmp_path / "own")
    with pytest.raises(RunFolderError, match="own: .*link"):
        refuse_links_below(tmp_path / "own")
    assert contents(victim) == mine
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "inner").symlink_to(victim)
    remove_folder(tmp_path / "real")  # a link in it goes, not what it points to
    remove_folder(tmp_path / "missing")
    assert contents(victim) == mine and not (tmp_path / "real").exists()
