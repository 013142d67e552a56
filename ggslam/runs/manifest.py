# SPDX-License-Identifier: Apache-2.0
"""The manifest of a run: its files with their sizes and checksums. It is part of run.json, so that both change in
one step."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.runs.checkpoints import FOLDER as CHECKPOINTS
from ggslam.runs.records.run_json import FileRecord, RunRecord
from ggslam.system.untrusted_files import is_plain_name, open_untrusted

Files = dict[str, FileRecord]

NEEDED = (
    "map.ply", "map_cells.json", "trajectory.txt", "keyframes.json", "objects.json", "classifier.npz", "votes.npz",
    "places.npz", "points.ply", "points_grid.ply",
)  # fmt: skip
"""Files that belong together: a run with one of them from elsewhere is not one run."""
REPLACEABLE = ("places.npz", "points.ply", "points_grid.ply")
"""Those of them that a run may do without."""
MADE_LATER = (
    "metrics.json", "frames.csv", "verdict.json", "report.html", "ground_truth.txt", "annotations.json",
    "camera_keys.json",
)  # fmt: skip
"""Files that are written into a finished run."""


@dataclass(frozen=True)
class Problem:
    """A difference between a run's folder and its manifest.

    Attributes:
        name: of the file.
        text: what is wrong with it.
        serious: whether the run is to be refused.
    """

    name: str
    text: str
    serious: bool

    def __str__(self) -> str:
        return f"{self.name}: {self.text}"


def names_in(folder: Path, below: Iterable[str] | None = None) -> list[str]:
    """Files of a run's folder, relative, sorted: no hidden ones, nothing that a link leads to, no checkpoints.

    Args:
        folder: of the run.
        below: names of files and folders in it; None: all.
    """
    tops = [path.name for path in folder.iterdir()] if below is None else list(below)
    found = []
    for top in tops:
        if top.startswith(".") or top in (RunRecord.FILE, CHECKPOINTS):
            continue
        pending = [folder / top]
        while pending:
            path = pending.pop()
            if path.is_symlink():
                continue
            if path.is_dir():
                pending += path.iterdir()
            elif path.is_file():
                found.append(path.relative_to(folder).as_posix())
    return sorted(found)


def files_in(folder: Path, below: Iterable[str] | None = None) -> Files:
    """The manifest of files as they are now; see `names_in`."""
    return {name: FileRecord(bytes=(folder / name).stat().st_size, sha256=sum_of(folder / name))
            for name in names_in(folder, below)}  # fmt: skip


def sum_of(path: Path) -> str:
    """SHA-256 of a file."""
    found = hashlib.sha256()
    with open_untrusted(path, RunFolderError) as file:
        while block := file.read(1 << 20):
            found.update(block)
    return found.hexdigest()


def without(files: Files, names: Iterable[str]) -> Files:
    """A manifest without some files, and without what is in folders of these names."""
    dropped = set(names)
    return {name: record for name, record in files.items() if name.partition("/")[0] not in dropped}


def size_problems(folder: Path, files: Files) -> list[Problem]:
    """What can be seen without reading the files."""
    problems = []
    for name, record in files.items():
        path = folder / name
        needed = name in NEEDED
        if not _is_own_name(name):
            problems.append(Problem(name, "no name of a file in the folder", True))
        elif path.is_symlink() or not path.is_file():
            problems.append(Problem(name, "is missing", needed and name not in REPLACEABLE))
        elif (size := path.stat().st_size) != record.bytes:
            problems.append(Problem(name, f"expected {record.bytes} bytes, found {size}", needed))
    for name in (*NEEDED, *MADE_LATER):
        if name not in files and (folder / name).is_file():
            problems.append(Problem(name, "is not in the manifest: not of this run, or cut off when it was written",
                                    name in NEEDED))  # fmt: skip
    return problems


def sum_problems(folder: Path, files: Files) -> list[Problem]:
    """The same, with the sums of all files."""
    problems = size_problems(folder, files)
    seen = {problem.name for problem in problems}
    for name, record in files.items():
        if name not in seen and sum_of(folder / name) != record.sha256:
            problems.append(Problem(name, "checksum mismatch (changed or damaged)", True))
    return problems


def refuse_mixed(folder: Path, mark: RunRecord) -> list[Problem]:
    """Problems that a run can be read with.

    Raises:
        RunFolderError: there are others: its files are not of one run, or damaged.
    """
    problems = [] if mark.files is None else size_problems(folder, mark.files)
    serious = [problem for problem in problems if problem.serious]
    if serious:
        more = f" (and {len(serious) - 1} more)" if serious[1:] else ""
        raise RunFolderError(
            f"{folder / serious[0].name}: {serious[0].text}{more}: changed or damaged; `ggslam verify` lists all, and "
            "with `accept` it accepts the files as they are"
        )
    return problems


def _is_own_name(name: str) -> bool:
    return all(map(is_plain_name, name.split("/")))
