# SPDX-License-Identifier: Apache-2.0
"""verdict.json: the quality of a run, judged by its own figures."""

from __future__ import annotations

from typing import ClassVar, Literal

from ggslam.runs.records.record import NumberOrNone, Record, RecordFile

Grade = Literal["good", "doubtful", "bad"]
ASPECTS = ("tracked", "sharp", "geometry", "objects", "movers")
GRADES: tuple[Grade, ...] = ("good", "doubtful", "bad")
"""From best to worst."""


def worst(grades: list[Grade]) -> Grade:
    """The lowest grade; "good" of none."""
    return max(grades, key=GRADES.index, default="good")


class AspectRecord(Record):
    """One aspect of a run's quality.

    Attributes:
        grade: None: it was not measured; `text` says why.
        value: the figure that the grade stands on, in `unit`.
        text: what was measured, for people.
    """

    grade: Grade | None = None
    value: NumberOrNone = None
    unit: str = ""
    text: str = ""

    def is_grade(self, *grades: str) -> bool:
        """Whether it is one of these."""
        return self.grade in grades


class FitRecord(Record):
    """How well the map shows its keyframes; see `jobs.run.map_fit.MapFit`."""

    views: int
    psnr: float
    structure: float
    brightness: float
    agreeing: float
    covered: float
    depth_error: float
    located: bool = False


class RunVerdict(RecordFile):
    """The quality of a run, judged without ground truth.

    Attributes:
        grade: of the run as a whole.
        tracked: whether the camera was located.
        sharp: whether the map looks like the keyframes.
        geometry: whether its depth is the measured one.
        objects: whether it has objects that tell things apart.
        movers: whether what was found to move can have moved.
        failure: why it is no result at all, as a sentence; empty: it is one.
        next: what to try, as a command or an option; empty: nothing.
        fit: what `sharp` and `geometry` stand on, with which scores made later are judged; None: not measured.
    """

    FILE: ClassVar[str] = "verdict.json"
    grade: Grade
    tracked: AspectRecord = AspectRecord()
    sharp: AspectRecord = AspectRecord()
    geometry: AspectRecord = AspectRecord()
    objects: AspectRecord = AspectRecord()
    movers: AspectRecord = AspectRecord()
    failure: str = ""
    next: str = ""
    fit: FitRecord | None = None

    def aspects(self) -> dict[str, AspectRecord]:
        """All of them by name, in order."""
        return {name: getattr(self, name) for name in ASPECTS}

    def summary(self) -> str:
        """In a line: the grade, and the aspects that are not good."""
        weak = [f"{name} {aspect.grade}" for name, aspect in self.aspects().items() if aspect.grade in GRADES[1:]]
        return f"{self.grade} ({', '.join(weak)})" if weak else self.grade

    def rows(self) -> list[list[str]]:
        """Aspect, grade and what was measured of each, as texts."""
        return [[name, aspect.grade or "-", aspect.text] for name, aspect in self.aspects().items()]
