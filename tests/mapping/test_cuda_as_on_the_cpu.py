# SPDX-License-Identifier: Apache-2.0
"""What a device gives of the quality of maps is what the CPU gives: each part on the same input, by the emulation."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import torch
from cuda_emulation import emulated_library
from device_watch import DeviceWatch

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.between_frames import code_frame
from ggslam.mapping.comparing_mapper import ComparingMapper
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.cuda.mapper import CudaMapper
from ggslam.mapping.mean_map import AVERAGED, MeanMap
from ggslam.mapping.other_sizes import HalfSize, TwiceTheSize
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.pruning import blank_part
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, se3_exp

CAMERA = Camera(80, 64, 70.0, 70.0, 39.5, 31.5)
POSES = [se3_exp(np.array([0.06 * k, -0.02 * k, 0.0, 0.0, 0.03 * k, 0.0])) for k in range(4)]
SETTINGS = dataclasses.replace(MapperSettings(), close_below=0.0)


def wall(index: int = 0, gain: float = 1.0) -> Frame:
    """A coloured wall at z = 2 with a hole in its depth, from `POSES[index]`."""
    T = POSES[index]
    rays = CAMERA.rays().astype(float) @ T[:3, :3].T
    depth = (2 - T[2, 3]) / rays[..., 2]
    x, y, _ = np.moveaxis(T[:3, 3] + depth[..., None] * rays, -1, 0)
    color = np.stack([110 + 70 * np.sin(9 * x), 110 + 70 * np.cos(11 * y), 100 + 50 * np.sin(7 * (x + y))], -1)
    measured = depth.astype(np.float32)
    measured[20:26, 30:40] = 0
    return Frame(index, index, index / 30, np.rint(gain * color).clip(0, 255).astype(np.uint8), measured, CAMERA)


def both(settings: MapperSettings = SETTINGS, library: CudaLibrary | None = None) -> tuple[CpuMapper, CudaMapper]:
    """Mappers with the same map and keyframes, two of which have trained it on the CPU."""
    cpu = CpuMapper(GaussianMap(), settings, NativeContext(1))
    cpu.depth_sigma = 0.0  # poses stay
    for k in range(2):
        cpu.add_keyframe(wall(k), POSES[k])
        cpu.run(20)
    cpu.add_keyframe(wall(2), POSES[2])
    return cpu, on_device(cpu, library)


def on_device(cpu: CpuMapper, library: CudaLibrary | None = None) -> CudaMapper:
    library = library or emulated_library()
    device = CudaMapper(
        GaussianMap(device=library.whole_device(None)), cpu.settings, library, context=NativeContext(1)
    )  # fmt: skip
    device.load_map(cpu.map.copy(device.device), [dataclasses.replace(keyframe) for keyframe in cpu.keyframes])
    device.times.iterations, device._sampler = cpu.times.iterations, copy.deepcopy(cpu._sampler)
    for name in ("depth_sigma", "depth_noise_px", "pixel_m"):
        setattr(device, name, getattr(cpu, name))
    return device


def images(mapper: ComparingMapper) -> np.ndarray:
    return np.stack([mapper.render_view(CAMERA, inverse(T)).image.numpy().copy() for T in POSES])


def test_a_view_of_the_map_is_the_same() -> None:
    cpu, device = both()
    for name in ("image", "depth", "alpha"):
        one, other = (getattr(mapper.render_view(CAMERA, inverse(POSES[3])), name) for mapper in (cpu, device))
        assert (one.cpu() - other.cpu()).abs().max() < 2e-5


def test_the_same_rows_are_dropped_as_hidden() -> None:
    cpu, _ = both()
    behind = torch.tensor([[0.1, 0.05, 3.0]]).repeat(40, 1) + 0.01 * torch.arange(40)[:, None]
    cpu.map.insert(behind, torch.eye(1, 4).expand(40, 4), torch.full((40, 3), -3.5), 2.0, torch.full((40, 3), 0.5),
                   birth_keyframe=0)  # fmt: skip
    device = on_device(cpu)
    before = len(cpu.map)
    cpu.drop_hidden()
    device.drop_hidden()
    assert len(cpu.map) <= before - 40 and not (cpu.map.means[:, 2] > 2.5).any()
    kept = [{tuple(row) for row in mapper.map.means.cpu().tolist()} for mapper in (cpu, device)]
    assert kept[0] == kept[1]


def test_the_mean_of_maps_is_the_same() -> None:
    cpu, device = both()
    means = MeanMap(), MeanMap()
    for step in range(5):
        cpu.map.means += 0.01 * step
        cpu.map.sh *= 1 + 0.1 * step
        device.map.means.copy_(cpu.map.means)
        device.map.sh.copy_(cpu.map.sh)
        means[0].add(cpu.map)
        means[1].add(device.map)
    for mean, mapper in zip(means, (cpu, device), strict=True):
        mean.move_into(mapper.map)
    for name in AVERAGED:
        assert (getattr(cpu.map, name) - getattr(device.map, name).cpu()).abs().max() < 1e-5, name


@pytest.mark.parametrize("grid", [ALL_PIXELS, HalfSize(), TwiceTheSize()], ids=["own", "half", "twice"])
def test_losses_at_other_sizes_are_the_same(grid: PixelGrid) -> None:
    cpu, device = both()
    losses = []
    for mapper in (cpu, device):
        keyframe = mapper.keyframes[1]
        losses.append(mapper._evaluate_loss(keyframe, mapper._render(keyframe, False, grid), grid))
    ours, theirs = losses[1].read_values(), losses[0].values
    for name in ("color", "ssim", "depth", "psnr"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=2e-4), name
    assert ours.valid_pixels == theirs.valid_pixels
    difference = (losses[1].d_image.cpu() - losses[0].d_image).abs().mean() / losses[0].d_image.abs().mean()
    assert difference < 2e-3  # where colours are equal to rounding, the sign of their difference may be another


def with_between(mapper: ComparingMapper) -> ComparingMapper:
    dark = dataclasses.replace(wall(1, 0.9), index=7)
    beside = code_frame(dataclasses.replace(wall(3), index=8), 1, inverse(POSES[1]) @ POSES[3])
    mapper.between = [beside, code_frame(dark, 1, np.eye(4))]
    return mapper


def test_frames_between_keyframes_are_kept_in_their_order() -> None:
    cpu, device = both()
    for mapper in (cpu, device):
        for number in range(12):
            mapper.keep_between(dataclasses.replace(wall(1), index=number), 1, POSES[number % 4])
        assert list(mapper._find_beside([1]).values()) == [list(range(12))]
    for one, other in zip(cpu.between, device.between, strict=True):
        assert one.frame_index == other.frame_index and np.array_equal(one.color, other.color)
        assert np.array_equal(one.T_keyframe_camera, other.T_keyframe_camera)


def test_frames_between_keyframes_are_seen_and_judged_the_same() -> None:
    cpu, device = map(with_between, both())
    keyframe = device.keyframes[1]
    T = se3_exp(np.array([0.1, 0.0, 0.2, 0.0, 0.1, 0.0])) @ keyframe.T_camera_world
    keyframe.T_camera_world = T  # the view goes along
    view = device._view_beside(device.between[0], keyframe)
    expected = inverse(POSES[3]) @ POSES[1] @ T
    assert np.abs(view.device_pose.cpu().numpy().reshape(3, 4) - expected[:3]).max() < 1e-6
    keyframe.T_camera_world = cpu.keyframes[1].T_camera_world
    for mapper in (cpu, device):
        mapper.judge_between()
        assert mapper.unfit == {1}  # too dark
    losses = []
    for mapper in (cpu, device):
        view = mapper._view_beside(mapper.between[0], mapper.keyframes[1])
        losses.append(mapper._evaluate_loss(view, mapper._render(view, False)))
    assert losses[1].read_values().total == pytest.approx(losses[0].values.total, rel=1e-4)
    assert losses[1].read_values().valid_pixels == 0


def test_a_refinement_with_all_of_it_ends_at_the_same_pictures() -> None:
    """Half and twice the size, frames between keyframes, and the mean over the last steps."""
    cpu, device = map(with_between, both())
    before = images(cpu)
    for mapper in (cpu, device):
        mapper.depth_noise_px = 0.05
        mapper.judge_between()
        mapper.refine(16)
    moved, apart = np.abs(images(cpu) - before).mean(), np.abs(images(device) - images(cpu)).mean()
    assert moved > 5e-3 and apart < 0.01 * moved  # 0.002


def dark_and_bright(mapper: ComparingMapper) -> None:
    for index, gain in ((3, 0.5), (1, 1.6)):
        mapper.add_keyframe(wall(index, gain), POSES[index])


def test_exposures_are_measured_and_trained_the_same() -> None:
    cpu, device = both()
    for mapper in (cpu, device):
        dark_and_bright(mapper)
    assert cpu._exposures.changed and device._exposures.changed and len(cpu.map) == len(device.map)
    assert (cpu.map.sh - device.map.sh.cpu()).abs().max() < 1e-5
    for mapper in (cpu, device):
        for k in (3, 4, 3, 4):
            mapper.iterate(mapper.keyframes[k])
    exposures = [np.stack([k.exposure for k in mapper.keyframes]) for mapper in (cpu, device)]
    assert np.abs(exposures[0][3, :, 0] - 0.5).max() < 0.05 and np.abs(exposures[0] - exposures[1]).max() < 1e-5
    for mapper in (cpu, device):
        mapper.use_typical_exposure(at_end=True)
    exposures = [np.stack([k.exposure for k in mapper.keyframes]) for mapper in (cpu, device)]
    assert np.abs(exposures[0] - exposures[1]).max() < 2e-3  # 0.0006
    assert [cpu._comparable(keyframe) is not None for keyframe in cpu.keyframes].count(True) == 1
    for k in range(5):  # saturated pixels of the bright one count for neither
        totals = [
            mapper._evaluate_loss(mapper.keyframes[k], mapper._render(mapper.keyframes[k], False))
            for mapper in (cpu, device)
        ]
        expected = totals[0].values
        assert totals[1].read_values().color == pytest.approx(expected.color, abs=2e-4), k


def test_where_images_show_nothing_nothing_is_filled_or_compared() -> None:
    cpu, device = both()
    valid = np.ones((64, 80), bool)
    valid[:, :30] = False
    frame = wall(3)
    frame = dataclasses.replace(frame, depth=np.where(valid, frame.depth, np.float32(0)), valid=valid)
    empty = CpuMapper(GaussianMap(), SETTINGS, NativeContext(1))
    for one, other in ((cpu, device), (empty, on_device(empty))):
        for mapper in (one, other):
            mapper.add_keyframe(frame, POSES[3])
        assert len(one.map) == len(other.map)
    keyframe = device.keyframes[-1]
    assert np.array_equal(device._comparable_on_device(keyframe, HalfSize()).cpu(), HalfSize().valid_of(valid))
    part = np.zeros((64, 80), bool)
    part[10:20, 40:50] = True
    blank_part(keyframe, part)
    assert np.array_equal(device._comparable_on_device(keyframe, ALL_PIXELS).cpu(), valid & ~part)
    assert not keyframe.device_images().depth.view(torch.int16).cpu().numpy()[part].any()


def shiny(mapper: ComparingMapper) -> ComparingMapper:
    for k, keyframe in enumerate(mapper.keyframes):
        keyframe.color = np.clip(keyframe.color * (1 + 0.15 * k), 0, 255).astype(np.uint8)
    return mapper


def test_colours_by_view_are_fitted_the_same() -> None:
    cpu, device = map(shiny, both())
    for mapper in (cpu, device):
        mapper._fit_view_colors()
    assert cpu.map.sh_degree == device.map.sh_degree == 2
    ours, theirs = device.map.sh.cpu()[:, 1:], cpu.map.sh[:, 1:]
    assert theirs.abs().mean() > 1e-3 and (ours - theirs).abs().mean() < 0.01 * theirs.abs().mean()


def test_soft_outlines_count_less() -> None:
    _, device = both()
    usual = device._loss_settings(device.keyframes[0]).depth_weight
    device.has_soft_outlines = True
    assert device._loss_settings(device.keyframes[0]).depth_weight == pytest.approx(0.7 * usual)
    assert device._insertion_settings.fill_stride == 1


def test_an_extra_loss_that_is_not_finite_is_told_after_some_steps() -> None:
    _, device = both()
    device.extra_loss = lambda view, keyframe: 0.1 * view.image.mean()
    device.run(2)
    device.extra_loss = lambda view, keyframe: (view.depth - view.depth).sqrt().sum()
    with pytest.raises(RenderError, match="rendered depth is not finite"):
        for _ in range(3):
            device.run(1)
    assert torch.isfinite(device.map.means).all()


def test_no_step_of_a_refinement_waits() -> None:
    """Before and after it the host waits; with half as many steps as often."""
    found = []
    for steps in (8, 16):
        with DeviceWatch() as watch:
            cpu = CpuMapper(GaussianMap(), SETTINGS, NativeContext(1))
            for k in range(2):
                cpu.add_keyframe(wall(k), POSES[k])
            device = on_device(cpu, watch.library)
            device.depth_noise_px = 0.05
            with_between(device)
            device.run(1)
            watch.forget()
            device.refine(steps)
            found.append(([(wait.operation, wait.where) for wait in watch.waits], device.times.iterations))
            assert not [upload for upload in watch.uploads if upload.blocking]
    assert found[0][0] == found[1][0] and found[1][1] == found[0][1] + 8
