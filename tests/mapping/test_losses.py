# SPDX-License-Identifier: Apache-2.0
"""The compiled loss against the float64 torch reference: values and every gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from losses_reference import reference_loss

from ggslam.errors import ConfigError, RenderError
from ggslam.mapping.cpu.losses import CpuImageLoss, CpuLossResult
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.native.loader import NativeContext, available_instruction_sets

EXPOSURE = np.array([[1.1, 0.02], [0.9, -0.03], [1.05, 0.01]])
SETTINGS = {
    "default": LossSettings(),
    "l1 only": LossSettings(dssim_weight=0.0),
    "ssim only": LossSettings(dssim_weight=1.0, depth_weight=0.0),
    "charbonnier": LossSettings(color_kind="charbonnier", charbonnier_epsilon=0.01),
    "charbonnier only": LossSettings(color_kind="charbonnier", dssim_weight=0.0),
    "normalised depth": LossSettings(depth_kind="normalised", minimum_alpha=0.3),
    "no colour without depth": LossSettings(no_depth_weight=0.0),
    "some colour without depth": LossSettings(no_depth_weight=0.3, dssim_weight=0.5),
    "opacity": LossSettings(opacity_weight=0.7),
    "all": LossSettings(
        dssim_weight=0.4, depth_weight=2.0, depth_kind="normalised", minimum_alpha=0.1, color_kind="charbonnier",
        charbonnier_epsilon=0.02, no_depth_weight=0.6, opacity_weight=0.3,
    ),
}  # fmt: skip
SIZES = [(37, 53), (7, 9), (1, 1), (130, 33), (64, 64), (11, 200)]


@dataclass
class View:
    image: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor


def make_case(
    height: int, width: int, seed: int = 0, exposure: np.ndarray | None = EXPOSURE, float_depth: bool = False
) -> tuple[View, LossTarget]:
    """A noisy target and a view that is near it, with missing depth and colours beyond [0, 1]."""
    random = np.random.default_rng(seed)
    ramp = np.linspace(0, 1, width)[None, :, None] * np.linspace(1, 0.3, height)[:, None, None]
    texture = np.clip(0.8 * ramp + 0.2 * random.random((height, width, 3)), 0, 1)
    image = texture + 0.1 * random.normal(size=texture.shape)
    metres = 1 + 3 * random.random((height, width))
    metres[random.random((height, width)) < 0.3] = 0
    depth, scale = (metres * 5000).astype(np.uint16), 1 / 5000
    if float_depth:
        depth, scale = metres.astype(np.float32), 1.0
        depth[0, 0] = np.nan
        depth[-1, -1] = np.inf
    view = View(
        torch.from_numpy(image.transpose(2, 0, 1).copy()).float(),
        torch.from_numpy(metres + 0.1 * random.normal(size=metres.shape)).float(),
        torch.from_numpy(random.uniform(0, 1, metres.shape)).float(),
    )
    return view, LossTarget((255 * texture).astype(np.uint8), depth, scale, exposure)


def assert_agrees(result: CpuLossResult, view: View, target: LossTarget, settings: LossSettings) -> None:
    exposure = np.tile([1.0, 0.0], (3, 1)) if target.exposure is None else target.exposure
    # The core holds exposure and scale as float32: the reference starts from the same numbers.
    arguments = [view.image, view.depth, view.alpha, torch.from_numpy(exposure.astype(np.float32))]
    leaves = [value.double().requires_grad_() for value in arguments]
    expected = reference_loss(*leaves, replace(target, depth_scale=float(np.float32(target.depth_scale))), settings)
    expected["total"].backward()
    for name, value in expected.items():
        if name == "ssim" and settings.dssim_weight == 0:
            assert np.isnan(result.values.ssim)
            continue
        tolerance = 1e-4 if name == "psnr" else 1e-5
        assert getattr(result.values, name) == pytest.approx(value.item(), rel=tolerance, abs=2e-6, nan_ok=True), name
    found = [result.d_image, result.d_depth, result.d_alpha, torch.from_numpy(result.exposure_gradient)]
    for name, leaf, gradient in zip(("image", "depth", "alpha", "exposure"), leaves, found, strict=True):
        true = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        error = (gradient.double() - true).norm().item()
        assert error <= 2e-5 * true.norm().item() + 1e-9, f"gradient to {name}: off by {error}"
        assert (gradient.double() - true).abs().max() <= 1e-3 * true.abs().max() + 1e-9, f"gradient to {name}"


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
@pytest.mark.parametrize("name", SETTINGS)
def test_values_and_gradients_for_every_setting(name: str, instruction_set: str) -> None:
    view, target = make_case(37, 53)
    loss = CpuImageLoss(NativeContext(2, instruction_set))
    assert_agrees(loss.evaluate(view, target, SETTINGS[name]), view, target, SETTINGS[name])


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
def test_values_and_gradients_for_every_size(instruction_set: str) -> None:
    loss = CpuImageLoss(NativeContext(3, instruction_set))  # one instance: its scratch memory must follow the sizes
    for seed, (height, width) in enumerate(SIZES + SIZES[::-1]):
        view, target = make_case(height, width, seed)
        for name in ("default", "all"):
            assert_agrees(loss.evaluate(view, target, SETTINGS[name]), view, target, SETTINGS[name])


@pytest.mark.parametrize("float_depth", [False, True])
@pytest.mark.parametrize("exposure", [None, EXPOSURE, EXPOSURE.astype(np.float32)])
def test_kinds_of_input(float_depth: bool, exposure: np.ndarray | None) -> None:
    view, target = make_case(37, 53, exposure=exposure, float_depth=float_depth)
    loss = CpuImageLoss(NativeContext(2))
    assert_agrees(loss.evaluate(view, target, SETTINGS["all"]), view, target, SETTINGS["all"])


def laid_out(array: np.ndarray, how: str) -> np.ndarray:
    """The same numbers, lying otherwise in memory."""
    height, width, more = *array.shape[:2], array.shape[2:]
    if how in ("every second", "every third", "far apart"):
        n, room = (2 if how == "every second" else 3), 40_000 if how == "far apart" else 3 * width
        image = np.zeros((n * height, room, *more), array.dtype)
        view = image[1 : 1 + n * height : n, 1 : 1 + n * width : n]
        view[...] = array
        return view
    if how == "packed with others":
        rows = np.zeros((height, width), [("value", array.dtype, more), ("other", np.uint8)])
        rows["value"] = array
        return rows["value"]
    return np.asfortranarray(array) if how == "by columns" else np.ascontiguousarray(array[::-1])[::-1]


@pytest.mark.parametrize("float_depth", [False, True])
@pytest.mark.parametrize(
    "how", ["every second", "every third", "far apart", "packed with others", "by columns", "upside down"]
)
def test_targets_are_read_however_they_lie_in_memory(how: str, float_depth: bool) -> None:
    view, target = make_case(21, 34, float_depth=float_depth)
    valid = np.random.default_rng(1).random((21, 34)) < 0.9
    target, loss = replace(target, valid=valid), CpuImageLoss(NativeContext(2))
    expected = loss.evaluate(view, target, SETTINGS["all"])
    gradients = [g.clone() for g in (expected.d_image, expected.d_depth, expected.d_alpha)]
    for names in (("color", "depth", "valid"), ("depth",), ("color",)):
        other = replace(target, **{name: laid_out(getattr(target, name), how) for name in names})
        found = loss.evaluate(view, other, SETTINGS["all"])
        assert found.values == expected.values
        for a, b in zip(gradients, (found.d_image, found.d_depth, found.d_alpha), strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("name", SETTINGS)
def test_no_depth_anywhere(name: str) -> None:
    view, target = make_case(37, 53)
    target = replace(target, depth=np.zeros_like(target.depth))
    result = CpuImageLoss(NativeContext(2)).evaluate(view, target, SETTINGS[name])
    assert_agrees(result, view, target, SETTINGS[name])
    assert result.values.valid_pixels == 0 and np.isnan(result.psnr) and np.isnan(result.values.depth_l1_m)
    assert np.isfinite(result.values.total) and not result.d_depth.any() and not result.d_alpha.any()


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
@pytest.mark.parametrize("name", SETTINGS)
def test_what_shows_nothing_counts_for_nothing(name: str, instruction_set: str) -> None:
    view, target = make_case(37, 53)
    valid = np.ones((37, 53), bool)
    valid[:, :6], valid[30:, 40:] = False, False
    target = replace(target, valid=valid)
    loss = CpuImageLoss(NativeContext(2, instruction_set))
    result = loss.evaluate(view, target, SETTINGS[name])
    assert_agrees(result, view, target, SETTINGS[name])
    gradient, total = result.d_image.clone(), result.values.total
    assert not gradient[:, ~valid].any() and gradient[:, valid].any()
    black = replace(target, color=np.where(valid[..., None], target.color, 0).astype(np.uint8))
    again = loss.evaluate(view, black, replace(SETTINGS[name], dssim_weight=0.0))
    other = loss.evaluate(view, target, replace(SETTINGS[name], dssim_weight=0.0))
    assert again.values.color == pytest.approx(other.values.color) and np.isfinite(total)


def test_valid_pixels_of_another_size_are_refused() -> None:
    view, target = make_case(9, 9)
    for valid in (np.ones((9, 8), bool), np.ones((9, 9), np.uint8)):
        with pytest.raises(RenderError, match="target valid: .*bool"):
            CpuImageLoss(NativeContext(1)).evaluate(view, replace(target, valid=valid), LossSettings())


def test_perfect_view_has_no_loss() -> None:
    _, target = make_case(37, 53, exposure=None)
    depth = torch.from_numpy(target.depth.astype(np.float32) * np.float32(target.depth_scale))
    image = torch.from_numpy(target.color.transpose(2, 0, 1).astype(np.float32, order="C") * np.float32(1 / 255))
    result = CpuImageLoss(NativeContext(2)).evaluate(View(image, depth, torch.ones_like(depth)), target, LossSettings())
    assert result.values.total == pytest.approx(0, abs=1e-6) and result.values.ssim == pytest.approx(1, abs=1e-6)
    assert result.d_image.abs().max() < 1e-8 and not result.d_depth.any()


def test_constant_image_keeps_its_gradient_precise() -> None:
    """Variances are differences of nearly equal numbers where the image is flat: the worst case for float32."""
    color = np.full((60, 70, 3), 230, np.uint8)
    image = torch.full((3, 60, 70), 0.85) + 0.01 * torch.rand(3, 60, 70, generator=torch.Generator().manual_seed(1))
    view = View(image, torch.ones(60, 70), torch.ones(60, 70))
    target, settings = LossTarget(color, np.full((60, 70), 5000, np.uint16), 1 / 5000), LossSettings()
    leaf = image.double().requires_grad_()
    exposure = torch.tensor([[1.0, 0.0]] * 3, dtype=torch.float64)
    reference_loss(leaf, view.depth.double(), view.alpha.double(), exposure, target, settings)["total"].backward()
    result = CpuImageLoss(NativeContext(2)).evaluate(view, target, settings)
    assert leaf.grad is not None
    assert (result.d_image.double() - leaf.grad).norm() < 1e-3 * leaf.grad.norm()


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
def test_same_bits_for_any_number_of_threads_and_any_call(instruction_set: str) -> None:
    view, target = make_case(190, 77)
    results = []
    for threads in (1, 2, 3):
        loss = CpuImageLoss(NativeContext(threads, instruction_set))
        for _ in range(2):
            result = loss.evaluate(view, target, SETTINGS["all"])
            results.append((result.values, result.d_image.clone(), result.d_depth.clone(), result.d_alpha.clone(),
                            result.exposure_gradient))  # fmt: skip
    for other in results[1:]:
        assert other[0] == results[0][0]
        assert all(torch.equal(a, b) for a, b in zip(other[1:4], results[0][1:4], strict=True))
        assert np.array_equal(other[4], results[0][4])


def test_buffers_are_reused_and_nothing_lingers() -> None:
    """A view full of NaN must not spoil the next evaluation."""
    view, target = make_case(37, 53)
    loss = CpuImageLoss(NativeContext(2))
    first = loss.evaluate(view, target, LossSettings())
    values, pointer = first.values, first.d_image.data_ptr()
    broken = View(*(torch.full_like(value, torch.nan) for value in (view.image, view.depth, view.alpha)))
    loss.evaluate(broken, target, LossSettings())
    again = loss.evaluate(view, target, LossSettings())
    assert again.values == values and again.d_image.data_ptr() == pointer


BAD_VIEWS = {
    "image size": ("image", torch.zeros(3, 8, 10)),
    "image channels": ("image", torch.zeros(4, 8, 9)),
    "image dtype": ("image", torch.zeros(3, 8, 9, dtype=torch.float64)),
    "image layout": ("image", torch.zeros(8, 9, 3).permute(2, 0, 1)),
    "depth size": ("depth", torch.zeros(9, 8)),
    "alpha dtype": ("alpha", torch.zeros(8, 9, dtype=torch.float16)),
}
BAD_TARGETS = {
    "color dtype": {"color": np.zeros((8, 9, 3), np.float32)},
    "color planar": {"color": np.zeros((3, 8, 9), np.uint8)},
    "color empty": {"color": np.zeros((0, 9, 3), np.uint8), "depth": np.zeros((0, 9), np.uint16)},
    "depth size": {"depth": np.zeros((8, 8), np.uint16)},
    "depth dtype": {"depth": np.zeros((8, 9), np.float64)},
    "depth scale": {"depth_scale": 0.0},
    "depth scale nan": {"depth_scale": float("nan")},
    "exposure shape": {"exposure": np.ones((2, 3))},
    "exposure nan": {"exposure": np.full((3, 2), np.nan)},
}


@pytest.mark.parametrize("name", BAD_VIEWS)
def test_wrong_view_is_refused(name: str) -> None:
    view, target = make_case(8, 9)
    field, value = BAD_VIEWS[name]
    setattr(view, field, value)
    with pytest.raises(RenderError, match=f"rendered {field}"):
        CpuImageLoss(NativeContext(1)).evaluate(view, target, LossSettings())


@pytest.mark.parametrize("name", BAD_TARGETS)
def test_wrong_target_is_refused(name: str) -> None:
    view, target = make_case(8, 9)
    with pytest.raises(RenderError, match="expected"):
        CpuImageLoss(NativeContext(1)).evaluate(view, replace(target, **BAD_TARGETS[name]), LossSettings())


@pytest.mark.parametrize(
    "wrong",
    [{"dssim_weight": 1.5}, {"depth_weight": -1.0}, {"no_depth_weight": float("nan")}, {"depth_kind": "median"},
     {"color_kind": "l2"}, {"minimum_alpha": 0.0}, {"charbonnier_epsilon": 0.0}],
)  # fmt: skip
def test_impossible_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        LossSettings(**wrong)
