# SPDX-License-Identifier: Apache-2.0
"""What the host does for a frame that is tracked on a device: one call, one wait, no memory of its own."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from device_watch import DeviceTensor, DeviceWatch
from torch.utils._pytree import tree_flatten

from ggslam.cuda.library import CudaLibrary
from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.settings import (
    AlignSettings,
    DepthNoise,
    PhotometricMode,
    PhotometricSettings,
    PointSettings,
    TrackerSettings,
)
from ggslam.tracking.surface import MeasuredSurface


class Operations:
    """Counts operations of torch under a watch, and those that allocate on the device or in page-locked memory."""

    def __init__(self, watch: DeviceWatch, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = self.allocated = 0
        self._dispatch = watch.dispatch
        monkeypatch.setattr(watch, "dispatch", self.dispatch)

    def dispatch(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        result, places = self._dispatch(func, args, kwargs), []
        for values in ((args, kwargs), result):
            tensors = [value for value in tree_flatten(values)[0] if isinstance(value, DeviceTensor)]
            places.append({tensor.host.untyped_storage().data_ptr() for tensor in tensors})
        self.count += func.overloadpacket.__name__ not in ("device", "is_pinned")
        self.allocated += bool(places[1] - places[0]) or bool(kwargs.get("pin_memory"))
        return result


@pytest.fixture
def watch() -> Iterator[DeviceWatch]:
    with DeviceWatch() as watch:
        yield watch


@pytest.mark.parametrize("mode", ["never", "auto", "always"])
def test_a_frame_is_one_call_and_one_wait(
    watch: DeviceWatch, frames: list[Frame], mode: PhotometricMode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where residuals are looked at. The points of a keyframe come with what its caller waits for."""
    settings = TrackerSettings(
        points=PointSettings(count=1500), align=AlignSettings(coarse_points=500),
        photometric=PhotometricSettings(mode=mode, points=800),
    )  # fmt: skip
    engine = CudaTrackingEngine(frames[0].camera, library=watch.library)
    tracker = GicpTracker(frames[0].camera, settings, NativeContext(1), frames[0].T_world_camera, engine)
    surface, operations = MeasuredSurface(settings.target, tracker.context), Operations(watch, monkeypatch)
    for number, frame in enumerate(frames):
        watch.forget()
        operations.count = operations.allocated = 0
        result = tracker.track(frame)
        if number > 1:  # the first one aligned has no median depth to expect
            assert [wait.operation for wait in watch.waits] == ["ggslam_cuda_track_wait"]
            assert [call.operation for call in watch.calls] == ["track_wait"]
        if number in (6, 8, 9):  # the target is what it was
            assert operations.allocated == 0 and operations.count <= 2
            assert len(watch.uploads) <= 2 and not watch.downloads
        assert not [upload for upload in watch.uploads if upload.blocking]
        if number in (0, 1, 2, 3, 4, 6):
            result.points.send()
            watch.record_wait("the caller's")
            waited = len(watch.waits)
            tracker.set_target(surface.add(result.points, result.T_world_camera))
            assert len(watch.waits) == waited
            assert np.isfinite(result.points.read().points).all() and len(result.points.read()) == len(result.points)
    assert tracker.state.residuals.residuals  # some frames were looked at


def test_a_target_may_be_got_ready_by_another_thread(
    frames: list[Frame], target: GicpTarget, cuda_library: CudaLibrary
) -> None:
    settings, noise, align = PointSettings(count=1500), DepthNoise(), AlignSettings(coarse_points=500)
    other = MeasuredSurface(TrackerSettings().target, NativeContext(1))
    engine = CudaTrackingEngine(frames[0].camera, library=cuda_library)
    points = engine.points(frames[2].depth, settings, noise)
    assert frames[2].T_world_camera is not None
    aims = (target, other.add(points, frames[2].T_world_camera), target)
    expected = [engine.align(points, aim, frames[2].T_world_camera, align, noise) for aim in aims]
    with ThreadPoolExecutor(1) as beside:
        for aim, one in zip(aims, expected, strict=True):
            beside.submit(engine.expect_target, aim).result()
            found = engine.align(points, aim, frames[2].T_world_camera, align, noise)
            assert np.array_equal(found.T_world_camera, one.T_world_camera) and found.cost == one.cost
            engine.expect_target(aims[0])  # something else is staged: the next is copied again
            found = engine.align(points, aim, frames[2].T_world_camera, align, noise)
            assert found.cost == one.cost
