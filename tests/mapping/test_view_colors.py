# SPDX-License-Identifier: Apache-2.0
"""Colours that depend on the view, of a wall whose shine is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from ggslam.errors import CoreInputError
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.settings import MapperSettings
from ggslam.mapping.view_colors import ShownColors, ViewColorTuning, fit_view_colors
from ggslam.native.loader import NativeContext, load_library
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.scene.harmonics import spherical_harmonics
from ggslam.scene.poses import inverse
from ggslam.system.tuning import overridden

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
Shine = Callable[[np.ndarray], np.ndarray]


def pose_at(degrees: float, height: float = 0.0) -> np.ndarray:
    """T_world_camera of a camera 2 m from the origin, turned about it."""
    a = np.radians(degrees)
    back = np.array([np.sin(a), height, -np.cos(a)])
    z = -back / np.linalg.norm(back)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.block([[np.stack([x, np.cross(z, x), z], 1), 2 * back[:, None] / np.linalg.norm(back)], [0, 0, 0, 1]])


def glossy(direction: np.ndarray) -> np.ndarray:
    """A broad lobe about the mirrored ray of a light at the right."""
    light = np.array([0.5, 0.2, -0.84])
    return 0.25 * np.clip(-direction @ light, 0, 1) ** 4


def matte(direction: np.ndarray) -> np.ndarray:
    return np.zeros(len(direction))


def wall(T_world_camera: np.ndarray, shine: Shine, index: int = 0, shade: float = 1.0) -> Frame:
    """A striped wall at z = 0, seen exactly. Its `shade` is that of the light at that instant."""
    rays = CAMERA.rays().reshape(-1, 3).astype(float)
    directions = rays @ T_world_camera[:3, :3].T
    depth = -T_world_camera[2, 3] / directions[:, 2]
    points = T_world_camera[:3, 3] + depth[:, None] * directions
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    base = np.stack([0.3 + 0.1 * np.sin(9 * points[:, k % 2] + k) for k in range(3)], 1)
    color = np.rint(255 * (shade * base + shine(unit)[:, None]).clip(0, 1)).astype(np.uint8)
    size = (CAMERA.height, CAMERA.width)
    return Frame(index, index, index / 30, color.reshape(*size, 3), depth.reshape(size).astype(np.float32), CAMERA)


def train(shine: Shine, fits: bool, shades: dict[int, float] | None = None) -> CpuMapper:
    """The map of eleven keyframes on an arc of 80 degrees."""
    mapper = CpuMapper(GaussianMap(feature_channels=0), MapperSettings(), NativeContext(2), 0)
    mapper.fits_view_colors = fits
    for k in range(11):
        pose = pose_at(8 * k - 40, 0.1 * (k % 3))
        mapper.add_keyframe(wall(pose, shine, k, (shades or {}).get(k, 1.0)), pose)
        mapper.run(10)
    mapper.refine(150)
    return mapper


def psnr(gaussians: GaussianMap, pose: np.ndarray, shine: Shine, degree: int | None = None) -> float:
    """In the middle of the image, dB; its border shows what lies beyond the map."""
    view = CpuRasterizer(1).forward(gaussians, CAMERA, inverse(pose), features=False, active_sh_degree=degree)
    difference = view.image.numpy().clip(0, 1).transpose(1, 2, 0) - wall(pose, shine).color / 255.0
    return float(-10 * np.log10((difference[10:50, 15:65] ** 2).mean()))


@pytest.fixture(scope="module")
def plain() -> CpuMapper:
    return train(glossy, False)


@pytest.fixture(scope="module")
def fitted() -> CpuMapper:
    return train(glossy, True)


def test_shine_is_right_from_views_between_and_beyond_those_it_was_learned_from(
    plain: CpuMapper, fitted: CpuMapper
) -> None:
    assert plain.map.sh_degree == 0 and fitted.map.sh_degree == ViewColorTuning.degree
    unseen = ((-28.0, 0.05, 0.2), (4.0, 0.15, 1.5), (33.0, 0.05, 2.2), (50.0, 0.1, 1.2), (4.0, 0.5, 2.0))
    for degrees, height, gain in unseen:
        pose = pose_at(degrees, height)
        before, after = psnr(plain.map, pose, glossy), psnr(fitted.map, pose, glossy)
        assert after > before + gain, (degrees, height, before, after)


def test_without_harmonics_the_map_looks_as_it_was_trained(plain: CpuMapper, fitted: CpuMapper) -> None:
    torch.testing.assert_close(fitted.map.sh[:, :1], plain.map.sh, rtol=0, atol=0)
    torch.testing.assert_close(fitted.map.means, plain.map.means, rtol=0, atol=0)


def test_a_shadow_on_some_keyframes_is_no_reflection() -> None:
    shades = {3: 0.6, 7: 0.6}
    kept, changed = train(matte, False, shades), train(matte, True, shades)
    poses = [pose_at(degrees, 0.05) for degrees in (-28.0, -4.0, 20.0)]
    lost = [psnr(kept.map, pose, matte) - psnr(changed.map, pose, matte) for pose in poses]
    assert max(lost) < 1.0, lost


def made_up_views(
    gaussians: GaussianMap, truth: np.ndarray, views: int, seed: int = 0, noise: float = 0.0
) -> list[ShownColors]:
    """Of Gaussians that each have three pixels in each view, and miss what harmonics `truth` [N, K, 3] add."""
    random, found = np.random.default_rng(seed), list[ShownColors]()
    for _ in range(views):
        centre = random.normal(size=3) * 3
        directions = gaussians.means.numpy() - centre
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        basis = spherical_harmonics(torch.from_numpy(unit), truth.shape[1]).numpy()
        missing = np.einsum("nk,nkc->nc", basis, truth) + noise * random.normal(size=(len(truth), 3))
        weights = np.full((len(truth), 1, 3), 3 * SH_C0, np.float32)
        found.append(ShownColors(centre, torch.from_numpy(weights), torch.from_numpy(
            (3 * SH_C0 * missing[:, None]).astype(np.float32))))  # fmt: skip
    return found


def some_gaussians(count: int, degree: int = 0) -> GaussianMap:
    gaussians = GaussianMap(degree, 0)
    random = torch.Generator().manual_seed(1)
    means, rgb = torch.rand(count, 3, generator=random), torch.rand(count, 3, generator=random)
    gaussians.insert(means, torch.eye(1, 4).expand(count, 4), torch.full((count, 3), -4.0), 0.0, rgb)
    return gaussians


def test_coefficients_are_found_again() -> None:
    gaussians = some_gaussians(300)
    truth = np.zeros((300, 9, 3))
    truth[:, 1:] = 0.01 * np.random.default_rng(2).normal(size=(300, 8, 3))
    views = made_up_views(gaussians, truth, 40)
    with overridden(ViewColorTuning, usual_residual=10.0):
        assert fit_view_colors(gaussians, lambda: iter(views), 1e-4, NativeContext(1)) == 1.0
    np.testing.assert_allclose(gaussians.sh.numpy()[:, 1:], truth[:, 1:], atol=2e-5)


def test_only_those_that_ask_get_harmonics_whatever_the_groups_and_threads() -> None:
    truth = np.zeros((1500, 9, 3))
    truth[::5, 4:] = 0.03
    maps = [some_gaussians(1500, degree) for degree in (0, 0, 0, 3)]
    shares = []
    for gaussians, threads, group in zip(maps, (1, 2, 1, 1), (1500, 1500, 37, 1500), strict=True):
        views = made_up_views(gaussians, truth, 12)

        def show(views: list[ShownColors] = views) -> Iterator[ShownColors]:
            return iter(views)

        with overridden(ViewColorTuning, most_bytes=4 * 60 * group):
            shares.append(fit_view_colors(gaussians, show, 0.03, NativeContext(threads)))
    assert shares == [0.2] * 4
    asks = (maps[0].sh[:, 1:] != 0).any(2).any(1)
    assert asks.nonzero()[:, 0].tolist() == list(range(0, 1500, 5))
    for other in maps[1:3]:
        torch.testing.assert_close(other.sh, maps[0].sh, rtol=0, atol=0)
    torch.testing.assert_close(maps[3].sh[:, :9], maps[0].sh)
    assert not maps[3].sh[:, 9:].any()


def test_noise_of_half_a_level_is_no_reflection() -> None:
    gaussians, truth = some_gaussians(2000), np.zeros((2000, 9, 3))
    views = made_up_views(gaussians, truth, 12, noise=0.5 / 255)
    assert fit_view_colors(gaussians, lambda: iter(views), 0.03, NativeContext(1)) == 0.0
    assert gaussians.sh_degree == 0
    truth[:, 1:] = 0.02
    views = made_up_views(gaussians, truth, 12, noise=0.5 / 255)
    assert fit_view_colors(gaussians, lambda: iter(views), 0.03, NativeContext(1)) == 1.0
    assert gaussians.sh_degree == 2


def test_views_that_say_nothing_change_nothing() -> None:
    gaussians, truth = some_gaussians(50), np.zeros((50, 9, 3))
    for views in ([], made_up_views(gaussians, truth, 5)):
        assert fit_view_colors(gaussians, lambda views=views: iter(views), 0.03, NativeContext(1)) == 0.0  # type: ignore[misc]
    assert gaussians.sh_degree == 0
    assert fit_view_colors(GaussianMap(0, 0), lambda: iter([]), 0.03, NativeContext(1)) == 0.0


def test_impossible_jobs_are_refused() -> None:
    context, values = NativeContext(1), np.zeros((4, 60), np.float32)
    solve, gains = load_library().ggslam_view_colors_solve, np.zeros(4, np.float32)
    for count, ridge, words in ((7, 0.1, "3, 8 or 15"), (8, 0.0, "ridge"), (8, float("nan"), "ridge")):
        with pytest.raises(CoreInputError, match=words):
            solve(context.handle, values.ctypes.data, 4, count, ridge, gains.ctypes.data)
    with pytest.raises(CoreInputError, match="gains"):
        solve(context.handle, values.ctypes.data, 4, 8, 0.1, None)
