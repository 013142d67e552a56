# SPDX-License-Identifier: Apache-2.0
"""A recording of a room, what its frames are aligned to, and the two that align them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.engine import CpuTrackingEngine
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.settings import DepthNoise, PointSettings, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface

if TYPE_CHECKING:
    from ggslam.cuda.library import CudaLibrary


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    sequence = open_sequence(room)
    return [sequence.frame(i) for i in range(10)]


@pytest.fixture(scope="module")
def native(frames: list[Frame]) -> CpuTrackingEngine:
    return CpuTrackingEngine(frames[0].camera, NativeContext(2))


@pytest.fixture(scope="module")
def target(frames: list[Frame], native: CpuTrackingEngine) -> GicpTarget:
    """The surface of two frames."""
    surface = MeasuredSurface(TrackerSettings().target, native.context)
    for frame in (frames[0], frames[4]):
        assert frame.T_world_camera is not None
        points = native.points(frame.depth, PointSettings(), DepthNoise())
        found = surface.add(points, frame.T_world_camera)
    return found


@pytest.fixture
def engine(frames: list[Frame], cuda_library: CudaLibrary) -> CudaTrackingEngine:
    return CudaTrackingEngine(frames[0].camera, library=cuda_library)
