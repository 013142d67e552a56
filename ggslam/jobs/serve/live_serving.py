# SPDX-License-Identifier: Apache-2.0
"""Serves a run while it goes on, and what came out afterwards. What `ggslam run --publish` does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ggslam.driving.robot import Robot
from ggslam.errors import GgslamError
from ggslam.jobs.run.pipeline import RunOutcome
from ggslam.jobs.serve.channels import (
    CHANGES,
    DEPTH,
    DISTANCE,
    LENS,
    MESH,
    MOVERS,
    OBJECTS,
    PATH,
    POINT_TILES,
    POINTS,
    POSE,
    RECORDED,
    RENDERED,
    SPLAT_TILES,
    SPLATS,
    TF,
    TF_STATIC,
    VERDICTS,
    grid_channel,
)
from ggslam.jobs.serve.live_contents import LiveContents
from ggslam.jobs.serve.live_functions import LiveFunctions
from ggslam.jobs.serve.outlets import open_outlets
from ggslam.jobs.serve.pausing import Pause
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.run_contents import RunContents, ServedRun
from ggslam.jobs.serve.run_functions import RunFunctions
from ggslam.jobs.serve.run_volumes import RunVolumes
from ggslam.jobs.serve.services import MapServices
from ggslam.jobs.serve.serving import ServeRequest, Serving, offer_faces
from ggslam.jobs.volumes.robot_maps import parse_robots
from ggslam.messages.contents import Channel
from ggslam.runs.records.timing import TimingRecord
from ggslam.scene.frame import Frame
from ggslam.slam.result import StepReport
from ggslam.slam.slam import Slam
from ggslam.system.tuning import Tuning

LIVE: tuple[Channel, ...] = (
    TF, TF_STATIC, POSE, PATH, LENS, RECORDED, DEPTH, RENDERED, POINTS, POINT_TILES, SPLATS, SPLAT_TILES, OBJECTS,
    MOVERS, VERDICTS,
)  # fmt: skip
"""Channels of a run that goes on."""
AFTER: tuple[Channel, ...] = (CHANGES, DISTANCE, MESH)
"""Channels that are made anew of what came out when it has ended, besides grids."""


class LiveServingTuning(Tuning):
    """The end of a run."""

    end_s = 30.0
    """Seconds that sending the map as it came out may take, if nobody waits for Ctrl-C."""


class LiveServing:
    """A run that is served while it goes on; `follow` is a `Follower` of `ggslam.jobs.run.pipeline.execute`.

    Args:
        publisher: of its contents.
        services: that answer.
        functions: of the run while it goes on.
        pause: holds it.
        request: what is served.
        opened: closes what is opened.
    """

    def __init__(
        self, publisher: MapPublisher, services: MapServices, functions: LiveFunctions, pause: Pause,
        request: ServeRequest, opened: ExitStack,
    ) -> None:  # fmt: skip
        self.publisher, self.contents = publisher, LiveContents(publisher, _robots_of(request))
        functions.distances = self.contents.volumes
        opened.callback(self.contents.stop)
        self._services, self._functions, self._pause = services, functions, pause
        self._request, self._opened = request, opened
        self.lines: list[str] = []
        """For people: where it is found."""

    @property
    def stays(self) -> bool:
        """Whether the run is shown until Ctrl-C when it is done: not if it goes to files only, or was reset."""
        only_files = self._request.port is None and all(sender.is_file for sender in self.publisher.senders)
        return not self._functions.wants_reset and not only_files

    def follow(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        """After a frame, in the thread that tracks."""
        self.contents.follow(slam, frame, report)
        self._functions.between_frames(slam)
        self._pause.hold(lambda: self._functions.between_frames(slam))

    def wait(self, slam: Slam) -> None:
        """While the next frame does not come, in the same thread."""
        self._functions.between_frames(slam)

    def finish(self, outcome: RunOutcome) -> None:
        """Publishes what came out, and notes in timing.json what was sent."""
        self._functions.end()
        made = {channel.name for channel in LIVE if self.publisher.is_wanted(channel)} - {OBJECTS.name, VERDICTS.name}
        self.contents.finish(outcome.result, None if outcome.failure is not None else outcome.folder)
        if not self.stays:
            self.publisher.wait_idle(LiveServingTuning.end_s)
        if outcome.failure is not None:
            return
        folder = outcome.folder
        with folder.change_files(TimingRecord.FILE):
            record = folder.timing().model_copy(update={"publishing": self.publisher.record()})
            record.write(folder.path)
        if outcome.error is None and self.stays:
            volumes = RunVolumes(folder, self._request.robots, self.contents.keyframe_volumes(outcome.result))
            self._opened.callback(volumes.close)
            try:
                contents = RunContents(folder, volumes, self._request.changes)
            except GgslamError:  # no frame was located, which the run itself tells
                return
            functions = RunFunctions(contents, self.publisher)
            self._opened.callback(functions.close)
            self._services.use(functions.functions(), functions.locate)
            self._opened.callback(ServedRun(contents, self.publisher, made).close)


@contextmanager
def serve_live(request: ServeRequest, beside: Path) -> Iterator[LiveServing]:
    """Serves a run that is about to begin, until the block is left.

    Args:
        request: what is served, and through what.
        beside: folder that maps are saved in.

    Raises:
        GgslamError: a package is missing, or an address is taken.
    """
    with ExitStack() as opened:
        outlets = opened.enter_context(open_outlets(request.publish))
        channels = (*LIVE, *(grid_channel(name) for name in _robots_of(request)), *AFTER)
        publisher = MapPublisher(outlets.outlets, channels)
        opened.callback(publisher.close)
        pause = Pause()
        functions = LiveFunctions(publisher, pause, beside)
        services = MapServices(functions.functions())
        serving = Serving(publisher, services, list(outlets.lines))
        offer_faces(serving, outlets, request, opened)
        live = LiveServing(publisher, services, functions, pause, request, opened)
        live.lines = serving.lines
        yield live


def _robots_of(request: ServeRequest) -> dict[str, Robot]:
    """By name, that there are grids for; "" is any robot's if none is named."""
    return {robot.name: robot for robot in parse_robots(request.robots)} or {"": Robot()}
