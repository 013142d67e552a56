# SPDX-License-Identifier: Apache-2.0
"""The copy of a target on the device, which is brought up to date by the blocks that changed."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import byref, sizeof
from dataclasses import replace

import numpy as np
import pytest
import torch
from device_watch import DeviceWatch

from ggslam.abi.core import Voxel, VoxelMoments
from ggslam.abi.cuda import TrackJob, VoxelSlot
from ggslam.cuda.library import CudaLibrary
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.cuda.target import CudaTarget
from ggslam.tracking.engine import CpuTrackingEngine
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface

FREE = 2**64 - 1
Contents = dict[int, tuple[int, bytes, bytes]]


class Copy:
    """A `CudaTarget` as its engine uses it."""

    def __init__(self, library: CudaLibrary, device: torch.device) -> None:
        self.library, self.device = library, device
        self.target, self.job = CudaTarget(device), TrackJob()

    def bring(self, target: GicpTarget) -> None:
        """Up to date."""
        self.target.fill(target, self.job)
        if self.job.makes_levels:
            for level in (self.job.fine, self.job.coarse):
                level.stream = self.library.stream(self.device)
                self.library.call("voxel_level", byref(level))
        self.target.note_made()

    @property
    def was_sent_whole(self) -> bool:
        return bool(self.job.makes_levels and self.job.fine.empties and self.job.coarse.empties)

    @property
    def sent(self) -> int:
        """Voxels that the last one took."""
        return (self.job.fine.voxel_count + self.job.coarse.voxel_count) if self.job.makes_levels else 0

    def contents(self, level: int) -> Contents:
        """By key: which voxels a block has, and these, and their moments if it is made of those."""
        block = self.target._memory._block
        of_level = block.pieces(block.sizes)[1 + level :: 2]
        widths = sizeof(VoxelSlot), sizeof(Voxel), sizeof(VoxelMoments)
        slots, voxels, moments = (self.rows(*part) for part in zip(of_level, widths, strict=True))
        slots = slots.view(np.uint64)
        found: Contents = {}
        for key, occupied, first, _ in slots[slots[:, 0] != FREE].tolist():
            assert key not in found
            at = slice(first, first + occupied.bit_count())
            made = bool((self.job.coarse if level else self.job.fine).new_moments)
            found[key] = occupied, voxels[at].tobytes(), moments[at].tobytes() if made else b""
        return found

    @staticmethod
    def rows(memory: torch.Tensor, width: int) -> np.ndarray:
        values = memory.cpu().numpy()
        return values[: len(values) // width * width].reshape(-1, width)


def is_like(copy: Copy, target: GicpTarget) -> bool:
    """Whether the copy is what it would be had it never known another target."""
    fresh = Copy(copy.library, copy.device)
    fresh.bring(target)
    assert fresh.was_sent_whole
    same = [copy.contents(level) == fresh.contents(level) for level in (0, 1)]
    return all(same) and len(target) == sum(occupied.bit_count() for occupied, *_ in fresh.contents(0).values())


@pytest.fixture
def copy(cuda_library: CudaLibrary, engine: CudaTrackingEngine) -> Copy:
    return Copy(cuda_library, engine.device)


@pytest.fixture(scope="module")
def views(frames: list[Frame], native: CpuTrackingEngine) -> list[tuple[FramePoints, np.ndarray]]:
    """Points of frames, and where they were seen from."""
    found = []
    for frame in frames:
        assert frame.T_world_camera is not None
        found.append((native.points(frame.depth, PointSettings(count=1200), DepthNoise()), frame.T_world_camera))
    return found


@pytest.mark.parametrize("finish", [False, True])
@pytest.mark.parametrize("change", [{}, {"neighbour_weight": 0.0}])
def test_after_every_keyframe_the_copy_is_what_a_whole_one_is(
    copy: Copy, views: list[tuple[FramePoints, np.ndarray]], finish: bool, change: dict[str, float]
) -> None:
    surface = MeasuredSurface(replace(TrackerSettings().target, **change), NativeContext(2))
    surface.finish = finish
    for number, (points, T) in enumerate(views):
        away = se3_exp(np.array([1.5 * (number // 2), 0, 0, 0, 0, 0]))
        copy.bring(surface.add(points, away @ T))
        assert copy.was_sent_whole == (number == 0)
        assert is_like(copy, surface.target)  # type: ignore[arg-type]
    before = copy.sent
    copy.bring(surface.target)  # type: ignore[arg-type]
    assert copy.sent == 0 < before < 0.6 * len(surface.target)  # type: ignore[arg-type]


Change = Callable[[MeasuredSurface], object]
CORRECTIONS: dict[str, Change] = {
    "a loop is closed": lambda s: s.arrange({0, 1, 2, 3}, np.array([se3_exp(np.full(6, 0.02)) @ T for T in s.poses])),
    "keyframes are put aside": lambda s: s.arrange({1, 3}),
    "pixels are dropped": lambda s: s.drop_pixels(np.zeros((CAMERA.height, CAMERA.width), bool), 1.5, CAMERA),
    "pixels of one are dropped": lambda s: s.drop_pixels_of({2: (LEFT, CAMERA)}),
    "it is gathered again": lambda s: s.gather_again(),
}  # fmt: skip
CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
LEFT = np.zeros((120, 160), bool)
LEFT[:, :80] = True


@pytest.mark.parametrize("what", CORRECTIONS)
def test_after_a_correction_the_copy_is_made_anew_and_grows_on(
    copy: Copy, views: list[tuple[FramePoints, np.ndarray]], what: str
) -> None:
    surface = MeasuredSurface(TrackerSettings().target, NativeContext(1))
    surface.finish = False
    for points, T in views[:4]:
        copy.bring(surface.add(points, T))
    CORRECTIONS[what](surface)
    assert surface.target is not None
    copy.bring(surface.target)
    assert copy.was_sent_whole and is_like(copy, surface.target)
    for points, T in views[4:7]:
        copy.bring(surface.add(points, T))
        assert not copy.was_sent_whole and is_like(copy, surface.target)
    copy.bring(surface.arrange(set(range(7))))  # those that were put aside join
    assert not copy.was_sent_whole and is_like(copy, surface.target)


def test_versions_may_be_left_out_and_come_back(copy: Copy, views: list[tuple[FramePoints, np.ndarray]]) -> None:
    surface = MeasuredSurface(TrackerSettings().target, NativeContext(2))
    surface.finish = False
    targets = [surface.add(points, T) for points, T in views]
    for number, back in ((0, True), (1, False), (4, False), (9, False), (9, False), (3, True), (5, False), (0, True)):
        copy.bring(targets[number])
        assert copy.was_sent_whole == back and is_like(copy, targets[number])
    copy.bring(targets[2])
    assert not copy.was_sent_whole and is_like(copy, targets[2])


def test_what_did_not_arrive_is_sent_again(copy: Copy, views: list[tuple[FramePoints, np.ndarray]]) -> None:
    surface = MeasuredSurface(TrackerSettings().target, NativeContext(1))
    surface.finish = False
    one, two, three = (surface.add(points, T) for points, T in views[:3])
    copy.bring(two)
    copy.target.stage(three)
    copy.target.fill(three, copy.job)  # and then the call of the kernels fails
    copy.target.stage(three)  # beside it, by a thread that does not know
    for target in (three, two, one):
        copy.bring(target)
        assert copy.was_sent_whole and is_like(copy, target)


def test_a_keyframe_goes_up_in_one_copy_from_memory_that_is_there(frames: list[Frame]) -> None:
    with DeviceWatch() as watch:
        engine = CudaTrackingEngine(frames[0].camera, library=watch.library)
        surface = MeasuredSurface(TrackerSettings().target, NativeContext(1))
        surface.finish, surface.prepare = False, engine.expect_target
        settings, noise, align = PointSettings(count=1200), DepthNoise(), AlignSettings(coarse_points=400)
        sent, blocks = [], set[int]()
        for turn in range(3):
            for frame in frames:
                points, T = engine.points(frame.depth, settings, noise), frame.T_world_camera
                assert T is not None
                if surface.target is not None:
                    watch.forget()
                    reserved = engine._target._memory._reserved
                    engine.align(points, surface.target, T, align, noise)
                    assert engine._target._memory._block is reserved  # allocated when the keyframe came
                    blocks.add(reserved.address)
                    assert len(watch.uploads) == 1 and not watch.uploads[0].blocking
                    sent.append(watch.uploads[0].bytes)
                surface.add(points, T)
            if turn == 0:
                room = engine._target._upload._buffer.data_ptr(), engine._target._memory.address
        assert room == (engine._target._upload._buffer.data_ptr(), engine._target._memory.address)
        assert 1 < len(blocks) < len(frames)
        # The third time around nothing is new: what is sent goes with a keyframe.
        assert max(sent[-10:]) < 1.1 * max(sent[10:20])
