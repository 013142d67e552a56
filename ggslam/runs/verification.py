# SPDX-License-Identifier: Apache-2.0
"""Checks whether a run's folder is complete and all its files are of one run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.runs.checkpoints import has_checkpoints
from ggslam.runs.folder import no_run
from ggslam.runs.manifest import Problem, files_in, names_in, sum_problems
from ggslam.runs.records.run_json import RunRecord
from ggslam.system.folder_lock import folder_lock, writer_of
from ggslam.system.plurals import quantity
from ggslam.system.staging import finish_saving


@dataclass
class Verification:
    """The result of a check.

    Attributes:
        path: of the run.
        mark: its run.json.
        problems: files that are not as the manifest says.
        others: files that the manifest does not know.
        resumable: whether there are checkpoints to go on from.
    """

    path: Path
    mark: RunRecord
    problems: list[Problem] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    resumable: bool = False

    @property
    def good(self) -> bool:
        """Whether every file is what the run wrote, and it is complete."""
        return not self.problems and self.mark.complete

    def lines(self) -> list[str]:
        """For people."""
        mark, files = self.mark, self.mark.files
        if files is None:
            lines = [f"{self.path}: has no manifest (an early version wrote it), so its files cannot be checked"]
        else:
            total = sum(record.bytes for record in files.values()) / 1e6
            lines = [f"{self.path}: {quantity(len(files), 'file')}, {total:.1f} MB"]
        lines += [f"  {problem}" for problem in self.problems]
        lines += [f"  {name}: not in the manifest" for name in self.others]
        lines += [f"  incomplete: {note}" for note in mark.notes() if not mark.complete and "edited" not in note]
        lines += ["  to continue it: ggslam run --resume"] if self.resumable else []
        return [*lines, self.summary()]

    def summary(self) -> str:
        """In one line."""
        if self.good:
            return "all files match the manifest"
        names = [problem.name for problem in self.problems]
        more = f" and {len(names) - 3} more" if names[3:] else ""
        changed = f"{', '.join(names[:3])}{more}: changed, damaged or missing"
        return "; ".join([changed] * bool(names) + ["not complete"] * (not self.mark.complete))


def verify_run(path: Path) -> Verification:
    """Compares all files of a run with its manifest. A saving that was interrupted is finished first.

    Raises:
        RunFolderError: it is no run, or one is being written there.
    """
    path = Path(path)
    if not (path / RunRecord.FILE).is_file():
        more = "; it was cut off before it was saved: `ggslam run --resume`" if has_checkpoints(path) else ""
        raise RunFolderError(f"{path}: is not a run of ggslam (no run.json){more}") if more else no_run(path)
    if writer_of(path) is None:
        finish_saving(path, RunRecord.FILE)
    mark = RunRecord.read(path)
    if mark.files is None:
        return Verification(path, mark, resumable=has_checkpoints(path))
    problems = sum_problems(path, mark.files)
    seen = {*mark.files, *(problem.name for problem in problems)}
    others = [name for name in names_in(path) if name not in seen]
    return Verification(path, mark, problems, others, has_checkpoints(path))


def accept_files(path: Path) -> Verification:
    """Writes the manifest of a run anew, of the files as they are now.

    Raises:
        RunFolderError: it is no run, or cannot be written to.
    """
    path = Path(path)
    if not (path / RunRecord.FILE).is_file():
        raise no_run(path)
    with folder_lock(path):
        finish_saving(path, RunRecord.FILE)
        RunRecord.read(path).with_files(files_in(path)).write(path)
    return verify_run(path)
