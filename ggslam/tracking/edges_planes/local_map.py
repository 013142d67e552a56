# SPDX-License-Identifier: Apache-2.0
"""The local map of edges and planes that scans are aligned to."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from ggslam.scene.poses import inverse, orthonormalize, separation
from ggslam.system.array_forms import Pose
from ggslam.system.savable import savable
from ggslam.tracking.edges_planes.alignment import LAST_STEP, FeatureAligner, FeatureAlignment, FrameClock
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.settings import FeatureTrackerSettings
from ggslam.tracking.edges_planes.voxels import FeatureMap


@savable(not_saved="settings clock _aligner")
class LocalFeatureMap:
    """Planes and edges gathered in voxels; scans are aligned to them and added to them.

    It has a frame of its own, which a correction of the world moves as a whole.

    Args:
        settings: see `FeatureTrackerSettings`.
    """

    _T_map_added: Pose | None
    _T_world_map: Pose

    def __init__(self, settings: FeatureTrackerSettings) -> None:
        self.settings = settings
        self.clock = FrameClock(settings.align.budget_ms)
        self.features = FeatureMap(settings.map, settings.device)
        self._aligner = FeatureAligner(self.features, settings.align, self.clock)
        self._T_world_map = np.eye(4)
        self._T_map_added = None
        """Where the newest scan in the map was taken."""

    @property
    def is_empty(self) -> bool:
        """Whether no scan is in."""
        return self._T_map_added is None

    def clear(self) -> None:
        """Forgets everything."""
        self.features.clear()
        self._T_map_added = None

    def move(self, T_new_old: np.ndarray) -> None:
        """Moves the map in the world, [4, 4]."""
        self._T_world_map = orthonormalize(T_new_old @ self._T_world_map)

    def align(self, scan: ScanFeatures, T_world_sensor_guess: np.ndarray) -> FeatureAlignment:
        """The pose in the world at which the scan fits best; what the result says of the map is said of the world."""
        s = self.settings.align
        scan = scan.thin(s.planes, s.edges)
        found = self._aligner.align(scan, inverse(self._T_world_map) @ T_world_sensor_guess)
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

    def update(self, scan: ScanFeatures, T_world_sensor: np.ndarray, overlap: float) -> bool:
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

    def _wants(self, scan: ScanFeatures, T_world_sensor: np.ndarray, overlap: float) -> bool:
        s = self.settings.update
        if self._T_map_added is None or overlap < s.overlap:
            return True
        T = inverse(self._T_world_map) @ T_world_sensor
        moved, turned = separation(self._T_map_added, T)
        return moved > s.translation * scan.median_distance or turned > s.rotation_deg

    @torch.inference_mode()
    def add(self, scan: ScanFeatures, T_world_sensor: np.ndarray) -> None:
        """Adds a located scan."""
        T = inverse(self._T_world_map) @ T_world_sensor
        M = torch.from_numpy(T[:3]).to(scan.planes.device, torch.float32)
        R, t = M[:, :3], M[:, 3]
        discs = torch.cat([scan.discs, torch.zeros_like(scan.edge_sigmas)])
        self.features.add(torch.addmm(t, scan.points, R.T), len(scan.planes), scan.all_normals @ R.T, discs)
        self._T_map_added = T
