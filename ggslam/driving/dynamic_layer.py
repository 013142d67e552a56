# SPDX-License-Identifier: Apache-2.0
"""What moves now, with its velocity, beside the map of what stands: it goes by itself a while after it was last seen.

    layer = DynamicLayer()
    layer.observe(slam.movers.tracks, frame.index, frame.timestamp)       # after each frame
    band = layer.over(static_band, now, ahead=1.0)                        # where it is, and will be within a second

Frames are mapped without what moves in them, so the static map stays free where movers pass; it takes them in when they
have come to rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.driving.bands import BandMap
from ggslam.driving.outlines import convex_outline, outline_gap
from ggslam.errors import InputError
from ggslam.movers.mover_table import FoundMover
from ggslam.movers.tracks import MoverTracks
from ggslam.scene.poses import transform_points
from ggslam.system.settings import setting, settings_class
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_grid import CellGrid, SlicePlane


class DynamicTuning(Tuning):
    """How movers are held."""

    max_points = 2000
    """Points that the surface of a mover is held with."""
    flexible_times = 5.0
    """How many times as long the velocity of what changes its shape is measured: parts come into view and go."""
    least_sights = 3
    """Fewest latest sights that velocities are measured from, however long ago."""
    outermost = 0.005
    """Share of a mover's points along each axis, at either end, that are left out as flying pixels."""


@settings_class(frozen=True)
class DynamicSettings:
    """How long movers are remembered, and how far they are predicted."""

    decay_s: float = setting(1.0, 0, 3600, "s")
    """Time after its last sight at which a mover is forgotten."""
    velocity_s: float = setting(0.1, 0.01, 60, "s")
    """Time over which the velocity of a rigid mover is measured."""
    margin: float = setting(0.05, 0, 10, "m")
    """Margin around what was seen of it."""


@dataclass(frozen=True)
class Sighting:
    """A mover where it is seen.

    Attributes:
        number: of the mover.
        T_world_mover: float64 [4, 4].
        points: [n, 3], its surface in its own frame, metres.
        rigid: whether it keeps its shape.
    """

    number: int
    T_world_mover: np.ndarray
    points: np.ndarray
    rigid: bool = True


@dataclass(frozen=True)
class MovingObstacle:
    """A mover as it is expected at a time.

    Attributes:
        number: of the mover.
        points: float64 [n, 3], its surface in the world, metres.
        velocity: float64 [3], metres a second, of its middle.
        unseen_s: seconds since it was seen.
    """

    number: int
    points: np.ndarray
    velocity: np.ndarray
    unseen_s: float

    @property
    def middle(self) -> np.ndarray:
        """Of the box around its points, [3], metres."""
        return np.asarray((self.points.min(0) + self.points.max(0)) / 2)


def sightings_of(tracks: MoverTracks, frame: int) -> list[Sighting]:
    """Movers that a frame shows; those that stand for a moment are among them, those put down are not."""
    found = []
    for track in tracks.tracks:
        tracker = track.tracker
        if tracker.frame != frame or track.settled or not track.sights:
            continue
        points = track.latest.points if tracker.flexible and track.latest is not None else tracker.surface.points
        found.append(Sighting(track.number, tracker.T_world_mover.copy(), points, not tracker.flexible))
    return found


def sightings_in(movers: Iterable[FoundMover], frame: int, T_world_camera: np.ndarray) -> list[Sighting]:
    """The movers of a finished run that a frame shows moving."""
    found = []
    for mover in movers:
        for sight in mover.sights:
            if sight.frame == frame and len(mover.points):
                T = T_world_camera @ sight.T_camera_mover
                found.append(Sighting(mover.number, T, mover.points, mover.kind != "not rigid"))
    return found


@dataclass
class _Held:
    """A mover's latest poses and times, and its surface."""

    points: np.ndarray
    times: list[float] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)

    def see(self, sighting: Sighting, time: float, window: float) -> None:
        window *= 1.0 if sighting.rigid else DynamicTuning.flexible_times
        first = next((k for k, t in enumerate(self.times) if t >= time - window - 1e-6), len(self.times))
        first = min(first, max(0, len(self.times) + 1 - DynamicTuning.least_sights))
        self.times, self.poses = [*self.times[first:], time], [*self.poses[first:], sighting.T_world_mover]
        self.points = _without_outermost(sighting.points)

    def velocity(self) -> np.ndarray:
        """Median of the velocities between any two sights of what is its middle now, [3], metres a second."""
        if len(self.times) < 2:
            return np.zeros(3)
        middle = (self.points.min(0) + self.points.max(0)) / 2
        places, times = np.array([transform_points(middle[None], T)[0] for T in self.poses]), np.array(self.times)
        one, other = np.triu_indices(len(times), 1)
        return np.asarray(np.median((places[other] - places[one]) / (times[other] - times[one])[:, None], axis=0))


class DynamicLayer:
    """Movers, each where it was seen last. Times are those of the frames, in seconds, and do not go back.

    Args:
        settings: how long they are remembered.
    """

    def __init__(self, settings: DynamicSettings | None = None) -> None:
        self.settings = settings or DynamicSettings()
        self._held: dict[int, _Held] = {}
        self._time = -math.inf

    def __len__(self) -> int:
        """Movers that are remembered."""
        return len(self._held)

    def observe(self, tracks: MoverTracks, frame: int, time: float) -> None:
        """Takes in what a run's movers are doing in a frame, of index `frame`, that was tracked just now."""
        self.take(sightings_of(tracks, frame), time)

    def take(self, sightings: Sequence[Sighting], time: float) -> None:
        """Takes in the movers that are seen at a time, and forgets those that were not for too long.

        Raises:
            InputError: the time is before that of the last call.
        """
        if not self._time <= time < math.inf:
            raise InputError(f"time: expected {self._time:g} or later, found {time:g}")
        for sighting in sightings:
            if len(sighting.points) and not (time == self._time and self._is_known_at(sighting.number, time)):
                held = self._held.setdefault(sighting.number, _Held(sighting.points))
                held.see(sighting, time, self.settings.velocity_s)
        self._time = time
        self._held = {n: held for n, held in self._held.items() if time - held.times[-1] <= self.settings.decay_s}

    def _is_known_at(self, number: int, time: float) -> bool:
        return number in self._held and self._held[number].times[-1] == time

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world."""
        for held in self._held.values():
            held.poses = [T_new_old @ T for T in held.poses]

    def obstacles_at(self, time: float) -> list[MovingObstacle]:
        """Where the movers are expected at a time, each going on as it went: those seen within `decay_s` before."""
        found = []
        for number, held in self._held.items():
            unseen, velocity = time - held.times[-1], held.velocity()
            if unseen <= self.settings.decay_s:
                points = transform_points(held.points, held.poses[-1]) + max(0.0, unseen) * velocity
                found.append(MovingObstacle(number, points, velocity, max(0.0, unseen)))
        return found

    def cells_at(self, time: float, grid: CellGrid, heights: tuple[float, float], ahead: float = 0.0) -> np.ndarray:
        """Cells, bool [H, W], that movers are in: their margin reaches to within half a cell of the centre.

        Args:
            time: seconds.
            grid: of the cells.
            heights: lowest and highest obstacle that counts, metres above the plane.
            ahead: seconds from then on in which they are expected to go on as they went.
        """
        gap = self._gap(time, grid, heights, ahead, np.full(grid.shape, np.inf))
        return np.asarray(gap <= grid.resolution / 2)

    def over(self, band: BandMap, time: float, ahead: float = 0.0) -> BandMap:
        """A band with the movers at a time as obstacles in it; arguments as of `cells_at`. The band itself stays."""
        distance = self._gap(time, band.grid, band.heights, ahead, band.distance.astype(np.float64))
        cells = self.cells_at(time, band.grid, band.heights, ahead)
        points = np.concatenate([band.points, band.grid.centres()[cells]])
        return replace(
            band, occupied=band.occupied | cells, known=band.known | cells, distance=distance.astype(np.float32),
            points=points,
        )  # fmt: skip

    def _gap(
        self, time: float, grid: CellGrid, heights: tuple[float, float], ahead: float, others: np.ndarray
    ) -> np.ndarray:  # fmt: skip
        """Metres [H, W] from the cells' centres to the nearest mover's margin; `others` [H, W] where that is less."""
        gap, centres = others.reshape(-1).copy(), grid.centres().reshape(-1, 2)
        for outline in self._outlines(time, grid.plane, heights, ahead):
            outside = np.maximum(np.maximum(outline.min(0) - centres, centres - outline.max(0)), 0)
            near = np.hypot(*outside.T) - self.settings.margin < gap
            gap[near] = np.minimum(gap[near], np.maximum(outline_gap(outline, centres[near]) - self.settings.margin, 0))
        return gap.reshape(grid.shape)

    def _outlines(
        self, time: float, plane: SlicePlane, heights: tuple[float, float], ahead: float
    ) -> Iterator[np.ndarray]:  # fmt: skip
        """Convex outlines [n, 2] on the plane of what movers pass over between two heights."""
        margin = self.settings.margin
        for obstacle in self.obstacles_at(time):
            at = plane.coordinates(obstacle.points)
            inside = at[(at[:, 2] >= heights[0] - margin) & (at[:, 2] <= heights[1] + margin), :2]
            if len(inside):
                way = ahead * np.stack([plane.x_axis, plane.y_axis]) @ obstacle.velocity
                # What goes straight on passes over the hull of where it begins and where it ends.
                yield convex_outline(np.concatenate([inside, inside + way]))


def _without_outermost(points: np.ndarray) -> np.ndarray:
    low, high = np.quantile(points, [DynamicTuning.outermost, 1 - DynamicTuning.outermost], axis=0)
    inner = points[((points >= low) & (points <= high)).all(1)]
    kept = inner if len(inner) else points
    return np.asarray(kept[:: -(-len(kept) // DynamicTuning.max_points)], np.float64)
