# SPDX-License-Identifier: Apache-2.0
"""Progress reports of long work."""

from __future__ import annotations

from typing import Protocol

from ggslam.slam.result import StepReport


class Observer(Protocol):
    """Receives progress updates of a run."""

    def begin(self, stage: str, total: int) -> None:
        """A stage of `total` steps begins."""

    def frame(self, report: StepReport) -> None:
        """A frame was processed."""

    def advance(self, done: int, total: int) -> None:
        """`done` of `total` steps of the current stage are done."""

    def note(self, text: str) -> None:
        """Something the user should know."""


class SilentObserver:
    """Ignores all progress."""

    def begin(self, stage: str, total: int) -> None:
        """Ignored."""

    def frame(self, report: StepReport) -> None:
        """Ignored."""

    def advance(self, done: int, total: int) -> None:
        """Ignored."""

    def note(self, text: str) -> None:
        """Ignored."""
