# SPDX-License-Identifier: Apache-2.0
"""The fused backward and Adam step against backward followed by a plain Adam in torch."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from rendering_scenes import CAMERA, POSE, make_image_gradients, make_scene

from ggslam.errors import RenderError
from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, Gradients
from ggslam.scene.gaussian_map import GaussianMap

RATES = {
    "means": 1e-3, "quaternions": 2e-3, "log_scales": 3e-3, "opacity_logits": 4e-3,
    "sh_dc": 5e-3, "sh_rest": 6e-3, "features": 7e-3,
}  # fmt: skip
SETTINGS = AdamSettings(
    RATES, beta1=0.8, beta2=0.95, epsilon=1e-8, decay=0.7, decay_floor=0.2, decayed_groups=("means",),
    falling_groups=("quaternions", "sh_dc"), fall_updates=1.5, fall_floor=0.6,
)  # fmt: skip


def make_map(degree: int, features: int) -> GaussianMap:
    scene = make_scene(300, features, (degree + 1) ** 2)
    gaussians = GaussianMap(degree, features)
    gaussians.insert(
        scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits, scene.sh[:, 0], scene.features
    )
    gaussians.sh.copy_(scene.sh)
    return gaussians


class PlainAdam:
    """Adam on touched rows only, with per-row counts; as simple as it can be written."""

    def __init__(self, gaussians: GaussianMap, settings: AdamSettings) -> None:
        self.settings = settings
        self.values = {name: getattr(gaussians, name).double().clone() for name in PARAMETERS}
        self.first = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self.second = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self.updates = torch.zeros(len(gaussians), dtype=torch.int64)

    def rate(self, name: str, counts: torch.Tensor) -> torch.Tensor:
        """Learning rates, broadcastable to the rows of a parameter."""
        s, shape = self.settings, (-1, *[1] * (self.values[name].ndim - 1))

        def group(key: str) -> torch.Tensor:
            factor = torch.ones(len(counts), dtype=torch.float64)
            if key in s.decayed_groups:
                factor = (s.decay ** (counts - 1.0)).clamp_min(s.decay_floor)
            if key in s.falling_groups:
                factor = (1 / (1 + (counts - 1.0) / s.fall_updates).sqrt()).clamp_min(s.fall_floor)
            return (s.learning_rates.get(key, 0.0) * factor).view(shape)

        if name != "sh":
            return group(name)
        rest = self.values["sh"].shape[1] - 1
        return torch.cat([group("sh_dc"), group("sh_rest").expand(-1, rest, -1)], 1)

    def step(self, gradients: Gradients) -> None:
        s, rows = self.settings, gradients.touched.bool()
        self.updates[rows] += 1
        counts = self.updates[rows].double()
        for name in PARAMETERS:
            gradient = getattr(gradients, name)
            if gradient is None:
                continue
            gradient, counted = gradient[rows].double(), counts.view(-1, *[1] * (gradient.ndim - 1))
            first = self.first[name][rows] = s.beta1 * self.first[name][rows] + (1 - s.beta1) * gradient
            second = self.second[name][rows] = s.beta2 * self.second[name][rows] + (1 - s.beta2) * gradient**2
            corrected = second / (1 - s.beta2**counted)
            step = self.rate(name, counts) * first / (1 - s.beta1**counted) / (corrected.sqrt() + s.epsilon)
            self.values[name][rows] -= step


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
@pytest.mark.parametrize(("degree", "features"), [(0, 0), (0, 16), (1, 3), (2, 0), (3, 21)])
def test_fused_step_is_backward_and_plain_adam(instruction_set: str, degree: int, features: int) -> None:
    gaussians = make_map(degree, features)
    plain, start = PlainAdam(gaussians, SETTINGS), {name: getattr(gaussians, name).clone() for name in PARAMETERS}
    rasterizer = CpuRasterizer(2, instruction_set)
    for step in range(4):
        rasterizer.forward(gaussians, CAMERA, POSE)
        gradients = make_image_gradients(CAMERA, features, seed=step).arguments()
        expected = rasterizer.backward(*gradients)
        found = rasterizer.backward_step(gaussians, *gradients, optimizer=SETTINGS)
        plain.step(expected)
        assert torch.equal(found.touched, expected.touched)
        assert (found.twist == expected.twist).all()
    assert torch.equal(gaussians.updates.long(), plain.updates)
    never = plain.updates == 0
    for name in PARAMETERS:
        value = getattr(gaussians, name)
        assert torch.allclose(value.double(), plain.values[name], atol=2e-6, rtol=1e-5), name
        assert torch.equal(value[never], start[name][never]), name
        first, second = gaussians.moments[name]
        assert torch.allclose(first.double(), plain.first[name], rtol=1e-4, atol=1e-6), name
        assert torch.allclose(second.double(), plain.second[name], rtol=1e-4, atol=1e-9), name


def test_features_that_were_not_rendered_are_not_updated() -> None:
    gaussians = make_map(0, 4)
    before = gaussians.features.clone()
    rasterizer = CpuRasterizer(1)
    rasterizer.forward(gaussians, CAMERA, POSE, features=False)
    rasterizer.backward_step(gaussians, *make_image_gradients(CAMERA, 0).arguments(), optimizer=SETTINGS)
    assert torch.equal(gaussians.features, before)
    assert gaussians.updates.any()


@pytest.mark.parametrize("threads", [2, 3, 4])
def test_fused_step_does_not_depend_on_the_threads(threads: int) -> None:
    results = []
    for count in (1, threads):
        gaussians, rasterizer = make_map(1, 5), CpuRasterizer(count)
        for step in range(3):
            rasterizer.forward(gaussians, CAMERA, POSE)
            gradients = make_image_gradients(CAMERA, 5, seed=step)
            rasterizer.backward_step(gaussians, *gradients.arguments(), optimizer=SETTINGS)
        results.append(gaussians)
    assert all(torch.equal(getattr(results[0], name), getattr(results[1], name)) for name in PARAMETERS)


def test_schedule_settles_and_is_clamped() -> None:
    schedule = SETTINGS.schedule().double()
    update = torch.arange(1, len(schedule) + 1, dtype=torch.float64)
    means = 1e-3 * (0.7 ** (update - 1)).clamp_min(0.2) / (1 - 0.8**update)
    assert torch.allclose(schedule[:, 0], means, rtol=1e-6)
    quaternions = 2e-3 * (1 / (1 + (update - 1) / 1.5).sqrt()).clamp_min(0.6) / (1 - 0.8**update)
    assert torch.allclose(schedule[:, 1], quaternions, rtol=1e-6)
    assert torch.allclose(schedule[:, 7], 1 / torch.sqrt(1 - 0.95**update), rtol=1e-6)
    assert abs(float(schedule[-1, 7]) - 1) < 1e-6 and abs(float(schedule[-1, 1]) - 1.2e-3) < 1e-8
    assert abs(float(schedule[-1, 2]) - 3e-3) < 1e-8
    assert SETTINGS.schedule() is SETTINGS.schedule()


def test_a_schedule_is_long_enough_for_the_fall() -> None:
    settings = AdamSettings(decayed_groups=(), falling_groups=("means",), fall_updates=4.0, fall_floor=0.05)
    schedule = settings.schedule().double()
    assert len(schedule) >= 4 * (400 - 1) and float(schedule[-1, 0] / 1e-4) == pytest.approx(0.05, rel=1e-6)
    half = dataclasses.replace(settings, learning_rates={"means": 5e-5})
    assert torch.allclose(half.schedule()[:, 0].double(), schedule[:, 0] / 2, rtol=1e-6)
    assert torch.equal(half.schedule()[:, 7].double(), schedule[:, 7])


def test_wrong_steps_are_refused() -> None:
    gaussians, rasterizer = make_map(0, 0), CpuRasterizer(1)
    gradient = torch.zeros(3, CAMERA.height, CAMERA.width)
    rasterizer.forward(gaussians, CAMERA, POSE)
    with pytest.raises(RenderError, match="rendered"):
        rasterizer.backward_step(make_map(0, 0), gradient, optimizer=SETTINGS)
    rasterizer.backward_step(gaussians, gradient, optimizer=SETTINGS)
    with pytest.raises(RenderError, match="forward"):
        rasterizer.backward_step(gaussians, gradient, optimizer=SETTINGS)
    plain = GaussianMap(with_moments=False)
    rasterizer.forward(plain, CAMERA, POSE)
    with pytest.raises(RenderError, match="moments"):
        rasterizer.backward_step(plain, gradient, optimizer=SETTINGS)
    for wrong in (
        {"learning_rates": {"colour": 1.0}}, {"beta1": 1.0}, {"decay": 0.0}, {"falling_groups": ("means",)},
        {"decayed_groups": (), "falling_groups": ("colour",)}, {"fall_updates": 0.0}, {"fall_floor": 0.0},
    ):  # fmt: skip
        with pytest.raises(RenderError):
            AdamSettings(**wrong)  # type: ignore[arg-type]
