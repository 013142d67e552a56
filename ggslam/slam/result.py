# SPDX-License-Identifier: Apache-2.0
"""The result of a run: poses of its frames, keyframes, map, objects and times."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import ConfigError
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import MapperTimes
from ggslam.movers.mover_table import FoundMover
from ggslam.objects.lookup import objects_at
from ggslam.objects.table import ObjectTable, Observation, Supervision
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.sequences.moving_pixels import MovingPixels
from ggslam.slam.config import Config
from ggslam.slam.loop_results import LoopEvent
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.tracking.tracker import TrackingStatus


@savable()
@dataclass(frozen=True)
class TrackedFrame:
    """The record of a frame.

    Attributes:
        frame_index, source_index, timestamp: of the `Frame`.
        keyframe: number of the keyframe its pose hangs on.
        T_keyframe_camera: float64 [4, 4], pose relative to that keyframe, so that it moves when the keyframe moves.
        overlap: share of its points that matched the map.
        rmse_m: root mean square point-to-plane distance of the matched points, metres.
        status: outcome of tracking.
        reason: why it was lost or how it was recovered, else empty.
    """

    frame_index: int
    source_index: int
    timestamp: float
    keyframe: int
    T_keyframe_camera: Pose
    overlap: float
    rmse_m: float
    status: str
    reason: str = ""


@dataclass
class StepReport:
    """The outcome of one step.

    Attributes:
        frame: how the frame was tracked.
        is_keyframe: whether it became one.
        gaussians: of the map.
        psnr: of the last view that was trained on, before its step, dB.
        seconds: that the step took.
        loss: mean over its optimisation steps, NaN without any.
        T_world_camera: float64 [4, 4], the frame's pose as tracked, NaN if it was lost. `SlamResult.trajectory` has
            the poses after all corrections.
    """

    frame: TrackedFrame
    is_keyframe: bool
    gaussians: int
    psnr: float
    seconds: float
    loss: float = float("nan")
    T_world_camera: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))


@savable(not_saved="_started beside", growing="tracking_by_frame", after="resume")
@dataclass
class SlamTimes:
    """Seconds of wall time.

    Attributes:
        wall: from the first step's begin to the last step's end: reading, tracking, mapping.
        tracking: spent tracking.
        tracking_by_frame: the same, frame by frame, so that growth with the map shows.
        loops: spent looking for places, closing loops and finding lost frames; part of `tracking` or mapping, or of
            `beside`.
        beside: spent in another thread beside the frames, while the parts above go on, on what a keyframe's frames do
            not wait for: its points join what they are aligned to, and loops are searched. Runs whose state can be
            saved have none.
        refinement: spent on the final refinement, not part of `wall`.
        checkpoints: spent on saving the state, part of `wall` or of `refinement`.
        saved: how many times that was.
    """

    wall: float = 0.0
    tracking: float = 0.0
    loops: float = 0.0
    beside: float = 0.0
    refinement: float = 0.0
    checkpoints: float = 0.0
    saved: int = 0
    tracking_by_frame: list[float] = field(default_factory=list)
    _started: float | None = None

    def start(self) -> None:
        """A step begins."""
        if self._started is None:
            self._started = time.perf_counter()

    def tracking_ms_by_window(self, frames: int = 100) -> list[float]:
        """Mean milliseconds of tracking over each `frames` frames."""
        seconds = self.tracking_by_frame
        return [1e3 * float(np.mean(seconds[k : k + frames])) for k in range(0, len(seconds), frames)]

    def resume(self) -> None:
        """The clock goes on from where it was when the state was saved."""
        self._started = time.perf_counter() - self.wall if self.wall > 0 else None

    def stop(self) -> None:
        """A step ends."""
        if self._started is not None:
            self.wall = time.perf_counter() - self._started


@savable()
@dataclass(frozen=True)
class LearnedObjects:
    """Objects of a run; the Gaussians' `object_id`, `features` and votes belong to them.

    Attributes:
        classifier: of identity vectors.
        supervision: what taught them.
        observations: where each object was seen.
    """

    classifier: IdentityClassifier
    supervision: Supervision
    observations: dict[int, Observation]


@dataclass(frozen=True)
class LostStretch:
    """Frames in a row that were lost: the first one's index, how many, from the last known pose to the next in
    seconds (to the last lost frame if there is no next), and the frame after it, None at the end."""

    first: int
    frames: int
    seconds: float
    after: int | None


@dataclass
class SlamResult:
    """The result of a run.

    Attributes:
        gaussians: the map.
        keyframes: with refined poses.
        frames: one entry per frame, in order.
        times: seconds spent tracking and in all.
        mapper_times: seconds spent mapping, by part.
        dropped_frames: indices of frames that were not tracked (real-time runs that fell behind).
        refine_iterations: optimisation steps of the final refinement.
        objects: what was learned about objects; None if nothing was.
        places: content of `places.npz`; None if the run remembered no places.
        loop_events: closures and what became of other candidates, frames found again.
        cells: the map, if memory was limited and not enough for it; `gaussians` is empty then. Use `parts`.
        paging: figures of a run whose memory was limited, see `MapPager.report`.
        notes: what the user should know of it.
        release: removes its files.
        steps: what was noted of every step, content of `steps.csv`.
        device: what it was computed on: "cpu", or the GPU's name.
        config: settings of the run.
        moving: what was found to move, frame by frame...
        movers: ...and mover by mover.
    """

    gaussians: GaussianMap
    keyframes: list[Keyframe]
    frames: list[TrackedFrame]
    times: SlamTimes
    mapper_times: MapperTimes
    dropped_frames: list[int] = field(default_factory=list)
    refine_iterations: int = 0
    objects: LearnedObjects | None = None
    loop_events: list[LoopEvent] = field(default_factory=list)
    places: bytes | None = None
    cells: GaussianCells | None = None
    paging: dict[str, float] | None = None
    notes: list[str] = field(default_factory=list)
    release: Callable[[], None] | None = None
    steps: str | None = None
    device: str = "cpu"
    config: Config | None = None
    moving: MovingPixels = field(default_factory=MovingPixels)
    movers: list[FoundMover] = field(default_factory=list)

    def close(self) -> None:
        """Removes what is on disk of map and keyframes, if anything is; it cannot be read any more."""
        if self.release is not None:
            self.release()

    @property
    def gaussian_count(self) -> int:
        """Gaussians of the map."""
        return len(self.gaussians) if self.cells is None else self.cells.count

    def parts(self) -> Iterator[GaussianMap]:
        """The map in parts, in the order of map.ply: a map that was paged by cells, another one as a whole."""
        if self.cells is None:
            yield self.gaussians
        else:
            yield from (part for _, part in self.cells.parts())

    def object_table(self, names: Mapping[int, str] | None = None) -> ObjectTable:
        """Names, places, sizes of the objects: of a run without objects an empty table.

        Args:
            names: of object ids, where known (`Sequence.instance_names`).
        """
        if self.objects is None:
            return ObjectTable("masks", self.gaussian_count)
        found = self.objects
        return ObjectTable.of_parts(self.parts(), found.classifier, found.supervision, names, found.observations)

    def objects_at(self, points: np.ndarray, radius: float = 0.05) -> np.ndarray:
        """Object at each place, uint16 [n], 0 = none: that of the nearest Gaussian within `radius` metres.

        Args:
            points: [n, 3] or [3], metres, world frame.
            radius: metres.

        Raises:
            ValueError: points of another shape, or that are not finite.
            ConfigError: the map did not fit into the run's limit of memory.
        """
        if self.cells is not None:
            raise ConfigError("objects_at: the map is on disk (memory_limit_mb); save the run and read a part of it")
        return objects_at(self.gaussians, points, radius)

    def trajectory(self) -> np.ndarray:
        """T_world_camera of every frame, float64 [n, 4, 4], NaN for lost ones; the world is the first keyframe's
        camera."""
        return tracked_poses(self.frames, [keyframe.T_world_camera for keyframe in self.keyframes])

    def lost_stretches(self) -> list[LostStretch]:
        """When the camera was lost."""
        stretches: list[LostStretch] = []
        begin = 0
        for lost, group in itertools.groupby(self.frames, lambda f: f.status == TrackingStatus.LOST.value):
            count = len(list(group))
            if lost:
                end = min(begin + count, len(self.frames) - 1)
                seconds = self.frames[end].timestamp - self.frames[max(0, begin - 1)].timestamp
                after = self.frames[end].frame_index if begin + count < len(self.frames) else None
                stretches.append(LostStretch(self.frames[begin].frame_index, count, seconds, after))
            begin += count
        return stretches

    def timestamps(self) -> np.ndarray:
        """Seconds, float64 [n]."""
        return np.array([f.timestamp for f in self.frames])

    def frames_per_second(self) -> float:
        """Frames by wall time, reading the recording included, final refinement and scoring not."""
        return len(self.frames) / self.times.wall if self.times.wall > 0 else float("nan")


def tracked_poses(frames: Sequence[TrackedFrame], T_world_keyframe: Sequence[np.ndarray]) -> np.ndarray:
    """See `SlamResult.trajectory`; from the poses [4, 4] of the keyframes."""
    poses = np.full((len(frames), 4, 4), np.nan)
    for pose, f in zip(poses, frames, strict=True):
        # A keyframe may be missing if a real-time run stopped before its mapper had taken it in.
        if f.status != TrackingStatus.LOST.value and f.keyframe < len(T_world_keyframe):
            pose[:] = T_world_keyframe[f.keyframe] @ f.T_keyframe_camera
    return poses
