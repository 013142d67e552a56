# SPDX-License-Identifier: Apache-2.0
"""run.json: that a folder is a run, what it was made with, whether it is whole, how it was edited."""

from __future__ import annotations

from typing import Any, ClassVar

import pydantic

from ggslam.objects.displacement import Displacement
from ggslam.runs.records.record import RecordFile


class RunRecord(RecordFile):
    """The mark of a run's folder.

    Attributes:
        ggslam: version that the run was made with.
        complete: whether it ended well and is whole.
        stopped_by: why it is not.
        environment: versions and machine, see `runs.environment`; older runs have none.
        edits: what was done to the map since, as sentences.
        displaced: objects that edits moved, as `Displacement.to_json` gives them.
    """

    FILE: ClassVar[str] = "run.json"
    ggslam: str = "unknown"
    complete: bool = False
    stopped_by: str | None = None
    environment: dict[str, str | int | float | None] | None = None
    edits: list[str] = []
    displaced: dict[str, list[list[float]] | None] = {}

    @pydantic.field_validator("displaced", mode="before")
    @classmethod
    def _check_displaced(cls, values: Any) -> Any:
        try:
            Displacement.from_json(values)
        except (TypeError, OverflowError) as error:
            raise ValueError(str(error)) from None
        return values

    def displacement(self) -> Displacement:
        """Where earlier edits moved objects to."""
        return Displacement.from_json(self.displaced)

    def versions(self) -> dict[str, str | int | float | None]:
        """What the run was made with, as far as it says."""
        return self.environment or {"ggslam": self.ggslam}

    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        notes = [f"the run stopped early: {self.stopped_by}"] if self.stopped_by else []
        return notes + ([f"the map was edited: {'; '.join(self.edits)}"] if self.edits else [])
