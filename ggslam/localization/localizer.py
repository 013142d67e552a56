# SPDX-License-Identifier: Apache-2.0
"""Locates frames or scans in a stored map of which only the surroundings of the sensor are in memory (SRT-PM).

Each frame or scan is aligned by G-ICP, from where constant velocity leads, to the surface that `map_surface` holds
ready around that place. `frame_localization` has what is different for images.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from typing import Final, Generic, Protocol, TypeVar

import numpy as np

from ggslam.localization.reach import AdaptiveReach
from ggslam.localization.surface import Surface
from ggslam.scene.poses import inverse
from ggslam.tracking.gicp import GicpTarget

ANY_NORMAL: Final = -2.0
"""A cosine that any two normals exceed."""

Item = TypeVar("Item", contravariant=True)


class LocalizationStatus(Enum):
    """How a frame or scan was located."""

    OK = "ok"
    DEGENERATE = "degenerate"
    """Located, but some direction of motion is not seen by the geometry."""
    FOUND = "found"
    """Located after being lost, or without a start pose."""
    LOST = "lost"
    """There is a map here, but it does not match."""
    OUTSIDE = "outside"
    """The map has nothing within reach of where the sensor is believed to be."""

    @property
    def is_located(self) -> bool:
        """Whether the pose is one that was measured."""
        return self not in (LocalizationStatus.LOST, LocalizationStatus.OUTSIDE)


@dataclass(frozen=True)
class FrontEndResult:
    """What a front-end says of one frame or scan.

    Attributes:
        T_world_sensor: float64 [4, 4]; when it is lost, the last known pose.
        status: OK, DEGENERATE, FOUND or LOST.
        overlap: share of its points with a match near enough.
        rmse_m: root mean square point-to-plane distance of those, metres.
        reason: why it was lost or how it was found, else empty.
        beyond: share of its points that lie beyond what the map in memory can contain; they do not count.
    """

    T_world_sensor: np.ndarray
    status: LocalizationStatus
    overlap: float
    rmse_m: float
    reason: str = ""
    beyond: float = 0.0


@dataclass(frozen=True)
class Localization(FrontEndResult):
    """Where a frame or scan is, and what that took.

    Attributes:
        map_points: points of the map that was aligned to.
        map_changed: whether the target was made anew.
        map_seconds: spent on the map: reading cells, making the target.
        align_seconds: spent on the frame or scan.
    """

    map_points: int = 0
    map_changed: bool = False
    map_seconds: float = 0.0
    align_seconds: float = 0.0

    @property
    def seconds(self) -> float:
        """Localisation time."""
        return self.map_seconds + self.align_seconds


class FrontEnd(Protocol[Item]):
    """Locates one frame or scan after another against the target of the moment."""

    def track(self, item: Item, surface: Surface, target: GicpTarget) -> FrontEndResult:
        """Locates the next one."""

    def look_up(self, item: Item, surface: Surface) -> FrontEndResult | None:
        """Looks for a lost one in the whole map; None: it was not found, or there is nothing to look it up by. Moves
        the surface."""


class Localizer(Generic[Item]):
    """Asks for the map around the place where constant velocity leads, then locates the frame or scan in it.

    Where nothing is near, or nothing matches, it stays at the last pose, standing still, and goes on from there if the
    sensor comes back, or from wherever the front-end finds it.

    Args:
        surface: of the map.
        front_end: for what is to be located.
        T_world_sensor: pose of the first one, float64 [4, 4]; None: it is looked up.
        reach: how far the map in memory reaches follows from what is seen; None: it stays.
    """

    def __init__(
        self, surface: Surface, front_end: FrontEnd[Item], T_world_sensor: np.ndarray | None,
        reach: AdaptiveReach | None = None,
    ) -> None:  # fmt: skip
        self.surface, self.front_end, self._reach = surface, front_end, reach
        self._pose = None if T_world_sensor is None else np.array(T_world_sensor, float)
        self._velocity = np.eye(4)
        self._lost = T_world_sensor is None

    def locate(self, item: Item) -> Localization:
        """Locates the next frame or scan.

        Raises:
            FormatError: the index of the store is damaged. (Damaged cells are left out; see `Surface.damage`.)
        """
        began = time.perf_counter()
        changed, map_seconds = self._move(item), time.perf_counter() - began
        target = self.surface.target if self._pose is not None else None
        found = None if target is None else self.front_end.track(item, self.surface, target)
        if found is None or not found.status.is_located:
            found = self.front_end.look_up(item, self.surface) or found or self._outside()
        self._follow(found)
        spent = time.perf_counter() - began
        return Localization(
            found.T_world_sensor, found.status, found.overlap, found.rmse_m, found.reason, found.beyond,
            self.surface.points, changed, map_seconds, spent - map_seconds,
        )  # fmt: skip

    def _move(self, item: Item) -> bool:
        """Brings the map to where the sensor is expected."""
        if self._reach is not None:
            self._reach.adapt(item, float(np.linalg.norm(self._velocity[:3, 3])))
        if self._pose is None:
            return False
        expected = self._pose @ self._velocity
        return self.surface.move_to(expected[:3, 3], expected[:3, 3] - self._pose[:3, 3])

    def _outside(self) -> FrontEndResult:
        if self._pose is None:
            reason = "no start pose, and nothing to look the place up by or nothing that looks like it"
            return FrontEndResult(np.full((4, 4), np.nan), LocalizationStatus.LOST, 0.0, 0.0, reason)
        x, y, z = self._pose[:3, 3]
        reason = f"the map has nothing around ({x:.2f}, {y:.2f}, {z:.2f})"
        return FrontEndResult(self._pose.copy(), LocalizationStatus.OUTSIDE, 0.0, 0.0, reason)

    def _follow(self, found: FrontEndResult) -> None:
        if not found.status.is_located:
            self._velocity, self._lost = np.eye(4), True
            return
        T = found.T_world_sensor
        known = self._pose is not None and not self._lost and found.status is not LocalizationStatus.FOUND
        self._velocity = inverse(self._pose) @ T if known and self._pose is not None else np.eye(4)
        self._pose, self._lost = T.copy(), False
