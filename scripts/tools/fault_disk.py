# SPDX-License-Identifier: Apache-2.0
"""Faults of the disk, for fault_table.py and the tests: really full (a small tmpfs), read-only, folders that vanish."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fault_bench import Place


class NotHere(Exception):
    """This machine cannot show this fault."""


@contextlib.contextmanager
def small_disk(folder: Path, size: str = "1m") -> Iterator[Path]:
    """A file system of its own that is soon full, mounted at a folder.

    Raises:
        NotHere: nobody but root may mount, and not everywhere.
    """
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True)
    if done.returncode:
        folder.rmdir()
        raise NotHere("no tmpfs can be mounted")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def set_immutable(folder: Path, immutable: bool) -> bool:
    """Lets nobody, root included, write in a folder (or lets them again); whether that worked."""
    if shutil.which("chattr") is None:
        return False
    folders = [str(folder), *(str(path) for path in folder.rglob("*") if path.is_dir())]
    return subprocess.run(["chattr", "+i" if immutable else "-i", *folders], capture_output=True).returncode == 0


def emptied(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


@contextlib.contextmanager
def fallback(place: Path) -> Iterator[None]:
    """Runs that cannot be saved go below this folder, not to the machine's temporary one."""
    place.mkdir(exist_ok=True)
    names = ("TMPDIR", "XDG_STATE_HOME")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(place)))
    import tempfile

    tempfile.tempdir = None
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        tempfile.tempdir = None


def full(*words: str, size: str = "200k") -> Callable[[Place], None]:
    """A command whose result does not fit on the disk: a file there was before stays as it is."""

    def happen(place: Place) -> None:
        run = place.run()
        with small_disk(place.folder / "disk", size) as disk:
            target = disk / words[-1]
            if target.suffix:
                target.write_text("the one before")
            place.ggslam(words[0], run, *words[1:-1], target)
            if target.suffix and target.read_text() == "the one before":
                place.keep("the file that was to be replaced")
            left = [path.name for path in disk.rglob("*") if path.is_file() and path != target]
            if left and words[0] != "run":
                place.ended[-1].text += f"\nleft behind: {', '.join(left[:5])}"

    return happen


def full_run(size: str) -> Callable[[Place], None]:
    def happen(place: Place) -> None:
        with small_disk(place.folder / "disk", size) as disk, fallback(place.folder / "fallback"):
            place.out = disk / "out"
            place.map_recording(place.recording())

    return happen


def read_only_run(place: Place) -> None:
    (place.folder / "try").mkdir()
    if not set_immutable(place.folder / "try", True):
        raise NotHere("folders cannot be made immutable (chattr)")
    set_immutable(place.folder / "try", False)
    recording = place.recording()
    with fallback(place.folder / "fallback"):
        try:
            place.map_recording(recording, after=lambda k: k == 6 and set_immutable(place.out, True))
        finally:
            set_immutable(place.out, False)


def deleted_out(place: Place) -> None:
    with fallback(place.folder / "fallback"):
        place.map_recording(place.recording(), after=lambda k: shutil.rmtree(place.out) if k == 6 else None)


def deleted_recording(place: Place) -> None:
    recording = place.recording()
    with fallback(place.folder / "fallback"):
        place.map_recording(recording, after=lambda k: shutil.rmtree(recording) if k == 6 else None)


FAULTS: dict[str, Callable[[Place], None]] = {
    "the disk is full (1 MB) when a run is saved": full_run("1m"),
    "the disk is full from the beginning of a run": full_run("4k"),
    "the disk is full: export": full("export", "--out", "map.ply"),
    "the disk is full: export of a mesh": full("export", "--format", "mesh", "--voxel", "0.02", "--out", "mesh.ply"),
    "the disk is full: encode": full("encode", "points.bin", size="8k"),
    "the disk is full: edit": full("edit", "--rename", "1", "thing of mine", "--out", "edited"),
    "the disk is full: pictures": full("render", "--out", "pictures", size="64k"),
    "the disk is full: a page for the browser": full("view", "--html", "room.html"),
    "the output folder becomes read-only in mid-run": read_only_run,
    "the output folder is deleted in mid-run": deleted_out,
    "the recording is deleted in mid-run": deleted_recording,
}
