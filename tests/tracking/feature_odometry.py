# SPDX-License-Identifier: Apache-2.0
"""Odometry from edges and planes alone, and features of LiDAR scans: for tests and benchmarks."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ggslam.scene.poses import inverse
from ggslam.tracking.edges_planes.alignment import FeatureAlignment
from ggslam.tracking.edges_planes.extraction import LineScanner, ScanFeatures, ScanLines
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.scans import plain_features
from ggslam.tracking.edges_planes.settings import ExtractionSettings, FeatureTrackerSettings
from ggslam.tracking.settings import DepthNoise


class LidarFeatures:
    """Edges and planes of the scans of one spinning LiDAR.

    Points are put in order by ring and azimuth: rings lie evenly between the lowest and the highest elevation.

    Args:
        rings: of the sensor.
        columns: directions per turn.
        settings: limits.
        noise: of the range measurement.
        device: where the work is done.
    """

    def __init__(
        self, rings: int, columns: int, settings: ExtractionSettings, noise: DepthNoise,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        self._rings, self._columns, self._noise = rings, columns, noise
        self._scanner = LineScanner(rings, columns, settings, device)
        self._points = torch.zeros(3, rings, columns, device=device)
        self._ranges = torch.zeros(rings, columns, device=device)

    @torch.inference_mode()
    def extract(self, points: np.ndarray) -> ScanFeatures:
        """Features of a scan.

        Args:
            points: [n, 3], metres, in the sensor's frame, in any order; zeros and what is not finite are left out.
        """
        p = torch.from_numpy(np.ascontiguousarray(points, np.float32)).to(self._points.device)
        ranges = p.square().sum(1).sqrt()
        seen = torch.isfinite(ranges) & (ranges > 1e-3)
        p, ranges = p[seen], ranges[seen]
        self._points.zero_()
        self._ranges.zero_()
        if len(p):
            cells = self._cells(p, ranges)
            self._points.view(3, -1)[:, cells] = p.T
            self._ranges.view(-1)[cells] = ranges
        sigmas = self._ranges.square().mul_(self._noise.square).add_(self._noise.constant)
        edges, planes = self._scanner.scan(ScanLines(self._points, self._ranges, sigmas, self._rings))
        flat, sigma = self._points.view(3, -1), sigmas.view(-1)
        return plain_features(flat[:, planes].T, flat[:, edges].T, sigma[planes], sigma[edges])

    def _cells(self, points: Tensor, ranges: Tensor) -> Tensor:
        """Place of each point in the flat grid of rings and columns."""
        elevation = torch.asin(points[:, 2] / ranges)
        low, high = torch.aminmax(elevation)
        ring = ((elevation - low) * ((self._rings - 1) / (high - low).clamp(min=1e-6))).round().to(torch.int64)
        turn = torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi) + 0.5
        column = (turn * self._columns).to(torch.int64).clamp(max=self._columns - 1)
        return ring * self._columns + column


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
