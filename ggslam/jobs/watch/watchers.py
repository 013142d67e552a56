# SPDX-License-Identifier: Apache-2.0
"""Watchers of a running run: a page in the browser, a log for rerun, robots and their tools."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ggslam.jobs.run.pipeline import Follower, RunOutcome, Waiting
from ggslam.jobs.view.serve import LivePage, live_page
from ggslam.jobs.watch.rerun_follower import LiveLog
from ggslam.reporting.rerun_log import RerunLog
from ggslam.scene.frame import Frame
from ggslam.slam.result import StepReport
from ggslam.slam.slam import Slam

if TYPE_CHECKING:  # what a run that is not published has no need of
    from ggslam.jobs.serve.live_serving import LiveServing
    from ggslam.jobs.serve.serving import ServeRequest


@dataclass
class Watching:
    """Who watches a run.

    Attributes:
        page: shows the map as it grows; None: no one asked.
        served: to robots and their tools; None: no one asked.
    """

    page: LivePage | None = None
    served: LiveServing | None = None
    _followers: list[Follower] = field(default_factory=list)
    _finish: list[Callable[[RunOutcome], None]] = field(default_factory=list)

    @property
    def follower(self) -> Follower | None:
        """For `execute`; None: no one watches."""
        return self._tell_all if self._followers else None

    def _tell_all(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        for follower in self._followers:
            follower(slam, frame, report)

    @property
    def while_waiting(self) -> Waiting | None:
        """For `execute`; None: no one asks for anything."""
        return None if self.served is None else self.served.wait

    def finish(self, outcome: RunOutcome) -> None:
        """Shows what came out. A run that was cut off is not shown on the page."""
        for finish in self._finish:
            finish(outcome)


@contextmanager
def watch_run(
    log: str | None, page: tuple[str, int] | None, name: str, serve: ServeRequest | None = None,
    beside: Path = Path("runs"),
) -> Iterator[Watching]:  # fmt: skip
    """Opens what was asked for, and closes it at the end.

    Args:
        log: "rerun", or a file .rrd; None: none.
        page: host and port; None: no page.
        name: of the recording.
        serve: how the run is published; None: it is not.
        beside: folder that maps are saved in while it goes on.

    Raises:
        GgslamError: a package is missing, the file cannot be written, or the port is taken.
    """
    with ExitStack() as opened:
        watchers = Watching()
        if log is not None:
            live = LiveLog(RerunLog(log, name))
            opened.callback(live.close)
            watchers._followers.append(live)
            watchers._finish.append(lambda outcome: live.finish(outcome.result))
        if page is not None:
            shown = watchers.page = opened.enter_context(live_page(*page, name))
            watchers._followers.append(shown.follow)
            watchers._finish.append(
                lambda outcome: shown.show_result(outcome.folder) if outcome.error is None else None
            )
        if serve is not None:
            from ggslam.jobs.serve.live_serving import serve_live

            watchers.served = served = opened.enter_context(serve_live(serve, beside))
            watchers._followers.append(served.follow)
            watchers._finish.append(served.finish)
        yield watchers
