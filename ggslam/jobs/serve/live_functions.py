# SPDX-License-Identifier: Apache-2.0
"""What a run answers while it goes on."""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import ConfigError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.trajectory import write_tum
from ggslam.jobs.serve.channels import MAP, VERDICTS
from ggslam.jobs.serve.live_volumes import GrowingVolumes
from ggslam.jobs.serve.pausing import Pause
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.run_functions import distance_values, save_target, verdict_values
from ggslam.jobs.serve.services import Function, choice_in, flag_in, points_in, text_in
from ggslam.messages.contents import Verdicts
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.map_copy import whole_map
from ggslam.slam.result import tracked_poses
from ggslam.slam.slam import Slam
from ggslam.system.atomic import make_folder
from ggslam.system.tuning import Tuning


class LiveFunctionTuning(Tuning):
    """How long is waited for the run."""

    copy_s = 20.0
    """Seconds in which the run has to give a copy of its map: it does so between two frames, and while it waits for
    one."""


class LiveFunctions:
    """Functions of a run that goes on.

    Args:
        publisher: of its contents.
        pause: holds it.
        beside: folder that maps are saved in.
    """

    def __init__(self, publisher: MapPublisher, pause: Pause, beside: Path) -> None:
        self._publisher, self._pause, self._beside = publisher, pause, beside
        self._asked: queue.SimpleQueue[Callable[[Slam], None]] = queue.SimpleQueue()
        self._frames, self._status, self._dropped, self._ended = 0, "", 0, False
        self.wants_reset = False
        """Whether somebody asked the run to end."""
        self.distances: GrowingVolumes | None = None
        """That `query_distance` asks."""

    def functions(self) -> dict[str, Function]:
        """By name."""
        return {
            "status": self.status, "verdicts": self.verdicts, "save_map": self.save_map, "pause": self.pause,
            "reset": self.reset, "query_distance": self.query_distance,
        }  # fmt: skip

    # --- the thread of the run ---------------------------------------------------------------------------------------

    def between_frames(self, slam: Slam) -> None:
        """Does what was asked for: after a frame, and again and again until the next."""
        self._frames, self._dropped = len(slam.frames), len(slam.dropped_frames)
        self._status = slam.frames[-1].status if slam.frames else ""
        while not self._asked.empty():
            self._asked.get()(slam)

    def end(self) -> None:
        """There are no more frames."""
        self._ended = True

    # --- in any thread -----------------------------------------------------------------------------------------------

    def status(self, values: dict[str, Any]) -> dict[str, Any]:
        """How the run is doing."""
        return {
            "live": True, "frames": self._frames, "tracking": self._status, "dropped": self._dropped,
            "paused": self._pause.is_on, "paused_s": self._pause.seconds, "pauses": self._pause.times,
            "published": self._publisher.record(),
        }  # fmt: skip

    def verdicts(self, values: dict[str, Any]) -> dict[str, Any]:
        """The last ones that were published."""
        newest = self._publisher.newest(VERDICTS)
        content = newest[-1].content if newest else None
        return {"verdicts": verdict_values(content) if isinstance(content, Verdicts) else []}

    def pause(self, values: dict[str, Any]) -> dict[str, Any]:
        """Holds the run after the frame in work, or lets it go on."""
        on = flag_in(values, "on", True)
        self._pause.switch(on)
        return {"paused": on}

    def reset(self, values: dict[str, Any]) -> dict[str, Any]:
        """Ends the run as Ctrl-C does. A fresh map is another run."""
        self._pause.switch(False)
        if not self.wants_reset:  # a second Ctrl-C would cut the end short
            self.wants_reset = True
            os.kill(os.getpid(), signal.SIGINT)
        return {"ends": True}

    def save_map(self, values: dict[str, Any]) -> dict[str, Any]:
        """Writes the map as it is now as NAME.ply, and NAME.txt with the poses."""
        name = text_in(values, "name")
        path, poses_path = (save_target(self._beside, f"{name}{end}") for end in (".ply", ".txt"))
        copies: list[tuple[GaussianMap, np.ndarray, np.ndarray]] = []
        self._ask(lambda slam: copies.append(_copy_of(slam)))
        gaussians, stamps, poses = copies[0]
        make_folder(self._beside)
        write_gaussian_ply(path, gaussians)
        write_tum(poses_path, stamps, poses)
        return {"path": str(path), "gaussians": len(gaussians), "frames": len(stamps)}

    def query_distance(self, values: dict[str, Any]) -> dict[str, Any]:
        """Distances at points of the map's frame, as far as the map has grown; null where nothing is known."""
        points = points_in(values, "points")
        choice_in(values, "frame", (MAP,))
        if self.distances is None:
            raise ConfigError("there are no distances")
        return distance_values(self.distances.query(points), np.eye(3), self.distances.most_m)

    def _ask(self, what: Callable[[Slam], None]) -> None:
        """Has something done between two frames, and waits for it."""
        done, too_late, failures = threading.Event(), threading.Event(), list[Exception]()

        def act(slam: Slam) -> None:
            if too_late.is_set():
                return
            try:
                what(slam)
            except Exception as error:  # it is the caller's, and the run goes on
                failures.append(error)
            finally:
                done.set()

        self._asked.put(act)
        if self._ended or not done.wait(LiveFunctionTuning.copy_s):
            too_late.set()
            raise ConfigError(f"no frame was done in {LiveFunctionTuning.copy_s:g} s, so there is no copy of the map")
        if failures:
            raise failures[0]


def _copy_of(slam: Slam) -> tuple[GaussianMap, np.ndarray, np.ndarray]:
    """The map on the CPU; times [N] and poses [N, 4, 4] of the frames."""
    if slam.pager is not None:
        raise ConfigError("memory_limit_mb: parts of the map are on disk; it can be saved at the end only")
    if not slam.mapper.keyframes:
        raise ConfigError("there is no map yet")
    gaussians = whole_map(slam)
    keyframes = [keyframe.T_world_camera for keyframe in slam.mapper.keyframes]
    stamps = np.array([frame.timestamp for frame in slam.frames])
    return gaussians, stamps, tracked_poses(slam.frames, keyframes)
