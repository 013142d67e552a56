# SPDX-License-Identifier: Apache-2.0
"""Whole iterations on the device, map, pose and exposure together, for which the host never waits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from cuda_emulation import emulated_library
from rendering_scenes import CAMERA, POSE, relative_error
from test_cuda_training import make_case, moved_target, on_device
from test_cuda_waiting import FAR, tight_rasterizer
from test_fused_adam import SETTINGS as ADAM
from test_fused_adam import make_map

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.losses import CudaImageLoss
from ggslam.mapping.exposure import ExposureAdam, identity_exposure
from ggslam.mapping.keyframe import PoseAdam
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import ExposureSettings, LossSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import se3_exp

POSE_RATE = 1e-3
EXPOSURE = ExposureSettings(enabled=True)
VIEWS = (POSE, se3_exp(np.array([0.05, 0.0, 0.1, 0.0, 0.02, 0.0])) @ POSE)


@contextmanager
def no_waiting(device: torch.device) -> Iterator[None]:
    """Fails what waits for the device by torch, or asks the rasterizer to."""
    with pytest.MonkeyPatch.context() as forbidden:
        for name in ("cpu", "numpy", "tolist", "item", "__bool__", "nonzero"):
            forbidden.setattr(torch.Tensor, name, None)
        forbidden.setattr("ggslam.rendering.cuda.finished.Counter.wait", None)
        if device.type == "cuda":
            torch.cuda.set_sync_debug_mode("error")
        try:
            yield
        finally:
            if device.type == "cuda":
                torch.cuda.set_sync_debug_mode("default")


class DeviceTraining:
    """Trains a map, and the poses and exposures of two keyframes, on the device."""

    def __init__(self, gaussians: GaussianMap, rasterizer: CudaRasterizer, target: LossTarget) -> None:
        library, self.rasterizer, self.map = rasterizer.library, rasterizer, gaussians
        self.loss, self.states = CudaImageLoss(library=library), KeyframeStates(library=library)
        self.target = moved_target(target, rasterizer.device)
        for pose in VIEWS:
            self.states.append(pose, identity_exposure())

    def iterate(self, i: int) -> None:
        view = self.rasterizer.forward(self.map, CAMERA, self.states.pose(i))
        result = self.loss.evaluate(view, replace(self.target, exposure=self.states.exposure(i)), LossSettings())
        step = self.rasterizer.backward_step(
            self.map, result.d_image, result.d_depth, result.d_alpha, optimizer=ADAM
        )  # fmt: skip
        self.states.step(i, step.twist, result.results, self.rasterizer.last_overflowed, POSE_RATE, EXPOSURE)


def test_iterations_go_the_way_of_the_cpu(cuda_library: CudaLibrary) -> None:
    rasterizer, expected = CudaRasterizer(library=cuda_library, waits=False), make_map(0, 0)
    _, target = make_case(CAMERA.height, CAMERA.width)
    training = DeviceTraining(on_device(expected, rasterizer.device), rasterizer, target)
    training.iterate(0)  # waits, as nothing is known yet
    with no_waiting(rasterizer.device):
        for step in range(1, 8):
            training.iterate(step % 2)
    cpu, loss, total = CpuRasterizer(1), CpuImageLoss(NativeContext(1)), 0.0
    poses, exposures = list(VIEWS), [identity_exposure(), identity_exposure()]
    pose_adams, exposure_adams = [PoseAdam(), PoseAdam()], [ExposureAdam(EXPOSURE), ExposureAdam(EXPOSURE)]
    for step in range(8):
        i = step % 2
        seen = replace(target, exposure=exposures[i])
        result = loss.evaluate(cpu.forward(expected, CAMERA, poses[i]), seen, LossSettings())
        made = cpu.backward_step(expected, result.d_image, result.d_depth, result.d_alpha, optimizer=ADAM)
        poses[i] = pose_adams[i].step(poses[i], made.twist, POSE_RATE)
        exposures[i] = exposure_adams[i].step(exposures[i], result.exposure_gradient)
        total += result.values.total
    sums = training.states.read_sums()
    assert sums.iterations == 8 and sums.total == pytest.approx(total, rel=1e-4)
    assert sums.last_psnr == pytest.approx(result.psnr, rel=1e-4)
    assert np.abs(poses[0] - VIEWS[0]).max() > POSE_RATE
    np.testing.assert_allclose(training.states.read_poses(), poses, atol=0.02 * POSE_RATE)
    np.testing.assert_allclose(training.states.read_exposures(), exposures, atol=0.02 * EXPOSURE.rate)
    for name in PARAMETERS:
        tensor, wanted = getattr(training.map, name).cpu(), getattr(expected, name)
        assert not wanted.numel() or relative_error(tensor, wanted) < 1e-3, name


def test_an_iteration_that_runs_out_of_room_is_as_if_it_had_not_been(cuda_library: CudaLibrary) -> None:
    _, target = make_case(CAMERA.height, CAMERA.width)
    crowd = make_map(0, 0)
    crowd.log_scales.add_(1.0)
    for _ in range(5):
        crowd.append(crowd.take(torch.arange(len(crowd))))
    found = []
    for overflows in (True, False):
        rasterizer = tight_rasterizer(cuda_library) if overflows else CudaRasterizer(library=cuda_library, waits=False)
        training = DeviceTraining(on_device(crowd, rasterizer.device), rasterizer, target)
        rasterizer.forward(training.map, CAMERA, FAR)
        for i in (0, 0, 1) if overflows else (0, 1):
            training.iterate(i)
            rasterizer.overflows.cpu()  # the next one knows what room this one wanted
        assert rasterizer.overflows.tolist() == [int(overflows)]
        assert training.states.read_sums().iterations == 2
        found.append((training.map.means.cpu(), training.map.updates.cpu(), training.states.read_poses()))
    assert relative_error(found[0][0], found[1][0]) < 1e-6
    assert torch.equal(found[0][1], found[1][1])
    np.testing.assert_allclose(found[0][2], found[1][2], atol=0.02 * POSE_RATE)


def test_memory_that_grows_between_rendering_and_step_does_no_harm() -> None:
    """The view that was rendered from lies in a table that was replaced meanwhile."""
    rasterizer = CudaRasterizer(library=emulated_library(), waits=False)
    _, target = make_case(CAMERA.height, CAMERA.width)
    training, twists = DeviceTraining(make_map(0, 0), rasterizer, target), []
    image = torch.ones(3, CAMERA.height, CAMERA.width)
    for growing in (False, True):
        rasterizer.forward(training.map, CAMERA, training.states.pose(0))
        for _ in range(200 if growing else 0):
            training.states.append(np.eye(4), identity_exposure())
        twists.append(rasterizer.backward(image).twist)
    assert torch.equal(*twists) and twists[0].any()
