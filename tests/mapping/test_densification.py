# SPDX-License-Identifier: Apache-2.0
"""Growth of the map where images pull at Gaussians."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
import pytest
import torch

from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.densification import DensificationTuning, ScreenGradients, densify
from ggslam.mapping.keyframe import make_keyframe
from ggslam.mapping.settings import MapperSettings, PruningSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import se3_exp, transform_points

CAMERA = Camera(80, 60, 70.0, 65.0, 38.0, 31.0)


def half_textured(index: int = 0) -> Frame:
    """A wall 2 m away: grey on the left, patches of 4 x 4 pixels of all colours on the right."""
    color = np.full((60, 80, 3), 120, np.uint8)
    color[:, 40:] = np.random.default_rng(0).integers(0, 256, (15, 10, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    return Frame(index, index, index / 30, color, np.full((60, 80), 2, np.float32), CAMERA)


def make_mapper(**changes: object) -> CpuMapper:
    return CpuMapper(GaussianMap(), dataclasses.replace(MapperSettings(), **changes), NativeContext(2))  # type: ignore[arg-type]


def test_gradients_are_those_by_the_place_in_the_image() -> None:
    """Of a u + b v, where (u, v) is the place in the image of half width and height 1, differentiated numerically."""
    keyframe = make_keyframe(0, half_textured(), se3_exp(np.array([0.3, -0.2, 0.1, 0.2, -0.3, 0.5])))
    random = np.random.default_rng(0)
    inside = np.column_stack([random.uniform(-0.8, 0.8, (20, 2)), random.uniform(1, 4, 20)])
    means = transform_points(inside * [1, 1, 1], keyframe.T_world_camera)
    slopes = random.normal(size=(20, 2))

    def value(points: np.ndarray) -> np.ndarray:
        p = transform_points(points, keyframe.T_camera_world)
        place = p[:, :2] / p[:, 2:] * [CAMERA.fx / 40, CAMERA.fy / 30]
        return (slopes * place).sum(1)

    shifts = 1e-6 * np.eye(3)
    gradient = np.stack([(value(means + s) - value(means - s)) / 2e-6 for s in shifts], 1)
    found = ScreenGradients.none(20)
    shown = np.arange(20) > 4
    found.add(keyframe, means, gradient, shown)
    found.add(keyframe, means, 3 * gradient, shown)
    assert np.allclose(found.mean, 2 * np.linalg.norm(slopes, axis=1) * shown, rtol=1e-6)
    assert np.allclose(found.nearest[shown], inside[shown, 2]) and np.isinf(found.nearest[~shown]).all()


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    mapper = make_mapper()
    mapper.add_keyframe(half_textured(), np.eye(4))
    mapper.run(3)
    gaussians = mapper.map
    gaussians.log_scales[:2] = float(np.log(0.001))
    gaussians.log_scales[2:4] = float(np.log(0.2))
    before = gaussians.take(torch.arange(len(gaussians)))
    count, strong = len(gaussians), np.zeros(len(gaussians))
    strong[[0, 2]] = 2 * DensificationTuning.least_gradient
    gradients = ScreenGradients(strong, np.ones(count, np.int64), np.full(count, 2.0))
    assert densify(gaussians, gradients, 7) == (1, 1)
    assert len(gaussians) == count + 2  # a clone, and two parts for a whole
    clone, parts = count - 1, slice(count, count + 2)
    for name in ("means", "log_scales", "opacity_logits", "sh", "birth_keyframe"):
        assert torch.equal(getattr(gaussians, name)[clone], before[name][0]), name
    assert not gaussians.updates[clone:].any() and not gaussians.moments["means"][0][clone:].any()
    assert torch.allclose(gaussians.log_scales[parts], before["log_scales"][2] - np.log(1.6))
    away = (gaussians.means[parts] - before["means"][2]).norm(dim=1)
    assert (away > 0.01).all() and (away < 0.8).all() and torch.equal(gaussians.means[2], before["means"][3])


@pytest.mark.parametrize(("way", "inserted"), [("never", 1.0), ("added", 1.0), ("instead", 1 / 8)])
def test_the_map_grows_where_there_is_texture(way: Literal["never", "added", "instead"], inserted: float) -> None:
    pruning = PruningSettings(every_keyframes=2, enabled=False)
    mapper = make_mapper(densification=way, pruning=pruning)
    mapper.add_keyframe(half_textured(), np.eye(4))
    usual = make_mapper()
    usual.add_keyframe(half_textured(), np.eye(4))
    first = len(mapper.map)
    assert first <= 1.01 * inserted * len(usual.map)
    mapper.run(30)
    early = mapper.last_psnr
    mapper.add_keyframe(half_textured(1), np.eye(4))
    columns = CAMERA.project(mapper.map.means[mapper.map.updates == 0].numpy())[1]
    if way == "never":
        assert len(columns) < 0.02 * first
        return
    inner = columns[(columns > 8) & (columns < 72)]  # at the image's border half of a Gaussian is seen
    assert len(mapper.map) > 1.1 * first and (inner >= 36).mean() > 0.8
    mapper.run(60)
    assert mapper.last_psnr > early + 1


def test_growth_repeats_bit_for_bit() -> None:
    maps = []
    for _ in range(2):
        mapper = make_mapper(densification="added", pruning=PruningSettings(every_keyframes=2))
        for k in range(4):
            mapper.add_keyframe(half_textured(k), se3_exp(np.array([0.03 * k, 0, 0, 0, 0, 0])))
            mapper.run(6)
        maps.append(mapper.map)
    assert torch.equal(maps[0].means, maps[1].means) and torch.equal(maps[0].log_scales, maps[1].log_scales)


@pytest.mark.parametrize("enabled", [True, False])
def test_pruning_can_be_off(enabled: bool) -> None:
    mapper = make_mapper(pruning=PruningSettings(every_keyframes=2, enabled=enabled))
    mapper.add_keyframe(half_textured(), np.eye(4))
    mapper.map.opacity_logits[:50] = -8
    mapper.map.means[50:80, 2] = 5  # behind the wall
    first = len(mapper.map)
    mapper.run(30)
    mapper.add_keyframe(half_textured(1), np.eye(4))
    mapper.drop_hidden()
    assert (len(mapper.map) < first - 20) == enabled
