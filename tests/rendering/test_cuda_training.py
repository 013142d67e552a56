# SPDX-License-Identifier: Apache-2.0
"""Image loss and fused optimizer of the CUDA kernels against those of the CPU core: on the CPU by an emulation of CUDA,
and on a GPU where there is one."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from cuda_contract import moved
from cuda_emulation import emulated_library
from rendering_scenes import CAMERA, POSE, make_image_gradients, relative_error
from test_cuda_emulated import GuardedMemory
from test_fused_adam import SETTINGS as ADAM
from test_fused_adam import make_map

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.cuda.losses import CudaImageLoss, CudaLossResult
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS, RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap

STEP_TOLERANCE = {"cpu": 1e-4, "cuda": 3e-4}
"""Relative, of several steps; by the type of device. Parameters near one that move by a thousandth are rounded by about
1e-5 of their way, one way or the other by the processor, and Adam makes steps of full size of gradients so small that
their last digits count. On a GPU sums over a Gaussian's pixels change
their order."""
EXPOSURE = np.array([[1.1, 0.02], [0.9, -0.03], [1.05, 0.01]])
LOSSES = {
    "default": LossSettings(),
    "l1 only": LossSettings(dssim_weight=0.0),
    "ssim only": LossSettings(dssim_weight=1.0, depth_weight=0.0),
    "charbonnier": LossSettings(color_kind="charbonnier", charbonnier_epsilon=0.01, dssim_weight=0.0),
    "normalised depth": LossSettings(depth_kind="normalised", minimum_alpha=0.3),
    "no colour without depth": LossSettings(no_depth_weight=0.0),
    "all": LossSettings(
        dssim_weight=0.4, depth_weight=2.0, depth_kind="normalised", minimum_alpha=0.1, color_kind="charbonnier",
        charbonnier_epsilon=0.02, no_depth_weight=0.6, opacity_weight=0.3,
    ),
}  # fmt: skip


# --- image loss -----------------------------------------------------------------------------------------------------


def make_case(height: int, width: int, float_depth: bool = False) -> tuple[RenderBuffers, LossTarget]:
    """A noisy target and a view that is near it, with missing depth and colours beyond [0, 1]."""
    random = np.random.default_rng(height + width)
    ramp = np.linspace(0, 1, width)[None, :, None] * np.linspace(1, 0.3, height)[:, None, None]
    texture = np.clip(0.8 * ramp + 0.2 * random.random((height, width, 3)), 0, 1)
    metres = np.where(random.random((height, width)) < 0.3, 0, 1 + 3 * random.random((height, width)))
    depth, scale = (metres * 5000).astype(np.uint16), 1 / 5000
    if float_depth:
        depth, scale = metres.astype(np.float32), 1.0
        depth[0, 0], depth[-1, -1] = np.nan, np.inf
    view = RenderBuffers(
        torch.from_numpy(texture.transpose(2, 0, 1) + 0.1 * random.normal(size=(3, height, width))).float(),
        torch.from_numpy(metres + 0.1 * random.normal(size=metres.shape)).float(),
        torch.from_numpy(random.uniform(0, 1, metres.shape)).float(),
    )
    return view, LossTarget((255 * texture).astype(np.uint8), depth, scale, EXPOSURE)


def moved_target(target: LossTarget, device: torch.device) -> LossTarget:
    exposure = None if target.exposure is None else torch.from_numpy(target.exposure).float().to(device)
    color, depth = torch.from_numpy(target.color).to(device), torch.from_numpy(target.depth).to(device)
    valid = None if target.valid is None else torch.from_numpy(target.valid).to(device)
    return LossTarget(color, depth, target.depth_scale, exposure, valid)


def check_loss(loss: CudaImageLoss, view: RenderBuffers, target: LossTarget, settings: LossSettings) -> None:
    result = loss.evaluate(moved(view, loss.device), moved_target(target, loss.device), settings)
    expected = CpuImageLoss(NativeContext(1)).evaluate(view, target, settings)
    found = result.read_values()
    for name, value in vars(expected.values).items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-5, abs=1e-7, nan_ok=True), name
    tensors = {
        "d_image": (result.d_image, expected.d_image),
        "d_depth": (result.d_depth, expected.d_depth),
        "d_alpha": (result.d_alpha, expected.d_alpha),
        "exposure": (result.exposure_gradient, torch.from_numpy(expected.exposure_gradient)),
    }
    for name, (tensor, wanted) in tensors.items():
        assert tensor.shape == wanted.shape, name
        assert relative_error(tensor.cpu(), wanted) < 1e-5, name
        assert float((tensor.cpu() - wanted).abs().max()) <= 1e-4 * float(wanted.abs().max()), name


@pytest.mark.parametrize("name", LOSSES)
def test_loss_of_every_setting(cuda_library: CudaLibrary, name: str) -> None:
    check_loss(CudaImageLoss(library=cuda_library), *make_case(37, 53), LOSSES[name])


@pytest.mark.parametrize("size", [(1, 1), (7, 9), (16, 32), (17, 33), (40, 70)])
def test_loss_of_every_size(cuda_library: CudaLibrary, size: tuple[int, int]) -> None:
    loss = CudaImageLoss(library=cuda_library)
    for name in ("default", "all"):
        check_loss(loss, *make_case(*size), LOSSES[name])


def test_loss_of_other_inputs(cuda_library: CudaLibrary) -> None:
    loss = CudaImageLoss(library=cuda_library)
    view, target = make_case(37, 53, float_depth=True)
    check_loss(loss, view, target, LOSSES["all"])
    check_loss(loss, view, replace(target, exposure=None), LOSSES["all"])
    shown = np.arange(37 * 53).reshape(37, 53) % 53 > 8
    for name in ("default", "all"):
        check_loss(loss, view, replace(target, valid=shown), LOSSES[name])
    for name in ("default", "all"):
        check_loss(loss, view, replace(target, depth=np.zeros_like(target.depth)), LOSSES[name])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_loss_of_a_whole_image_on_a_gpu() -> None:
    check_loss(CudaImageLoss(), *make_case(480, 640), LOSSES["default"])


def copies(result: CudaLossResult) -> list[torch.Tensor]:
    return [value.cpu().clone() for value in vars(result).values()]


def test_loss_repeats_bit_for_bit_after_a_broken_view(cuda_library: CudaLibrary) -> None:
    loss = CudaImageLoss(library=cuda_library)
    view, host_target = make_case(37, 53)
    view, target = moved(view, loss.device), moved_target(host_target, loss.device)
    first = copies(loss.evaluate(view, target, LOSSES["all"]))
    broken = RenderBuffers(*(torch.full_like(value, torch.nan) for value in (view.image, view.depth, view.alpha)))
    loss.evaluate(broken, target, LOSSES["all"])
    again = copies(loss.evaluate(view, target, LOSSES["all"]))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_order_of_threads_does_not_matter_for_the_loss(other_order: None) -> None:
    check_loss(CudaImageLoss(library=emulated_library()), *make_case(37, 53), LOSSES["all"])


@pytest.mark.parametrize("name", ["default", "l1 only"])
def test_loss_does_not_depend_on_what_was_in_memory(name: str) -> None:
    view, target = make_case(37, 53)
    found = []
    for value in (0, 255):
        loss = CudaImageLoss(library=emulated_library())
        loss.memory = memory = GuardedMemory(value)
        found.append(copies(loss.evaluate(view, moved_target(target, loss.device), LOSSES[name])))
        assert memory.untouched()
    assert all(torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) for a, b in zip(*found, strict=True))


def test_wrong_images_are_refused() -> None:
    loss = CudaImageLoss(library=emulated_library())
    view, host_target = make_case(8, 9)
    target = moved_target(host_target, loss.device)
    for wrong in (
        {"color": target.color.float()}, {"color": target.color[:0]}, {"depth": target.depth[:4]},
        {"depth": target.depth.to(torch.int32)}, {"depth_scale": 0.0}, {"exposure": torch.ones(2, 3)},
    ):  # fmt: skip
        with pytest.raises(RenderError, match="expected"):
            loss.evaluate(view, replace(target, **wrong), LossSettings())
    for wrong in ({"image": view.image[:2]}, {"depth": view.depth.double()}, {"alpha": view.alpha.to("meta")}):
        with pytest.raises(RenderError, match=f"rendered {next(iter(wrong))}"):
            loss.evaluate(replace(view, **wrong), target, LossSettings())
    with pytest.raises(RenderError, match="contiguous"):
        loss.evaluate(replace(view, depth=torch.zeros(9, 8).T), target, LossSettings())


# --- optimizer ------------------------------------------------------------------------------------------------------


def on_device(gaussians: GaussianMap, device: torch.device) -> GaussianMap:
    copy = GaussianMap(gaussians.sh_degree, gaussians.feature_channels, device)
    copy.append({name: rows.to(device) for name, rows in gaussians.take(torch.arange(len(gaussians))).items()})
    return copy


def check_steps(library: CudaLibrary, expected: GaussianMap, settings: AdamSettings, steps: int = 4) -> None:
    """Both optimizers start from the same map; errors are relative to how far the parameters moved."""
    rasterizer, cpu, features = CudaRasterizer(library=library), CpuRasterizer(1), expected.feature_channels
    before = expected.updates.clone()
    start = {name: getattr(expected, name).clone() for name in PARAMETERS}
    found = on_device(expected, rasterizer.device)
    tolerance = STEP_TOLERANCE[rasterizer.device.type]
    for step in range(steps):
        gradients = make_image_gradients(CAMERA, features, seed=step)
        rasterizer.forward(found, CAMERA, POSE)
        given = moved(gradients, rasterizer.device).arguments()
        result = rasterizer.backward_step(found, *given, optimizer=settings)
        cpu.forward(expected, CAMERA, POSE)
        wanted = cpu.backward_step(expected, *gradients.arguments(), optimizer=settings)
        assert torch.equal(result.touched.cpu(), wanted.touched)
        assert relative_error(result.twist.cpu(), torch.as_tensor(wanted.twist)) < tolerance
    assert torch.equal(found.updates.cpu(), expected.updates)
    never = expected.updates == before
    assert never.any() and not never.all()
    for name in PARAMETERS:
        way, wanted_way = getattr(found, name).cpu() - start[name], getattr(expected, name) - start[name]
        assert not way[never].any(), name
        assert not way.numel() or relative_error(way, wanted_way) < tolerance, name
        for mine, other in zip(found.moments[name], expected.moments[name], strict=True):
            assert not other.numel() or relative_error(mine.cpu(), other) < tolerance, name


@pytest.mark.parametrize(("degree", "features"), [(0, 0), (0, 16), (1, 3), (2, 0), (3, 21)])
def test_steps_are_those_of_the_cpu(cuda_library: CudaLibrary, degree: int, features: int) -> None:
    check_steps(cuda_library, make_map(degree, features), ADAM)


@pytest.mark.skipif("GGSLAM_SANITIZER" in os.environ, reason="a sanitizer's compiler changes the order of sums")
@pytest.mark.parametrize(
    "settings",
    [
        ADAM, AdamSettings(decay=0.999, decay_floor=0.1), AdamSettings(beta1=0.0),
        AdamSettings(decayed_groups=("log_scales",), decay=0.9, falling_groups=("means", "quaternions", "sh_dc")),
    ],
)  # fmt: skip
def test_steps_of_gaussians_of_every_age(cuda_library: CudaLibrary, settings: AdamSettings) -> None:
    gaussians = make_map(1, 2)
    gaussians.updates.copy_(torch.logspace(0, 4.5, len(gaussians)).to(torch.int32) - 1)
    for _, second in gaussians.moments.values():
        second.fill_(1e-4)
    check_steps(cuda_library, gaussians, settings, steps=2)


def test_bias_correction_of_the_first_step_is_precise(cuda_library: CudaLibrary) -> None:
    """1 - beta2^u is a small difference then."""
    check_steps(cuda_library, make_map(0, 3), AdamSettings(beta2=0.9999), steps=1)


def test_order_of_threads_does_not_matter_for_the_steps(other_order: None) -> None:
    check_steps(emulated_library(), make_map(1, 5), ADAM, steps=2)


def test_features_that_were_not_rendered_are_not_stepped(cuda_library: CudaLibrary) -> None:
    rasterizer = CudaRasterizer(library=cuda_library)
    gaussians = on_device(make_map(0, 4), rasterizer.device)
    before = gaussians.features.clone()
    rasterizer.forward(gaussians, CAMERA, POSE, features=False)
    gradient = torch.ones(3, CAMERA.height, CAMERA.width, device=rasterizer.device)
    rasterizer.backward_step(gaussians, gradient, optimizer=ADAM)
    assert torch.equal(gaussians.features, before) and gaussians.updates.any()


def test_an_empty_map_makes_no_step(cuda_library: CudaLibrary) -> None:
    rasterizer = CudaRasterizer(library=cuda_library)
    gaussians = GaussianMap(0, 4, rasterizer.device)
    rasterizer.forward(gaussians, CAMERA, POSE)
    gradient = torch.ones(3, CAMERA.height, CAMERA.width, device=rasterizer.device)
    assert not rasterizer.backward_step(gaussians, gradient, optimizer=ADAM).twist.any()


def test_wrong_steps_are_refused() -> None:
    rasterizer, gaussians = CudaRasterizer(library=emulated_library()), make_map(0, 0)
    gradient = torch.zeros(3, CAMERA.height, CAMERA.width)
    rasterizer.forward(gaussians, CAMERA, POSE)
    with pytest.raises(RenderError, match="rendered"):
        rasterizer.backward_step(make_map(0, 0), gradient, optimizer=ADAM)
    with pytest.raises(RenderError, match="grad_image"):
        rasterizer.backward_step(gaussians, gradient[:2], optimizer=ADAM)
    rasterizer.backward_step(gaussians, gradient, optimizer=ADAM)
    with pytest.raises(RenderError, match="forward"):
        rasterizer.backward_step(gaussians, gradient, optimizer=ADAM)
    plain = GaussianMap(with_moments=False)
    rasterizer.forward(plain, CAMERA, POSE)
    with pytest.raises(RenderError, match="moments"):
        rasterizer.backward_step(plain, gradient, optimizer=ADAM)


# --- both together ----------------------------------------------------------------------------------------------------


def test_training_on_a_keyframe_goes_the_same_way(cuda_library: CudaLibrary) -> None:
    """Forward, loss and step, some times over: the loss falls as on the CPU."""
    _, target = make_case(CAMERA.height, CAMERA.width)
    rasterizer, loss = CudaRasterizer(library=cuda_library), CudaImageLoss(library=cuda_library)
    cpu, cpu_loss = CpuRasterizer(1), CpuImageLoss(NativeContext(1))
    expected = make_map(0, 0)
    found, device_target = on_device(expected, rasterizer.device), moved_target(target, rasterizer.device)
    totals = []
    for _ in range(8):
        mine = loss.evaluate(rasterizer.forward(found, CAMERA, POSE), device_target, LossSettings())
        totals.append(mine.read_values().total)
        rasterizer.backward_step(found, mine.d_image, mine.d_depth, mine.d_alpha, optimizer=ADAM)
        other = cpu_loss.evaluate(cpu.forward(expected, CAMERA, POSE), target, LossSettings())
        cpu.backward_step(expected, other.d_image, other.d_depth, other.d_alpha, optimizer=ADAM)
        assert totals[-1] == pytest.approx(other.values.total, rel=1e-4)
    assert totals[-1] < totals[0]
