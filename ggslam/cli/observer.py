# SPDX-License-Identifier: Apache-2.0
"""Shows the progress of long commands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.progress import Progress, TaskID

from ggslam.system.tuning import Tuning

if TYPE_CHECKING:  # torch is slow to import and `--help` does not need it
    from ggslam.slam.result import StepReport


class ProgressTuning(Tuning):
    """What a progress bar shows."""

    wide_columns = 96
    """Columns of a window from which more is shown."""


class ProgressObserver:
    """Feeds a progress bar: one line per stage."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task: TaskID | None = None
        self._done = 0

    def begin(self, stage: str, total: int) -> None:
        """A stage of `total` steps begins."""
        self._task, self._done = self._bar.add_task(stage, total=total, info=""), 0

    def frame(self, report: StepReport) -> None:
        """A frame was processed."""
        assert self._task is not None
        self._done += 1
        loss = f"{report.loss:.3f}" if math.isfinite(report.loss) else "-"
        psnr = f"{report.psnr:.1f} dB" if math.isfinite(report.psnr) else "-"
        info = f"overlap {report.frame.overlap:4.0%}  {_count(report.gaussians)} Gaussians  loss {loss}"
        if self._bar.console.width >= ProgressTuning.wide_columns:
            info += f"  PSNR {psnr}"
        if report.frame.status != "ok":
            info += f"  [yellow]{report.frame.status}[/]"
        self._bar.update(self._task, completed=self._done, info=info)

    def advance(self, done: int, total: int) -> None:
        """`done` of `total` steps of the current stage are done."""
        assert self._task is not None
        self._bar.update(self._task, completed=done, total=total)

    def note(self, text: str) -> None:
        """Something the user should know."""
        self._bar.console.print(f"note: {text}", highlight=False, markup=False)


def _count(number: int) -> str:
    """A large number in few letters."""
    return f"{number / 1e6:.2f}M" if number >= 1e6 else f"{number / 1e3:.0f}k"
