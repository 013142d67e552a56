# SPDX-License-Identifier: Apache-2.0
"""What a path holds when it is not what a command asked for, and the command that takes it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Final

from ggslam.errors import AnotherKindError, GgslamError
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class RecognitionTuning(Tuning):
    """How far a folder is looked through."""

    names = 3
    """Names that are shown of what a folder holds."""
    looked_at = 200
    """Most entries of a folder that are looked at."""


VIDEOS: Final = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
ARCHIVES: Final = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")


def with_advice(error: AnotherKindError) -> str:
    """The message of an error, or in its place what the path really is and which command takes it."""
    try:
        found = _advice(error.path, error.wanted)
    except (OSError, ValueError, GgslamError):
        found = None
    return str(error) if found is None else f"{error.path}: {found}"


def _advice(path: Path, wanted: str) -> str | None:
    ways: tuple[tuple[Callable[[Path], str | None], str], ...] = (
        (_run, "run"), (_store, "store"), (_recording, "recording"), (_many, "batch"),
        (lambda place: _file(place, wanted), "file"),
    )  # fmt: skip
    for way, kind in ways:
        if kind != wanted and (found := way(path)) is not None:
            return found
    if path.is_dir() and not any(os.scandir(path)):
        return "is an empty folder"
    return None


def _run(path: Path) -> str | None:
    from ggslam.runs.checkpoints import has_checkpoints
    from ggslam.runs.folder import MARKER

    if (path / MARKER).is_file():
        return f"is a run of ggslam: {_command('view', path)} shows it, {_command('eval', path)} scores it"
    if has_checkpoints(path):
        return f"is a run that was cut off: {_command('run --resume', path)} goes on with it"
    return None


def _store(path: Path) -> str | None:
    from ggslam.submaps.grid import INDEX

    if not (path / INDEX).is_file():
        return None
    return f"is a store of submaps: {_command('submaps', path)} lists it; view, volumes, localize and encode take it"


def _recording(path: Path) -> str | None:
    from ggslam.sequences import recognise_format

    name = recognise_format(path)
    return None if name is None else f"is a recording ({name}): {_command('run', path)} makes a run of it"


def _many(path: Path) -> str | None:
    """What a folder holds several of."""
    from ggslam.jobs.batch.manifest import REPLICA
    from ggslam.runs.folder import MARKER
    from ggslam.sequences import recognise_format

    if not path.is_dir():
        return None
    with os.scandir(path) as entries:
        listed = [entry.name for entry, _ in zip(entries, range(RecognitionTuning.looked_at), strict=False)]
    folders = [path / name for name in sorted(listed) if (path / name).is_dir()]
    scenes = [folder for folder in folders if recognise_format(folder) is not None]
    if scenes:
        option = "batch --replica" if {scene.name for scene in scenes} <= set(REPLICA) else "batch"
        return f"holds {quantity(len(scenes), 'recording')} ({_names(scenes)}): {_command(option, path)} runs them all"
    runs = [folder for folder in folders if (folder / MARKER).is_file()]
    if not runs and path.joinpath("jobs").is_dir():  # of a batch: runs/RECORDING/SETTINGS/seedN
        runs = sorted(found.parent for found in path.glob(f"runs/*/*/*/{MARKER}"))
    return f"holds {quantity(len(runs), 'run')} ({_names(runs)}); give one of them" if runs else None


def _names(folders: list[Path]) -> str:
    shown = [folder.name for folder in folders[: RecognitionTuning.names]]
    if len({folder.name for folder in folders}) < len(folders):  # the runs of a batch
        shown = ["/".join(folder.parts[-4:]) for folder in folders[: RecognitionTuning.names]]
    return ", ".join([*shown, *(["..."] if len(folders) > len(shown) else [])])


def _file(path: Path, wanted: str) -> str | None:
    from ggslam.formats.splat_formats import splat_format

    ending = path.suffix.lower()
    if ending in (".ggz", ".ggc"):
        return f"is coded: {_command('decode', path)} decodes it, {_command('view', path)} shows it"
    if splat_format(path) is not None:
        return "is a file of Gaussians: view, render, export, edit, encode and compare take it"
    if not path.is_file():
        return None
    if ending in VIDEOS:
        return (
            "is a video, and ggslam needs a depth image beside each colour image; "
            "`ggslam inspect --formats` lists what it reads"
        )
    if ending in ARCHIVES:
        return "is an archive: unpack it, and give the folder in it"
    if ending in (".ply", ".pcd"):
        return "is a point cloud or a mesh: compare, encode and submaps take it"
    if ending in (".bin", ".gpcc"):
        told = f"may be a coded cloud or a scan: {_command('inspect', path)} tells what is in it"
        return None if wanted == "stream" else told
    if wanted == "batch":  # what is wrong with a manifest is said better by who reads it
        return None
    if ending in (".yaml", ".yml"):
        return f"may be the manifest of a batch: {_command('batch', path)} makes its runs"
    return "is a file that ggslam does not know"


def _command(words: str, path: Path) -> str:
    return f"`ggslam {words} {shlex.quote(str(path))}`"
