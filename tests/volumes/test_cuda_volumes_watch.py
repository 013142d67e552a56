# SPDX-License-Identifier: Apache-2.0
"""On a device the host waits for nothing while frames are fused and distances follow, and nothing is allocated, but
where the map grows; volumes of a run come to the host in the end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from device_watch import DeviceWatch
from test_cuda_tsdf import SETTINGS, TINY, assert_same, views
from torch.utils._python_dispatch import TorchDispatchMode

from ggslam.errors import ConfigError
from ggslam.volumes.cuda.field import CudaField
from ggslam.volumes.cuda.operations import UNDER_WAY
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_settings import VolumeSettings

FIELD = FieldSettings(max_distance=0.5)
COARSE = TsdfSettings(voxel=0.1)


class Allocations(TorchDispatchMode):
    """Names of operations, those that make memory apart."""

    def __init__(self) -> None:
        super().__init__()
        self.all: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.all.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))

    def done(self) -> list[str]:
        """Without views and questions."""
        return [name for name in self.all if name not in ("detach", "device", "slice", "view", "is_pinned")]

    def made(self) -> list[str]:
        makes = ("empty", "zeros", "ones", "full", "clone", "_to_copy")
        return [name for name in self.all if name.startswith(makes)]


def test_frames_are_fused_without_a_wait_and_without_memory() -> None:
    seen = views(8, 30, 22)
    with DeviceWatch() as watch:
        tsdf = CudaTsdf(COARSE, library=watch.library)
        field = CudaField(tsdf, FIELD)
        for view in seen[:UNDER_WAY]:
            tsdf.integrate(*view)
            field.update()
        watch.forget()
        with Allocations() as allocations:
            for view in seen[UNDER_WAY:]:
                tsdf.integrate(*view)
                field.update()
        frames = len(seen) - UNDER_WAY
        assert watch.waits == [] and allocations.made() == []
        assert len(watch.uploads) == frames and not any(upload.blocking for upload in watch.uploads)
        assert [call.operation for call in watch.calls] == frames * ["fuse", "field_update"]
        assert {download.bytes for download in watch.downloads} == {256} and len(watch.downloads) == 2 * frames
        assert set(allocations.done()) == {"copy_"}  # those recorded above; the watch's own, when they arrive
        found = tsdf.to_native()
    same = TsdfMap(COARSE)
    for view in seen:
        same.integrate(*view)
    assert_same(same, found)


def test_waits_come_with_growth_only() -> None:
    seen = views(6, 30, 22)
    with DeviceWatch() as watch:
        tsdf = CudaTsdf(COARSE, library=watch.library, room=TINY)
        for view in seen:
            tsdf.integrate(*view)
        assert "fused_move" in {call.operation for call in watch.calls}
        found = tsdf.to_native()
    same = TsdfMap(COARSE)
    for view in seen:
        same.integrate(*view)
    assert_same(same, found)


def test_volumes_of_a_recording_are_made_on_the_device() -> None:
    settings = replace(VolumeSettings(), tsdf=COARSE, esdf=FIELD, esdf_every=1)
    with DeviceWatch() as watch:
        maps = VolumeMaps(settings, esdf=True, device="cuda")
        for depth, camera, T, color, labels in views(5, 30, 22):
            maps.add_together([PosedView(depth, camera, T, color, labels)])
        called = [call.operation for call in watch.calls]
        assert called.count("fuse") == called.count("field_update") == 5
        maps.finish()
    assert maps.field is not None and len(maps.mesh().triangles) > 100
    fresh = DistanceField(maps.tsdf, FIELD)
    fresh.update()
    blocks = fresh.coordinates()
    assert {tuple(b) for b in blocks} == {tuple(b) for b in maps.field.coordinates()}
    gap = np.abs(maps.field.read(blocks) - fresh.read(blocks))
    assert np.nanmax(gap) <= COARSE.voxel / 16 + 1e-6
    points = np.array([[0.0, 0.0, 1.0], [0.3, 0.2, 1.2]])
    assert np.allclose(maps.field.query(points).distance, fresh.query(points).distance, atol=COARSE.voxel / 8)


def test_a_field_of_a_device_is_gone_on_with_in_the_core() -> None:
    """Its updates there are those of the core: bit for bit as computing anew."""
    seen = views(6, 30, 22)
    with DeviceWatch() as watch:
        tsdf = CudaTsdf(COARSE, library=watch.library)
        field = CudaField(tsdf, FIELD)
        for view in seen[:3]:
            tsdf.integrate(*view)
        field.update()
        on_host = tsdf.to_native()
        same = field.to_native(on_host)
    assert same.update().recomputed_blocks == 0
    before = same.read(same.coordinates())
    same.recompute()
    assert np.nanmax(np.abs(before - same.read(same.coordinates()))) < 1e-4 * COARSE.voxel
    for view in seen[3:]:
        on_host.integrate(*view)
    assert same.update().recomputed_blocks > 0
    updated = same.read(same.coordinates())
    same.recompute()
    assert np.array_equal(updated, same.read(same.coordinates()), equal_nan=True)


def test_what_is_not_done_on_a_device_is_refused() -> None:
    with pytest.raises(ConfigError, match="decays"):
        VolumeMaps(replace(VolumeSettings(), decay_every=3), device="cpu")
    with pytest.raises(ConfigError, match="gone on with"):
        VolumeMaps(VolumeSettings(), onto=TsdfMap(SETTINGS), device="cpu")
