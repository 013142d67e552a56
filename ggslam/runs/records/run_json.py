# SPDX-License-Identifier: Apache-2.0
"""run.json: that a folder is a run, what it was made with, whether it is whole, how it was edited."""

from __future__ import annotations

from typing import Any, ClassVar

import pydantic

from ggslam.objects.displacement import Displacement
from ggslam.runs.records.record import Record, RecordFile


class FileRecord(Record):
    """A file of a run: its number of bytes and their SHA-256."""

    bytes: int
    sha256: str


class VerdictRecord(Record):
    """Something that seems wrong with the run; see `sequences.verdicts.Verdict`."""

    code: str
    severity: str = "doubtful"
    text: str


class MergedRecord(Record):
    """One of the runs that a merged run was made of.

    Attributes:
        run: its folder.
        fingerprint: tells it from another run in the same folder, see `runs.recordings.fingerprint`.
        frames, keyframes, gaussians: numbers of them in the run.
        double: of its Gaussians, those left out because another run measured their places better.
        objects: what its object ids are called now.
    """

    run: str
    fingerprint: str
    frames: int
    keyframes: int
    gaussians: int
    double: int
    objects: dict[int, int] | None = None


class RunRecord(RecordFile):
    """What run.json says of a run.

    Attributes:
        ggslam: version that the run was made with.
        complete: whether it ended well and all that was asked for is there.
        stopped_by: why it is not.
        missing: names of files that were asked for and are not there (yet).
        verdicts: what seems wrong with the recording or the run.
        files: the manifest: all files of the run but this one, by name; None: the run has none.
        environment: versions and machine, see `runs.environment`; older runs have none.
        edits: what was done to the map since, as sentences.
        displaced: objects that edits moved, as `Displacement.to_json` gives them.
        merged: the runs that this one was merged from; None: it was made of one recording.
        updated: whether of these the last one is a later visit, whose state the map shows.
        loss: name of the user's own loss that the map was trained with; None: none.
    """

    FILE: ClassVar[str] = "run.json"
    ggslam: str = "unknown"
    complete: bool = False
    stopped_by: str | None = None
    missing: list[str] = []
    verdicts: list[VerdictRecord] = []
    files: dict[str, FileRecord] | None = None
    environment: dict[str, str | int | float | None] | None = None
    edits: list[str] = []
    displaced: dict[str, list[list[float]] | None] = {}
    merged: list[MergedRecord] | None = None
    updated: bool = False
    loss: str | None = None

    @pydantic.field_validator("displaced", mode="before")
    @classmethod
    def _check_displaced(cls, values: Any) -> Any:
        try:
            Displacement.from_json(values)
        except (TypeError, OverflowError) as error:
            raise ValueError(str(error)) from None
        return values

    def with_files(self, files: dict[str, FileRecord]) -> RunRecord:
        """The same with another manifest; what is in it is not missing any more."""
        missing = [name for name in self.missing if name not in files]
        whole = {"files": files, "missing": missing, "complete": self.stopped_by is None and not missing}
        return self.model_copy(update=whole)

    def displacement(self) -> Displacement:
        """Where earlier edits moved objects to."""
        return Displacement.from_json(self.displaced)

    def versions(self) -> dict[str, str | int | float | None]:
        """What the run was made with, as far as it says."""
        return self.environment or {"ggslam": self.ggslam}

    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        notes = [f"the run stopped early: {self.stopped_by}"] if self.stopped_by else []
        notes += [f"asked for, but not there: {', '.join(self.missing)}"] if self.missing else []
        notes += [f"{verdict.severity}: {verdict.text}" for verdict in self.verdicts]
        notes += [f"trained with a loss of your own, {self.loss}"] if self.loss is not None else []
        if self.merged and self.updated:
            notes.append(f"{self.merged[0].run}, brought up to date by {self.merged[-1].run}")
        elif self.merged:
            notes.append(f"merged from {', '.join(part.run for part in self.merged)}")
        return notes + ([f"the map was edited: {'; '.join(self.edits)}"] if self.edits else [])
