# SPDX-License-Identifier: Apache-2.0
"""The local map of edges and planes that scans are aligned to."""

from __future__ import annotations

import dataclasses

import numpy as np

from ggslam.scene.poses import inverse, orthonormalize, separation
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.tracking.edges_planes.alignment import LAST_STEP, FeatureAlignment, FrameClock
from ggslam.tracking.edges_planes.engine import FeatureEngine, TorchFeatureEngine
from ggslam.tracking.edges_planes.extraction import Scan
from ggslam.tracking.edges_planes.settings import FeatureTrackerSettings
from ggslam.tracking.edges_planes.voxels import FeatureMap


@savable(not_saved="settings clock _engine")
class LocalFeatureMap:
    """Planes and edges gathered in voxels; scans are aligned to them and added to them.

    It has a frame of its own, which a correction of the world moves as a whole.

    Args:
        settings: see `FeatureTrackerSettings`.
        engine: does the work, of scans that are its own, without a limit of time; None: torch does, of `ScanFeatures`,
            in `features`.
    """

    _T_map_added: Pose | None
    _T_world_map: Pose

    def __init__(self, settings: FeatureTrackerSettings, engine: FeatureEngine | None = None) -> None:
        self.settings = settings
        self.clock = FrameClock(settings.align.budget_ms if engine is None else 0)
        self.features: FeatureMap | None = None
        if engine is None:
            self.features = FeatureMap(settings.map, settings.device)
            engine = TorchFeatureEngine(self.features, settings.align, self.clock)
        self._engine: FeatureEngine = engine
        self._T_world_map = np.eye(4)
        self._T_map_added = None
        """Where the newest scan in the map was taken."""

    @property
    def is_empty(self) -> bool:
        """Whether no scan is in."""
        return self._T_map_added is None

    def clear(self) -> None:
        """Forgets everything."""
        self._engine.clear()
        self._T_map_added = None

    def move(self, T_new_old: np.ndarray) -> None:
        """Moves the map in the world, [4, 4]."""
        self._T_world_map = orthonormalize(T_new_old @ self._T_world_map)

    def align(self, scan: Scan, T_world_sensor_guess: np.ndarray) -> FeatureAlignment:
        """The pose in the world at which the scan fits best; what the result says of the map is said of the world."""
        self.clock.begins(LAST_STEP)
        found = self._engine.align(scan, inverse(self._T_world_map) @ T_world_sensor_guess, self._T_world_map)
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = self._T_world_map[:3, :3]
        result = dataclasses.replace(
            found, T_map_sensor=orthonormalize(self._T_world_map @ found.T_map_sensor),
            information=A @ found.information @ A.T, weak_directions=found.weak_directions @ A.T,
        )  # fmt: skip
        self.clock.end_step(LAST_STEP)
        return result

    def is_convincing(self, found: FeatureAlignment) -> bool:
        """Whether to believe a pose."""
        return found.usable and found.overlap >= self.settings.align.convincing_overlap

    def update(self, scan: Scan, T_world_sensor: np.ndarray, overlap: float) -> bool:
        """Adds a located scan if it has moved enough and there is time left, or if the map covers it badly; returns
        whether it did."""
        if not self._wants(scan, T_world_sensor, overlap):
            return False
        if not self.clock.allows("update") and overlap >= self.settings.update.urgent_overlap:
            return False
        self.clock.begins("update")
        self.add(scan, T_world_sensor)
        self.clock.end_step("update")
        return True

    def _wants(self, scan: Scan, T_world_sensor: np.ndarray, overlap: float) -> bool:
        s = self.settings.update
        if self._T_map_added is None or overlap < s.overlap:
            return True
        T = inverse(self._T_world_map) @ T_world_sensor
        moved, turned = separation(self._T_map_added, T)
        return moved > s.translation * scan.median_distance or turned > s.rotation_deg

    def add(self, scan: Scan, T_world_sensor: np.ndarray) -> None:
        """Adds a located scan."""
        T = inverse(self._T_world_map) @ T_world_sensor
        self._engine.add(scan, T)
        self._T_map_added = T
