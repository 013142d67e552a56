# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from ggslam.mapping.cpu.insertion import fill_gaussians
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, PoseAdam, make_keyframe
from ggslam.mapping.mapper import Mapper, MapperTuning
from ggslam.mapping.mean_map import AVERAGED
from ggslam.mapping.pixel_grid import PixelGrid
from ggslam.mapping.pruning import is_look_due, prune
from ggslam.mapping.settings import InsertionSettings, LearningRates, MapperSettings, PruningSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import se3_exp, se3_log
from ggslam.system.tuning import overridden

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(index: int = 0) -> Frame:
    """A coloured, slanted wall with a hole in its depth."""
    u, v = np.meshgrid(np.arange(80), np.arange(60))
    color = np.stack([128 + 100 * np.sin(u / 6), 128 + 100 * np.cos(v / 5), 100 + 50 * np.sin((u + v) / 9)], -1)
    depth = (2.0 + 0.005 * u).astype(np.float32)
    depth[20:30, 30:45] = 0
    return Frame(index, index, index / 30, color.astype(np.uint8), depth, CAMERA)


def make_mapper(threads: int = 2, **changes: object) -> Mapper:
    return CpuMapper(GaussianMap(), dataclasses.replace(MapperSettings(), **changes), NativeContext(threads))  # type: ignore[arg-type]


def test_a_keyframe_is_learned() -> None:
    mapper = make_mapper()
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(5)
    early = mapper.last_psnr
    mapper.run(60)
    assert mapper.last_psnr > max(30, early + 3)
    assert torch.isfinite(mapper.map.means).all() and mapper.map.updates.max() == 65


@pytest.mark.parametrize("degree", [0, 1])
def test_colours_stay_between_black_and_white(degree: int) -> None:
    """As far as they are alone: with a direction's part the sum counts."""
    mapper = CpuMapper(GaussianMap(degree), MapperSettings(), NativeContext(2))
    frame = wall()
    checks = np.indices(frame.depth.shape).sum(0) // 3 % 2
    frame = dataclasses.replace(frame, color=np.repeat(255 * checks[..., None], 3, 2).astype(np.uint8))
    mapper.add_keyframe(frame, np.eye(4))
    mapper.run(8)
    mapper.refine(7)
    rgb = mapper.map.rgb
    bounded = bool((rgb >= -1e-6).all() and (rgb <= 1 + 1e-6).all())
    assert bounded == (degree == 0)


def test_what_is_explained_is_not_inserted_again() -> None:
    mapper = make_mapper()
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(20)
    before = len(mapper.map)
    mapper.add_keyframe(wall(1), np.eye(4))
    assert len(mapper.map) - before < 0.05 * before
    mapper.add_keyframe(wall(2), se3_exp(np.array([0, 0, 0, 0, 0.6, 0])))
    assert len(mapper.map) - before > 0.2 * before


@pytest.mark.parametrize("threads", [1, 3])
def test_training_repeats_bit_for_bit(threads: int) -> None:
    maps = []
    for count in (2, threads):
        mapper = make_mapper(count)
        mapper.add_keyframe(wall(), np.eye(4))
        mapper.add_keyframe(wall(1), se3_exp(np.array([0.02, 0, 0, 0, 0.02, 0])))
        mapper.run(12)
        maps.append(mapper)
    assert torch.equal(maps[0].map.means, maps[1].map.means) and torch.equal(maps[0].map.sh, maps[1].map.sh)
    assert np.array_equal(maps[0].keyframes[1].T_camera_world, maps[1].keyframes[1].T_camera_world)


def test_the_pose_of_a_keyframe_finds_back() -> None:
    """A second view of the same wall, inserted with an error of a centimetre, is pulled to where it belongs."""
    insertion = InsertionSettings(depth_tolerance_m=1.0, alpha_threshold=0.0)  # the second view inserts nothing
    mapper = make_mapper(insertion=insertion)
    mapper.depth_sigma = 0.004
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(80)
    error = np.array([0.01, -0.008, 0.0, 0, 0, 0])
    keyframe = mapper.add_keyframe(wall(1), se3_exp(error))
    mapper.run(240)  # both views in turn: the first holds the map in place
    left = np.linalg.norm(se3_log(keyframe.T_world_camera)[:3])
    assert left < 0.35 * np.linalg.norm(error[:3])
    assert np.array_equal(mapper.keyframes[0].T_camera_world, np.eye(4))  # the first one is the world


def test_exact_depth_leaves_poses_alone() -> None:
    mapper = make_mapper()
    mapper.depth_sigma = 0.0
    mapper.add_keyframe(wall(), np.eye(4))
    keyframe = mapper.add_keyframe(wall(1), np.eye(4))
    mapper.run(10)
    assert np.allclose(keyframe.T_camera_world, np.eye(4))


def test_exposure_follows_a_darker_keyframe() -> None:
    s = MapperSettings()
    mapper = make_mapper(exposure=dataclasses.replace(s.exposure, enabled=True, rate=1e-2))
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(60)
    frame = wall(1)
    dark = dataclasses.replace(frame, color=(frame.color * 0.8).astype(np.uint8))
    keyframe = mapper.add_keyframe(dark, np.eye(4))
    for _ in range(60):
        mapper.iterate(keyframe)
    assert np.all(keyframe.exposure[:, 0] < 0.95)
    assert np.array_equal(mapper.keyframes[0].exposure, np.tile([1.0, 0.0], (3, 1)))


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_refinement_improves(share: float) -> None:
    mapper = CpuMapper(GaussianMap(), MapperSettings(average_last=share), NativeContext(2))
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(20)
    seen: list[tuple[int, int]] = []
    before = mapper.last_psnr
    mapper.refine(100, lambda done, total: seen.append((done, total)))
    assert mapper.last_psnr > before and seen[-1] == (100, 100)


@pytest.mark.parametrize("share, decay", [(0.0, 0.1), (0.5, 1.0)])
def test_rates_fall_unless_the_map_is_averaged(share: float, decay: float, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = CpuMapper(GaussianMap(), MapperSettings(average_last=share, refine_decay=0.1), NativeContext(2))
    mapper.add_keyframe(wall(), np.eye(4))
    factors: list[tuple[float, float]] = []
    step = mapper._step
    monkeypatch.setattr(mapper, "_step", lambda k, both, *rest: (factors.append(both), step(k, both, *rest)))
    mapper.refine(5)
    assert np.allclose(factors, [(decay ** (i / 4), 0.1 ** (i / 4)) for i in range(5)])  # those of poses always fall


@pytest.mark.parametrize("steps, counted", [(12, range(7, 13)), (70, range(38, 71, 4))])
def test_the_map_becomes_the_mean_over_the_last_steps(steps: int, counted: range) -> None:
    """Of twelve steps the last half; of more one in four of these, the last one among them."""
    averaged, left = (
        CpuMapper(
            GaussianMap(1),
            MapperSettings(average_last=share, refine_decay=1.0, pruning=PruningSettings(max_scale_m=100)),
            NativeContext(2),
        )
        for share in (0.5, 0.0)
    )
    for mapper in (averaged, left):
        mapper.add_keyframe(wall(), np.eye(4))
        mapper.run(8)
    with overridden(MapperTuning, settling_means=1.0, settling_scales=1.0):  # as where nothing is averaged
        averaged.refine(steps)
    parts = []
    for step in range(1, steps + 1):
        left.refine(1)
        if step in counted:
            parts.append({name: getattr(left.map, name).clone() for name in AVERAGED})
    for name in AVERAGED:
        mean = torch.stack([part[name] for part in parts]).mean(0)
        assert torch.allclose(getattr(averaged.map, name), mean, atol=1e-5), name
        assert not torch.allclose(getattr(averaged.map, name), parts[-1][name], atol=1e-5)
    assert not averaged._mean.arrays  # the next refinement begins anew


def test_a_refinement_that_is_cut_off_leaves_the_mean_of_what_it_made() -> None:
    mapper = make_mapper(average_last=0.5)
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(8)

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mapper.refine(30, stop)  # told of the 20th step, the fifth that counts
    assert mapper._mean.count == 5
    mean, last = mapper._mean.arrays["means"].clone(), mapper.map.means.clone()
    mapper.end_refinement()
    assert torch.equal(mapper.map.means, mean) and not torch.equal(mapper.map.means, last)
    mapper.end_refinement()
    assert torch.equal(mapper.map.means, mean)


def test_holes_are_filled_at_the_nearest_depth() -> None:
    frame, s = wall(), InsertionSettings(fill_stride=3)
    new = fill_gaussians(frame.color, frame.depth, np.zeros((60, 80), np.float32), CAMERA, np.eye(4), s)
    rows, columns = np.divmod(new.pixels, 80)
    assert len(new.pixels) == 3 * 5 or 12 <= len(new.pixels) <= 20
    assert rows.min() >= 20 and rows.max() < 30 and columns.min() >= 30 and columns.max() < 45
    assert np.all(np.abs(new.means[:, 2] - (2.0 + 0.005 * columns)) < 0.06)
    nothing = np.zeros_like(frame.depth)
    assert len(fill_gaussians(frame.color, nothing, nothing, CAMERA, np.eye(4), s).pixels) == 0


def test_pruning_drops_transparent_huge_and_broken_gaussians() -> None:
    gaussians = GaussianMap()
    means = torch.zeros(4, 3)
    means[3] = float("nan")
    scales = torch.full((4, 3), 0.01)
    scales[1, 0] = 1.0
    logits = torch.tensor([2.0, 2.0, -6.0, 2.0])
    gaussians.insert(means, torch.tensor([[1.0, 0, 0, 0]] * 4), scales.log(), logits, torch.rand(4, 3))
    assert prune(gaussians, PruningSettings()) == 3 and len(gaussians) == 1


def test_keyframes_keep_depth_to_a_fifth_of_a_millimetre_and_drop_what_does_not_fit() -> None:
    frame = wall()
    frame.depth[0, 0] = 20.0
    keyframe = make_keyframe(0, frame, np.eye(4))
    assert keyframe.depth.dtype == np.uint16 and keyframe.depth[0, 0] == 0
    assert np.abs(keyframe.depth_m() - frame.depth)[5:, 5:].max() <= 1.01e-4


def test_pose_adam_ignores_a_gradient_that_is_no_number() -> None:
    T = np.eye(4)
    assert PoseAdam().step(T, np.full(6, np.nan), 1e-3) is T


def with_hidden(count: int, birth: int, **changes: object) -> Mapper:
    """The wall seen twice, and Gaussians far behind it that a keyframe is said to have inserted."""
    mapper = make_mapper(**changes)
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.run(30)
    mapper.add_keyframe(wall(1), se3_exp(np.array([0.02, 0, 0, 0, 0.02, 0])))
    at = torch.tensor([[0.4, 0.3, 4.0]]).repeat(count, 1)
    mapper.map.insert(
        at, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 3), -3.0), torch.full((count,), 2.0),
        torch.full((count, 3), 0.5), birth_keyframe=birth,
    )  # fmt: skip
    return mapper


def test_what_the_wall_hides_is_dropped() -> None:
    rates = LearningRates(log_scales=0.05, quaternions=0.012, fall_updates=32)  # with longer steps neighbours hide more
    mapper = with_hidden(50, birth=0, rates=rates)
    before = len(mapper.map)
    shown = mapper.render_view(CAMERA, np.eye(4)).image.clone()
    mapper.drop_hidden()
    assert not (mapper.map.means[:, 2] > 3.5).any()
    assert 50 <= before - len(mapper.map) < 0.3 * before
    assert (mapper.render_view(CAMERA, np.eye(4)).image - shown).abs().mean() < 0.01


@pytest.mark.parametrize("birth", [-1, 1])
def test_what_no_keyframe_or_the_newest_inserted_stays(birth: int) -> None:
    mapper = with_hidden(50, birth)
    mapper.drop_hidden()
    assert (mapper.map.means[:, 2] > 3.5).sum() == 50


def test_what_an_earlier_map_has_stays() -> None:
    mapper = with_hidden(50, birth=0)
    mapper.keyframes[0] = dataclasses.replace(mapper.keyframes[0], frame_index=FROM_EARLIER_RUN)
    mapper.drop_hidden()
    assert (mapper.map.means[:, 2] > 3.5).sum() == 50


def test_what_other_cameras_of_the_newest_instant_inserted_stays() -> None:
    mapper = with_hidden(50, birth=0)
    for keyframe in mapper.keyframes:
        keyframe.instant = 7
    mapper.drop_hidden()
    assert (mapper.map.means[:, 2] > 3.5).sum() == 50


def test_few_keyframes_look_with_all_their_pixels() -> None:
    """Two keyframes, and Gaussians of a third of a pixel: each pixel's own is dropped by none."""
    mapper = make_mapper()
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.map.log_scales -= 1.2
    mapper.map.opacity_logits += 3
    mapper.add_keyframe(wall(1), np.eye(4))
    rendered = mapper.render_view(CAMERA, np.eye(4))
    pixels = np.arange(rendered.alpha.numel(), dtype=np.int32)
    shown = np.unique(mapper._rasterizer.pixel_terms(pixels, 32, 0.2).rows())
    before = mapper.map.means.clone()
    mapper.drop_hidden()
    kept = {tuple(row) for row in mapper.map.means.tolist()}
    assert len(shown) > 500 and all(tuple(row) in kept for row in before[shown].tolist())


def test_sizes_are_bounded_while_maps_are_trained() -> None:
    mapper = make_mapper()
    mapper.add_keyframe(wall(), np.eye(4))
    mapper.map.log_scales[:5] = 3.0
    mapper.refine(4)
    assert mapper.map.log_scales.max() <= np.log(mapper.settings.pruning.max_scale_m) + 1e-6


def test_hidden_gaussians_stay_if_so_wanted_or_if_not_all_keyframes_are_in_memory() -> None:
    mapper = with_hidden(50, 0, pruning=PruningSettings(min_weight=0))
    mapper.drop_hidden()
    assert (mapper.map.means[:, 2] > 3.5).sum() == 50

    class Partly:
        def trainable(self) -> list[int]:
            return [1]

    mapper = with_hidden(50, 0)
    mapper.residency = Partly()  # type: ignore[assignment]
    mapper.drop_hidden()
    assert (mapper.map.means[:, 2] > 3.5).sum() == 50


def test_looks_for_hidden_gaussians_get_rarer() -> None:
    assert [n for n in range(200) if is_look_due(n)] == [10, 20, 40, 80, 160]


def test_noisy_maps_lose_what_is_hidden_while_they_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    for noise, live, wanted in ((0.0, False, 0), (10.0, False, 1), (10.0, True, 0)):
        mapper = make_mapper()
        mapper.depth_noise_px, mapper.is_live = noise, live
        looks: list[int] = []
        monkeypatch.setattr(mapper, "drop_hidden", lambda looks=looks: looks.append(1))
        for n in range(11):
            mapper.add_keyframe(wall(n), np.eye(4))
        assert len(looks) == wanted


def test_steps_of_means_are_no_longer_than_half_a_pixel() -> None:
    mapper = make_mapper()
    rates = mapper.settings.rates
    assert mapper._standard_adam().learning_rates["means"] == rates.means
    assert mapper._standard_adam(settles=True).learning_rates["means"] == MapperTuning.settling_means * rates.means
    for pixel_m, wanted in ((0.008, rates.means), (0.001, 0.0005), (0.0002, 0.0001)):
        mapper.pixel_m = pixel_m
        assert mapper._standard_adam().learning_rates["means"] == pytest.approx(wanted)
        assert mapper._adam(0.1).learning_rates["means"] == pytest.approx(0.1 * wanted)


def test_a_pose_moves_half_as_far_by_a_step_on_a_quarter_of_the_pixels() -> None:
    """Two such steps make an iteration, which moves a pose as far as one on all pixels."""
    lengths = []
    for grid in (PixelGrid(), PixelGrid(2, 1, 0)):
        mapper = make_mapper()
        mapper.add_keyframe(wall(), np.eye(4))
        keyframe = mapper.add_keyframe(wall(1), se3_exp(np.array([0.02, -0.01, 0.01, 0.01, 0.02, 0.01])))
        before = keyframe.T_camera_world.copy()
        mapper._step(keyframe, (1.0, 1.0), grid, False)
        lengths.append(np.linalg.norm(se3_log(keyframe.T_camera_world @ np.linalg.inv(before))))
    assert lengths[1] > 0 and lengths[1] == pytest.approx(lengths[0] / 2, rel=0.02)
