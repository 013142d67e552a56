# SPDX-License-Identifier: Apache-2.0
"""The front-end of edges and planes by kernels and on the CPU, side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from feature_scenes import CAMERA

from ggslam.cuda.library import CudaLibrary
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_log
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.cuda.feature_scans import CudaScan
from ggslam.tracking.cuda.features import CudaFeatures
from ggslam.tracking.edges_planes.alignment import FeatureAlignment
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.local_map import LocalFeatureMap
from ggslam.tracking.edges_planes.scans import DepthImageFeatures
from ggslam.tracking.edges_planes.settings import FeatureAlignSettings, FeatureTrackerSettings
from ggslam.tracking.settings import DepthNoise

NO_LIMIT = FeatureTrackerSettings(align=FeatureAlignSettings(budget_ms=0))
"""Settings without a limit of time, which kernels have not."""


def on_device(
    library: CudaLibrary, settings: FeatureTrackerSettings = NO_LIMIT, camera: Camera = CAMERA
) -> CudaFeatures:
    return CudaFeatures(settings, CudaTrackingEngine(camera, library=library))


@dataclass
class Sides:
    """Local maps and extractors of both."""

    device: CudaFeatures
    map: LocalFeatureMap
    plain_map: LocalFeatureMap
    plain: DepthImageFeatures

    @staticmethod
    def of(library: CudaLibrary, settings: FeatureTrackerSettings = NO_LIMIT, camera: Camera = CAMERA) -> Sides:
        device = on_device(library, settings, camera)
        plain = DepthImageFeatures(camera, settings.extraction)
        return Sides(device, LocalFeatureMap(settings, device), LocalFeatureMap(settings), plain)

    def scans(self, depth: np.ndarray, noise: DepthNoise) -> tuple[CudaScan, ScanFeatures]:
        """The features of a depth image."""
        return self.device.extract(depth, noise), self.plain.extract(depth, noise)

    def add(self, scans: tuple[CudaScan, ScanFeatures], T: np.ndarray) -> None:
        self.map.add(scans[0], T)
        self.plain_map.add(scans[1], T)

    def align(
        self, scans: tuple[CudaScan, ScanFeatures], guess: np.ndarray
    ) -> tuple[FeatureAlignment, FeatureAlignment]:
        return self.map.align(scans[0], guess), self.plain_map.align(scans[1], guess)


def apart(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Metres and radians between two poses."""
    twist = se3_log(inverse(one) @ other)
    return float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))


def check_same(found: ScanFeatures, expected: ScanFeatures) -> None:
    """The same features in the same order; edges bit for bit, planes but for rounding, which torch does in products of
    matrices."""
    assert len(found.planes) == len(expected.planes) and len(found.edges) == len(expected.edges)
    for name in ("edges", "edge_sigmas"):
        assert getattr(found, name).numpy().tobytes() == getattr(expected, name).numpy().tobytes(), name
    # A patch is small beside its distance: its slope is known to so many roundings of the depth.
    for name, most in (("planes", 2e-6), ("normals", 3e-5), ("discs", 1e-7), ("plane_sigmas", 1e-7)):
        one, other = getattr(found, name).numpy(), getattr(expected, name).numpy()
        assert one.dtype == np.float32 and one.shape == other.shape
        assert np.abs(one - other).max(initial=0) < most, name
