# SPDX-License-Identifier: Apache-2.0
"""Where scans are gathered and aligned: with torch and numpy, or by kernels on a GPU."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch

from ggslam.tracking.edges_planes.alignment import FeatureAligner, FeatureAlignment, FrameClock
from ggslam.tracking.edges_planes.extraction import Scan, ScanFeatures
from ggslam.tracking.edges_planes.settings import FeatureAlignSettings
from ggslam.tracking.edges_planes.voxels import FeatureMap
from ggslam.tracking.engine import TrackingEngine
from ggslam.tracking.settings import DepthNoise


class FeatureEngine(Protocol):
    """Gathers scans in voxels and aligns scans to them, all in the frame of the map."""

    def clear(self) -> None:
        """Forgets all scans."""

    def add(self, scan: Any, T_map_sensor: np.ndarray) -> None:
        """Adds a scan that was taken at a pose [4, 4]."""

    def align(self, scan: Any, T_map_sensor_guess: np.ndarray, T_world_map: np.ndarray) -> FeatureAlignment:
        """The pose at which a scan fits best, near the guess [4, 4]; `T_world_map` says where the map is by now."""


class DeviceFeatures(FeatureEngine, Protocol):
    """The same on a device, which has frames' features to itself."""

    @property
    def gicp_engine(self) -> TrackingEngine:
        """Extracts points and aligns them there."""

    def extract(self, depth: np.ndarray, noise: DepthNoise) -> Scan:
        """As `DepthImageFeatures.extract`."""


class TorchFeatureEngine:
    """Works with torch tensors on the map's device.

    Args:
        features: the map.
        settings: see `FeatureAlignSettings`.
        clock: holds a frame to its budget.
    """

    def __init__(self, features: FeatureMap, settings: FeatureAlignSettings, clock: FrameClock) -> None:
        self._features, self._settings = features, settings
        self._aligner = FeatureAligner(features, settings, clock)

    def clear(self) -> None:
        """See `FeatureEngine`."""
        self._features.clear()

    def align(self, scan: ScanFeatures, T_map_sensor_guess: np.ndarray, T_world_map: np.ndarray) -> FeatureAlignment:
        """See `FeatureEngine`."""
        return self._aligner.align(scan.thin(self._settings.planes, self._settings.edges), T_map_sensor_guess)

    @torch.inference_mode()
    def add(self, scan: ScanFeatures, T_map_sensor: np.ndarray) -> None:
        """See `FeatureEngine`."""
        M = torch.from_numpy(T_map_sensor[:3]).to(scan.planes.device, torch.float32)
        R, t = M[:, :3], M[:, 3]
        discs = torch.cat([scan.discs, torch.zeros_like(scan.edge_sigmas)])
        self._features.add(torch.addmm(t, scan.points, R.T), len(scan.planes), scan.all_normals @ R.T, discs)
