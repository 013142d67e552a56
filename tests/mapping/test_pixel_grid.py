# SPDX-License-Identifier: Apache-2.0
"""Steps on every second pixel."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from ggslam.mapping.cpu.identity import CpuIdentityLearner
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.identity import MaskOnGrid
from ggslam.mapping.identity_settings import IdentitySettings
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.labelling import KeyframeLabels
from ggslam.mapping.pixel_grid import PixelGrid, grid_of_turn
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import LOW_PASS
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import se3_exp

CAMERA = Camera(97, 70, 80.0, 82.0, 47.2, 35.9)
TURNED = se3_exp(np.array([0.05, -0.02, 0.01, 0.02, 0.03, 0]))


def wall(camera: Camera = CAMERA) -> Frame:
    """A wall of small waves."""
    v, u = np.indices((camera.height, camera.width))
    color = np.stack([128 + 100 * np.sin(u / 2), 128 + 100 * np.cos(v / 3), 100 + 50 * np.sin((u + v) / 5)], -1)
    return Frame(0, 0, 0.0, color.astype(np.uint8), (2.0 + 0.005 * u).astype(np.float32), camera)


def halves() -> np.ndarray:
    """Object 5 left, 9 right."""
    return np.where(np.arange(CAMERA.width) < 40, 5, 9).astype(np.uint16) * np.ones((CAMERA.height, 1), np.uint16)


def make_mapper(mask: np.ndarray | None = None, camera: Camera = CAMERA, noise_px: float = 0.5) -> CpuMapper:
    """A map of one keyframe."""
    learner = None if mask is None else CpuIdentityLearner(IdentitySettings(), seed=0)
    gaussians = GaussianMap(feature_channels=0 if mask is None else 16)
    mapper = CpuMapper(gaussians, MapperSettings(), NativeContext(2), 0, learner)
    mapper.depth_noise_px = noise_px
    mapper.add_keyframe(wall(camera), np.eye(4), lambda keyframe, show: KeyframeLabels(mask))
    return mapper


@pytest.mark.parametrize("turn", range(4))
def test_a_grid_shows_what_the_whole_image_shows_there(turn: int) -> None:
    gaussians, rasterizer, grid = make_mapper().map, CpuRasterizer(1), grid_of_turn(turn, CAMERA)
    whole = rasterizer.forward(gaussians, CAMERA, TURNED)
    expected = [grid.of(image.numpy().copy()) for image in (*whole.image, whole.depth, whole.alpha)]
    thin = rasterizer.forward(gaussians, grid.camera(CAMERA), TURNED, low_pass=grid.low_pass(LOW_PASS))
    for ours, theirs in zip((*thin.image, thin.depth, thin.alpha), expected, strict=True):
        assert ours.shape == theirs.shape and np.abs(ours.numpy() - theirs).max() < 2e-4
    other = rasterizer.forward(gaussians, grid.camera(CAMERA), TURNED)
    assert np.abs(other.image[0].numpy() - expected[0]).max() > 0.01


def test_in_four_turns_each_pixel_comes_once() -> None:
    count = np.zeros((CAMERA.height, CAMERA.width), int)
    for turn in range(3, 7):
        grid = grid_of_turn(turn, CAMERA)
        np.add.at(count, (slice(grid.row, None, 2), slice(grid.column, None, 2)), 1)
        camera = grid.camera(CAMERA)
        assert grid.of(count).shape == (camera.height, camera.width)
        assert np.allclose(camera.rays(), grid.of(CAMERA.rays()), atol=1e-6)
    assert (count == 1).all()
    assert grid_of_turn(1, Camera(97, 63, 80.0, 80.0, 48.0, 31.0)).is_whole


def steps_of(mapper: CpuMapper, iterations: int) -> list[tuple[int, int]]:
    """Sizes of the images that its steps look at, in so many iterations and as many of refinement."""
    sizes, evaluate = [], mapper._loss.evaluate

    def note(view, target, settings):  # type: ignore[no-untyped-def]
        sizes.append(target.color.shape[:2])
        return evaluate(view, target, settings)

    mapper._loss.evaluate = note  # type: ignore[method-assign]
    mapper.run(iterations)
    mapper.refine(iterations)
    assert mapper.times.iterations == 2 * iterations and mapper.times.steps == len(sizes)
    return sizes


def test_steps_are_on_half_the_rows_and_columns_but_the_last_ones_only_with_noisy_depth() -> None:
    turns = [(35, 49), (35, 48), (35, 48), (35, 49)]
    assert steps_of(make_mapper(), 2) == turns[:2] + turns[2:] + turns[:2]  # two steps an iteration at the end
    assert steps_of(make_mapper(noise_px=0.1), 2) == turns[:2] + 2 * [(70, 97)]
    small = Camera(60, 50, 70.0, 70.0, 29.5, 24.5)
    assert steps_of(make_mapper(camera=small), 2) == 4 * [(50, 60)]


def test_steps_on_a_map_that_is_partly_on_disk_are_on_all_pixels() -> None:
    mapper = make_mapper(noise_px=0.1)
    mapper.residency = Mock(trainable=lambda: [0], stages=lambda: [[0]])
    assert steps_of(mapper, 2) == 4 * [(70, 97)]


def test_a_loss_of_ones_own_and_a_dense_identity_image_see_all_pixels() -> None:
    mapper = make_mapper()
    mapper.extra_loss = lambda view, keyframe: torch.zeros(())
    assert set(steps_of(mapper, 1)) == {(70, 97)}
    mapper = make_mapper(halves())
    assert mapper.identity is not None
    mapper.identity.settings = dataclasses.replace(mapper.identity.settings, schedule="dense")
    assert set(steps_of(mapper, 1)) == {(70, 97)}


@pytest.mark.parametrize("known", [True, False])
def test_pixels_without_an_image_teach_nothing_on_a_grid(known: bool) -> None:
    """Where the camera shows nothing, white does not brighten the map."""
    mapper, valid = make_mapper(), np.ones((CAMERA.height, CAMERA.width), bool)
    valid[:, 30:51] = False
    mapper._valid[0] = valid if known else None
    mapper.keyframes[0].color[:, 30:51] = 255
    columns = mapper.map.means[:, 0] / mapper.map.means[:, 2] * CAMERA.fx + CAMERA.cx
    within = (columns > 34) & (columns < 46)
    before = mapper.map.rgb[within].mean()
    mapper.run(8)
    assert (mapper.map.rgb[within].mean() < before + 0.01) == known


def test_votes_on_grids_are_those_of_their_pixels() -> None:
    mapper = make_mapper(halves())
    mapper.run(60)
    ids = mapper.vote_labels()
    columns = (mapper.map.means[:, 0] / mapper.map.means[:, 2] * CAMERA.fx + CAMERA.cx).numpy()
    far = np.abs(columns - 39.5) > 3
    assert (np.where(columns < 39.5, 5, 9) == ids)[far].all() and set(ids) == {5, 9}
    assert mapper.identity is not None and mapper.identity.times.count == 60 // 7
    assert not mapper.identity._pools  # the next step has another grid: none are drawn ahead


def test_a_mask_on_a_grid() -> None:
    keyframe: Keyframe = make_mapper(halves()).keyframes[0]
    masked = MaskOnGrid.of(keyframe, PixelGrid(2, 1, 0))
    assert masked.index == 0 and masked.mask is not None and np.array_equal(masked.mask, halves()[1::2, ::2])
    assert MaskOnGrid.of(make_mapper().keyframes[0], PixelGrid(2, 1, 0)).mask is None
