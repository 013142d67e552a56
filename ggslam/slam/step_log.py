# SPDX-License-Identifier: Apache-2.0
"""Records numbers of every step in `steps.csv`, for plots. A row takes 0.1 ms and 144 bytes."""

from __future__ import annotations

import io
import math
from array import array
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import numpy as np

from ggslam.errors import FormatError
from ggslam.mapping.mapper import LossSums, Mapper
from ggslam.slam.result import SlamTimes, StepReport, TrackedFrame
from ggslam.system.array_forms import Form
from ggslam.system.plurals import quantity
from ggslam.system.process_memory import resident_bytes
from ggslam.system.savable import savable
from ggslam.system.untrusted_files import read_untrusted_text

STEPS_FILE = "steps.csv"
_PARTS = ("insertion", "forward", "loss", "backward", "identity")
_LOSSES = tuple(field.name for field in fields(LossSums))
_PARTS_OF, _LOSSES_OF = attrgetter(*_PARTS), attrgetter(*_LOSSES)
COLUMNS = (
    "frame", "end_s", "step_ms", "tracking_ms", "loops_ms", *(f"{part}_ms" for part in _PARTS), "iterations",
    "keyframe", "gaussians", "resident_mb", *(f"loss_{name}" for name in _LOSSES),
)  # fmt: skip
"""frame: its index; end_s: when its step ended, seconds after the first one began; step_ms: how long the step took;
*_ms: milliseconds spent in each part since the step before (in a real-time run also by the mapper's thread; loops are
part of tracking or of the rest, on a GPU mostly beside both); iterations: of the mapper since then; keyframe: 0 or 1;
gaussians of the map; resident_mb: resident memory of the process, 10^6 bytes; loss_*: means over their steps, see
`LossSums`; NaN if there were none."""


@savable(check="check")
class StepLog:
    """Rows of `COLUMNS`, one for each step."""

    _times: Annotated[np.ndarray, Form("f8", 2 + len(_PARTS))]
    _losses: Annotated[np.ndarray, Form("f8", len(_LOSSES))]

    def __init__(self) -> None:
        self._rows = array("d")
        self._times, self._losses = np.zeros(2 + len(_PARTS)), np.zeros(len(_LOSSES))
        self._iterations = self._steps = 0

    def check(self) -> None:
        """Raises FormatError if it has no whole rows: it may come from a file."""
        if len(self._rows) % len(COLUMNS):
            raise FormatError(f"table of steps: {len(self._rows)} numbers in rows of {len(COLUMNS)}")

    def __len__(self) -> int:
        return len(self._rows) // len(COLUMNS)

    def add(
        self, frame: TrackedFrame, T_world_camera: np.ndarray | None, is_keyframe: bool, seconds: float,
        times: SlamTimes, loops_s: float, mapper: Mapper, gaussians: int,
    ) -> StepReport:  # fmt: skip
        """Notes a step that has just ended, and reports it.

        Args:
            frame: as tracked.
            T_world_camera: [4, 4], where it is; None: it was lost.
            is_keyframe: whether it became one.
            seconds: that the step took.
            times: of the run.
            loops_s: seconds spent with loops so far.
            mapper: of the run.
            gaussians: of the map.
        """
        spent = np.array([times.tracking, loops_s, *_PARTS_OF(mapper.times)])
        sums, iterations = np.array(_LOSSES_OF(mapper.losses)), mapper.times.iterations
        count, steps = iterations - self._iterations, mapper.times.steps
        made = steps - self._steps
        losses = ((sums - self._losses) / made).tolist() if made > 0 else [math.nan] * len(_LOSSES)
        self._rows.extend((frame.frame_index, times.wall, 1e3 * seconds))
        self._rows.extend((1e3 * (spent - self._times)).tolist())
        self._rows.extend((count, is_keyframe, gaussians, resident_bytes() / 1e6))
        self._rows.extend(losses)
        self._times, self._losses, self._iterations = spent, sums, iterations
        self._steps = steps
        pose = np.full((4, 4), np.nan) if T_world_camera is None else T_world_camera
        return StepReport(frame, is_keyframe, gaussians, mapper.last_psnr, seconds, losses[0], pose)

    def table(self) -> np.ndarray:
        """All rows, float64 [n, columns]."""
        return np.array(self._rows).reshape(-1, len(COLUMNS))

    def to_csv(self) -> str:
        """The table as text."""
        text = io.StringIO()
        text.write(",".join(COLUMNS) + "\n")
        for row in self.table().tolist():
            text.write(",".join(f"{value:.6g}" if value % 1 else str(int(value)) for value in row) + "\n")
        return text.getvalue()


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file with a header, numbers as float64 (NaN where a field is empty), others as text.

    Raises:
        FormatError: it cannot be read, or a row has another number of columns than the header.
    """
    lines = read_untrusted_text(path).splitlines()
    names = lines[0].split(",") if lines else []
    rows = [line.split(",") for line in lines[1:]]
    for number, row in enumerate(rows, start=2):
        if len(row) != len(names):
            raise FormatError(f"{path}, line {number}: expected {quantity(len(names), 'column')}, found {len(row)}")
    return {name: _column([row[k] for row in rows]) for k, name in enumerate(names)}


def _column(words: list[str]) -> np.ndarray:
    try:
        return np.array([float(word) if word else np.nan for word in words], float)
    except ValueError:
        return np.array(words)
