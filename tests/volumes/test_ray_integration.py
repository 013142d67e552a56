# SPDX-License-Identifier: Apache-2.0
"""Depth gathered along rays rather than looked up by projection: a slow reference, and how near to the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_scenes import Plane, looking_at, render_depth, small_camera

from ggslam.errors import CoreInputError, InputError
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.volumes.raycast import render_depth as render_map
from ggslam.volumes.settings import INTEGRATORS, MOST_RAYS, Integrator, TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, TsdfMap
from ggslam.volumes.tsdf_file import load_tsdf, save_tsdf
from ggslam.volumes.tsdf_torch import TorchTsdf

VOXEL = 0.03
RADIUS = 0.02
"""The compiled core's: how far from a voxel's centre a ray may pass, metres."""
POSE = looking_at(np.array([0.3, -0.2, -1.2]), np.array([0.1, 0.1, 0.9]))
CAMERA = small_camera(480, 360)
SLOPE = Plane((0.3, 0.2, -1.0), -1.0)


def made(
    kind: Integrator, threads: int = 2, noise: float = 0.0, views: int = 1, voxel: float = VOXEL,
    camera: Camera = CAMERA,
) -> TsdfMap:  # fmt: skip
    """Views of a sloping plane."""
    tsdf = TsdfMap(TsdfSettings(voxel=voxel, integrator=kind), NativeContext(threads))
    rng = np.random.default_rng(3)
    for _ in range(views):
        depth = render_depth(SLOPE, camera, POSE)
        depth += (noise * rng.standard_normal(depth.shape)).astype(np.float32)
        tsdf.integrate(depth, camera, POSE)
    return tsdf


def values_near(tsdf: TsdfMap) -> dict[tuple[int, int, int], float]:
    """Values, in truncations, of the voxels near the surface by their places."""
    found = {}
    coordinates = tsdf.blocks().coordinates
    voxels = tsdf.read(coordinates)
    for block, values, weights in zip(coordinates, voxels.value, voxels.weight, strict=True):
        for row in np.nonzero((weights > 0) & (values < FREE_VALUE))[0].tolist():
            place = 8 * block + (row % 8, row // 8 % 8, row // 64)
            found[tuple(place.tolist())] = values[row] / FREE_VALUE
    return found


def test_voxels_have_the_mean_of_all_rays_that_pass_them() -> None:
    camera = small_camera()
    tsdf = made("rays", camera=camera)
    depth, rays = render_depth(SLOPE, camera, POSE).astype(float), camera.rays().astype(float)
    truncation, T = tsdf.settings.truncation, inverse(POSE)
    directions = rays.reshape(-1, 3) @ POSE[:3, :3].T
    checked = 0
    for place, value in list(values_near(tsdf).items())[::53]:
        centre = VOXEL * (np.array(place) + 0.5)
        z = float(T[2, :3] @ centre + T[2, 3])
        with np.errstate(divide="ignore"):
            ends = np.sort((VOXEL * (np.array(place) + np.array([[0], [1]]))[:, None] - POSE[:3, 3]) / directions, 0)
        enters, leaves = ends[0].max(-1), ends[1].min(-1)
        gap = depth.reshape(-1) - z
        passes = (enters < leaves) & (np.abs(gap) <= truncation)
        passes &= (leaves > depth.reshape(-1) - truncation) & (enters < depth.reshape(-1) + truncation)
        passes &= np.linalg.norm(POSE[:3, 3] + z * directions - centre, axis=1) <= RADIUS
        if passes.any():
            assert value == pytest.approx(gap[passes].mean() / truncation, abs=1e-3)
            checked += 1
    assert checked > 50


@pytest.mark.parametrize("kind", ["rays", "hybrid"])
def test_rays_average_noise_that_projection_takes_in(kind: Integrator) -> None:
    truth = render_depth(SLOPE, CAMERA, POSE)

    def error(of: Integrator) -> float:
        drawn = render_map(made(of, noise=0.01), CAMERA, POSE).depth
        return 1e3 * float(np.median(np.abs(drawn - truth)[drawn > 0]))

    assert error("projection") > 2.0
    assert error(kind) < 0.6 * error("projection")


def test_exact_depth_stays_exact() -> None:
    truth = render_depth(SLOPE, CAMERA, POSE)
    drawn = render_map(made("hybrid"), CAMERA, POSE).depth
    assert np.mean(drawn > 0) > 0.95
    assert 1e3 * np.percentile(np.abs(drawn - truth)[drawn > 0], 95) < 1.0


def test_voxels_smaller_than_pixels_are_filled_by_projection_alone() -> None:
    camera = small_camera()  # a pixel is 14 mm wide there

    def filled(kind: Integrator) -> int:
        tsdf = made(kind, voxel=0.006, camera=camera)
        voxels = tsdf.read(tsdf.blocks().coordinates)
        return int(np.sum((voxels.weight > 0) & (voxels.value < FREE_VALUE)))

    projected = filled("projection")
    assert filled("hybrid") == pytest.approx(projected, rel=0.01)
    assert filled("rays") < 0.6 * projected


def test_threads_do_not_matter() -> None:
    one, three = made("hybrid", 1, noise=0.01, views=3), made("hybrid", 3, noise=0.01, views=3)
    coordinates = one.blocks().coordinates
    first, second = one.read(coordinates), three.read(coordinates)
    np.testing.assert_array_equal(first.value, second.value)
    np.testing.assert_array_equal(first.weight, second.weight)


def test_free_space_is_that_of_projection() -> None:
    """Only what is near a surface has its depth from rays."""
    projected, hybrid = made("projection"), made("hybrid")
    free = [np.sum(m.blocks().free_weight[~m.blocks().dense] > 0) for m in (projected, hybrid)]
    assert free[0] == free[1] > 100


def test_devices_look_depth_up_by_projection_alone() -> None:
    with pytest.raises(InputError, match="integrator: a device looks depth up by projection, not by hybrid"):
        TorchTsdf(TsdfSettings(integrator="hybrid"))


def test_impossible_numbers_are_refused_by_the_core() -> None:
    tsdf = TsdfMap(TsdfSettings(voxel=VOXEL))
    object.__setattr__(tsdf.settings, "least_rays", 0)
    with pytest.raises(CoreInputError, match="least_rays"):
        tsdf.integrate(render_depth(SLOPE, CAMERA, POSE), CAMERA, POSE)


def test_files_keep_the_integrator_and_those_without_one_are_as_they_were(tmp_path: Path) -> None:
    for kind in INTEGRATORS:
        settings = TsdfSettings(voxel=VOXEL, integrator=kind, least_rays=5)
        save_tsdf(tmp_path / "tsdf.npz", TsdfMap(settings))
        kept = load_tsdf(tmp_path / "tsdf.npz").settings
        assert kept == (TsdfSettings(voxel=VOXEL) if kind == "projection" else settings)
        with np.load(tmp_path / "tsdf.npz") as arrays:
            assert ("integrator" in arrays["setting_names"]) == (kind != "projection")
    most = TsdfSettings(integrator="hybrid", least_rays=MOST_RAYS)
    assert TsdfSettings.of_numbers(most.numbers()) == most
    with pytest.raises(ValueError, match="integrator 3"):
        TsdfSettings.of_numbers({**TsdfSettings(integrator="rays").numbers(), "integrator": 3.0})
