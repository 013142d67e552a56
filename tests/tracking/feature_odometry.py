# SPDX-License-Identifier: Apache-2.0
"""Odometry from edges and planes alone, and features of scans that are already split: for tests and benchmarks."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ggslam.scene.poses import inverse
from ggslam.tracking.edges_planes.alignment import FeatureAlignment
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.scans import plain_features
from ggslam.tracking.edges_planes.settings import FeatureTrackerSettings
from ggslam.tracking.settings import DepthNoise


def split_features(
    planes: np.ndarray, edges: np.ndarray, noise: DepthNoise, device: torch.device | str = "cpu"
) -> ScanFeatures:
    """Features of a scan that is already split: points on planes [P, 3] and on edges [E, 3], metres."""
    p, e = (torch.from_numpy(np.ascontiguousarray(a, np.float32)).to(device) for a in (planes, edges))

    def sigmas(points: Tensor) -> Tensor:
        return noise.constant + noise.square * points.square().sum(1)

    return plain_features(p, e, sigmas(p), sigmas(e))

class FeatureOdometry:
    """Locates scan after scan: constant velocity, alignment to the local map, growth of the map.

    Args:
        settings: see `FeatureTrackerSettings`.
        T_world_sensor: pose of the first scan, [4, 4].
    """

    def __init__(self, settings: FeatureTrackerSettings, T_world_sensor: np.ndarray | None = None) -> None:
        self.map = LocalFeatureMap(settings)
        self.T_world_sensor = np.eye(4) if T_world_sensor is None else np.array(T_world_sensor, float)
        """Of the newest located scan."""
        self.velocity = np.eye(4)
        """Its motion since the one before, [4, 4]."""

    def locate(self, scan: ScanFeatures) -> FeatureAlignment | None:
        """Locates a scan and maybe adds it to the map. None: the first one, whose pose is given. If the result is not
        convincing (`map.is_convincing`), the pose stays where it was.

        The time for this counts from `map.clock.start()`.
        """
        if self.map.is_empty:
            self.map.add(scan, self.T_world_sensor)
            return None
        found = self.map.align(scan, self.T_world_sensor @ self.velocity)
        if not self.map.is_convincing(found):
            self.map.clock.lift()  # to be late is better than to be lost
            found = self.map.align(scan, found.T_map_sensor)
        if not self.map.is_convincing(found):
            self.velocity = np.eye(4)
            return found
        self.velocity = inverse(self.T_world_sensor) @ found.T_map_sensor
        self.T_world_sensor = found.T_map_sensor
        self.map.update(scan, self.T_world_sensor, found.overlap)
        return found
