# SPDX-License-Identifier: Apache-2.0
"""Distorting and orthographic cameras, batches and backgrounds, against formulas of their own."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from rendering_scenes import CAMERA, POSE, make_scene, relative_error

from ggslam.errors import InputError, RenderError
from ggslam.rendering import GaussianModel, GaussianTensors, render
from ggslam.rendering.distorted import faces_of
from ggslam.rendering.reference import rotation_matrices, view_colours
from ggslam.scene.camera import Camera
from ggslam.scene.camera_models import DistortedCamera, OrthographicCamera
from ggslam.scene.gaussian_map import rgb_to_sh

WIDE = Camera(200, 160, 130.0, 132.0, 98.3, 81.1)
BROWN = DistortedCamera(WIDE, (-0.28, 0.09, 0.001, -0.0008, -0.01))
FISHEYE = DistortedCamera(WIDE, (0.03, -0.004, 0.001, -0.0002), fisheye=True)
ROUND = DistortedCamera(Camera(180, 180, 50.0, 50.0, 89.5, 89.5), (0.01, 0.002, 0.0, 0.0), fisheye=True)
"""Sees 100 degrees to each side at the edges, more in the corners."""


def dots(places: np.ndarray, size: float = 0.02) -> GaussianTensors:
    """Round white Gaussians at places [n, 3]."""
    count = len(places)
    return GaussianTensors(
        torch.tensor(places, dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), float(np.log(size))), torch.full((count,), 3.0),
        rgb_to_sh(torch.ones(count, 1, 3)), torch.zeros(count, 0),
    )  # fmt: skip


def centre_of(image: torch.Tensor) -> np.ndarray:
    """Column and row of the centre of light of [H, W]."""
    weight = image.double().numpy()
    row, column = np.indices(weight.shape)
    return np.array([(weight * column).sum(), (weight * row).sum()]) / weight.sum()


@pytest.mark.parametrize("camera", [BROWN, FISHEYE, ROUND], ids=["brown", "fisheye", "round"])
def test_rays_and_projection_undo_each_other(camera: DistortedCamera) -> None:
    rays = camera.rays()
    known = np.isfinite(rays).all(-1)
    assert known.mean() > (0.75 if camera is ROUND else 0.99)
    np.testing.assert_allclose(np.linalg.norm(rays[known], axis=1), 1)
    row, column = np.nonzero(known)
    np.testing.assert_allclose(camera.project(3 * rays[known]), np.stack([column, row], 1), atol=1e-4)


def test_projection_is_opencvs() -> None:
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 3], (50, 3))
    zero, k = np.zeros(3), np.array(FISHEYE.distortion)
    theirs = cv2.fisheye.projectPoints(points[:, None], zero, zero, WIDE.matrix(), k)[0][:, 0]
    np.testing.assert_allclose(FISHEYE.project(points), theirs, atol=1e-9)
    theirs = cv2.projectPoints(points, zero, zero, WIDE.matrix(), np.array(BROWN.distortion))[0][:, 0]
    np.testing.assert_allclose(BROWN.project(points), theirs, atol=1e-9)


@pytest.mark.parametrize("camera", [BROWN, FISHEYE, ROUND], ids=["brown", "fisheye", "round"])
def test_dots_appear_where_the_lens_puts_them(camera: DistortedCamera) -> None:
    """One by one, so that the centre of light tells the place; also beside and behind the axis."""
    rays, far = camera.rays(), 0.0
    for row, column in ((80, 100), (20, 30), (140, 170), (90, 12), (30, 150)):
        if not np.isfinite(rays[row, column]).all():
            continue
        place = 2.0 * rays[row, column] + np.array([0.003, -0.002, 0])
        view = render(dots(place[None], 0.012), camera, np.eye(4))
        far = max(far, float(np.abs(centre_of(view.alpha) - camera.project(place[None])[0]).max()))
        expected = float(view.depth[row, column] / view.alpha[row, column])
        assert expected == pytest.approx(place[2], abs=0.02)
    assert 0 < far < 0.05


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_lens_undone_by_opencv_is_the_pinhole_picture(fisheye: bool) -> None:
    """Rendered through the lens, then undistorted as recordings are, the picture is the pinhole's."""
    scene = make_scene(300, coefficients=4)
    pinhole = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
    k = (0.05, -0.01, 0.0, 0.0) if fisheye else (-0.2, 0.05, 0.001, 0.0005)
    seen = render(scene, DistortedCamera(pinhole, k, fisheye), POSE).image.numpy().transpose(1, 2, 0)
    undistort = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    maps = undistort(pinhole.matrix(), np.array(k), np.eye(3), pinhole.matrix(), (240, 180), cv2.CV_32FC1)
    found = cv2.remap(seen, *maps, cv2.INTER_CUBIC)
    truth = render(scene, pinhole, POSE).image.numpy().transpose(1, 2, 0)
    inside = np.zeros(truth.shape[:2], bool)
    inside[25:-25, 25:-25] = True
    error = 10 * np.log10(1 / np.mean((found[inside] - truth[inside]) ** 2))
    naive = 10 * np.log10(1 / np.mean((seen[inside] - truth[inside]) ** 2))
    assert error > 38
    assert error > naive + 12


def test_a_lens_without_distortion_is_a_pinhole() -> None:
    scene, camera = make_scene(200, features=3), Camera(120, 96, 100.0, 101.0, 58.0, 47.0)
    found = render(scene, DistortedCamera(camera, (0, 0, 0, 0)), POSE, median_depth=True)
    truth = render(scene, camera, POSE, median_depth=True)
    for name in ("image", "alpha", "features"):
        assert float((getattr(found, name) - getattr(truth, name)).square().mean().sqrt()) < 0.02, name
    seen = (found.alpha > 0.5) & (truth.alpha > 0.5)
    assert float((found.expected_depth - truth.expected_depth)[seen].abs().mean()) < 0.02
    assert found.median_depth is not None


def test_wide_lenses_take_the_faces_of_a_cube() -> None:
    assert len(faces_of(BROWN)) == 1
    faces = faces_of(ROUND)
    assert len(faces) == 6  # the corners see a little of what is behind
    pixels = np.concatenate([face.pixels for face in faces])
    assert len(pixels) == len(np.unique(pixels)) == np.isfinite(ROUND.rays()).all(-1).sum()
    # A dot on the seam of two faces is whole: it has the light of its solid angle, as one within a face.
    light = [float(render(dots(2 * np.array([[np.sin(a), 0, np.cos(a)]]), 0.06), ROUND, np.eye(4)).alpha.sum())
             for a in (np.pi / 4, np.pi / 4 - 0.25)]  # fmt: skip
    step, areas = 1e-4, []
    for a in (np.pi / 4, np.pi / 4 - 0.25):  # pixels per solid angle: along the radius times across
        low, high = (ROUND.project(np.array([[np.sin(b), 0, np.cos(b)]]))[0, 0] - 89.5 for b in (a - step, a + step))
        areas.append((high - low) / (2 * step) * (low + high) / 2 / np.sin(a))
    assert light[0] / light[1] == pytest.approx(areas[0] / areas[1], rel=0.07)


def test_gradients_pass_through_a_lens() -> None:
    camera = DistortedCamera(CAMERA, (0.05, 0.0, 0.0, 0.0), fisheye=True)
    weight = torch.arange(camera.width) + 0.7 * torch.arange(camera.height)[:, None]  # of light, where it falls

    def loss(shift: torch.Tensor) -> torch.Tensor:
        scene = make_scene(60)
        scene.means = scene.means + shift
        return (render(scene, camera, POSE).image * weight).sum()

    shift = torch.zeros(3, requires_grad=True)
    loss(shift).backward()
    assert shift.grad is not None
    with torch.no_grad():
        slopes = torch.stack([(loss(0.01 * axis) - loss(-0.01 * axis)) / 0.02 for axis in torch.eye(3)])
    # Gaussians cover others and end at 1/255, which differences see and gradients do not: 4 % of a pinhole's, too.
    assert float((shift.grad - slopes).norm() / slopes.norm()) < 0.06


def orthographic_truth(
    scene: GaussianTensors, camera: OrthographicCamera, T: np.ndarray, near: float = 0.05
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Image, depth and alpha of a parallel projection in float64, from nothing but its definition."""
    T = torch.tensor(T)
    R = T[:3, :3]
    p = scene.means.double() @ R.T + T[:3, 3]
    order = torch.argsort(p[:, 2])
    order = order[p[order, 2] >= near]
    V = (R @ rotation_matrices(scene.quaternions.double()) * torch.exp(scene.log_scales.double())[:, None])[order]
    covariance = camera.scale**2 * (V @ V.transpose(1, 2))[:, :2, :2] + 0.3 * torch.eye(2, dtype=torch.float64)
    precision = torch.linalg.inv(covariance)
    axis = R[2].expand(len(p), 3)
    colour = view_colours(scene.sh.double(), axis, torch.eye(4, dtype=torch.float64))[order]
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    centres = camera.scale * p[order, None, :2] + torch.tensor([camera.cx, camera.cy])
    d = torch.stack([u, v], -1).reshape(1, -1, 2) - centres
    alpha = torch.sigmoid(scene.opacity_logits.double())[order, None] * torch.exp(
        -0.5 * torch.einsum("npi,nij,npj->np", d, precision, d)
    )
    alpha = torch.where(alpha >= 1 / 255, alpha.clamp_max(0.999), 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = alpha * before * (before >= 1e-4)
    size = (camera.height, camera.width)
    return (colour.T @ weight).reshape(3, *size), (p[order, 2] @ weight).reshape(size), weight.sum(0).reshape(size)


@pytest.mark.parametrize("degree", [1, 9])
def test_orthographic_pictures_are_parallel_projections(degree: int) -> None:
    scene = make_scene(150, coefficients=degree)
    camera = OrthographicCamera(61, 47, 22.0, 29.3, 24.1)
    found = render(scene, camera, POSE)
    image, depth, alpha = orthographic_truth(scene, camera, POSE)
    assert relative_error(found.image, image) < 2e-5
    assert relative_error(found.depth, depth) < 2e-5
    assert relative_error(found.alpha, alpha) < 2e-5


def test_orthographic_sizes_do_not_shrink_with_depth() -> None:
    camera = OrthographicCamera(101, 81, 20.0, 50.0, 40.0)
    near, far = (render(dots(np.array([[0.7, -0.4, z]]), 0.2), camera, np.eye(4)) for z in (0.3, 90.0))
    torch.testing.assert_close(near.image, far.image, atol=1e-4, rtol=1e-3)
    assert centre_of(far.alpha) == pytest.approx([50 + 14, 40 - 8], abs=1e-3)
    assert float(far.expected_depth[32, 64]) == pytest.approx(90, rel=1e-5)
    assert float(render(dots(np.array([[0, 0, -1.0]])), camera, np.eye(4)).alpha.max()) == 0


def test_orthographic_gradients() -> None:
    camera, weight = OrthographicCamera(41, 33, 18.0, 20.0, 16.0), torch.rand(3, 33, 41)
    ours, theirs = make_scene(40), make_scene(40)
    for scene in (ours, theirs):
        for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
            getattr(scene, name).requires_grad_()
    (render(ours, camera, POSE).image * weight).sum().backward()
    (orthographic_truth(theirs, camera, POSE)[0] * weight).sum().backward()
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert relative_error(getattr(ours, name).grad, getattr(theirs, name).grad.double()) < 2e-3, name
    with pytest.raises(RenderError, match="no gradient with respect to the pose"):
        render(make_scene(3), camera, torch.eye(4, requires_grad=True))


def test_batches_are_their_views_one_by_one() -> None:
    scene = make_scene(80, features=2)
    poses = np.stack([POSE, np.eye(4), np.linalg.inv(POSE)])
    batch = render(scene, CAMERA, poses, median_depth=True)
    other = Camera(CAMERA.width, CAMERA.height, 40.0, 41.0, 17.0, 15.0)
    several = render(scene, [CAMERA, other], POSE)
    for k, pose in enumerate(poses):
        single = render(scene, CAMERA, pose, median_depth=True)
        for name in ("image", "depth", "alpha", "features", "median_depth"):
            torch.testing.assert_close(getattr(batch, name)[k], getattr(single, name), rtol=0, atol=0)
    assert batch.expected_depth.shape == (3, CAMERA.height, CAMERA.width)
    torch.testing.assert_close(several.image[1], render(scene, other, POSE).image, rtol=0, atol=0)
    with pytest.raises(RenderError, match="2 cameras do not go with 3 poses"):
        render(scene, [CAMERA, other], poses)
    with pytest.raises(RenderError, match="one size"):
        render(scene, [CAMERA, CAMERA.resize(20, 20)], POSE)


def test_batches_have_the_gradients_of_their_sum() -> None:
    model = GaussianModel(make_scene(50))
    render(model, CAMERA, np.stack([POSE, np.eye(4)])).image.sum().backward()
    found = model.means.grad
    model.means.grad = None
    (render(model, CAMERA, POSE).image.sum() + render(model, CAMERA, np.eye(4)).image.sum()).backward()
    assert found is not None and model.means.grad is not None
    assert relative_error(found, model.means.grad.double()) < 1e-5


def test_backgrounds() -> None:
    scene, color = make_scene(60), torch.tensor([0.2, 0.5, 1.0])
    black, on = render(scene, CAMERA, POSE), render(scene, CAMERA, POSE, background=color)
    torch.testing.assert_close(on.image, black.image + (1 - black.alpha) * color[:, None, None])
    picture = torch.rand(3, CAMERA.height, CAMERA.width)
    on = render(scene, CAMERA, np.stack([POSE, POSE]), background=picture)
    torch.testing.assert_close(on.image[1], black.image + (1 - black.alpha) * picture)
    for wrong in ([1.0, 2.0], np.zeros((2, 2)), "white"):
        with pytest.raises(RenderError, match="background"):
            render(scene, CAMERA, POSE, background=wrong)  # type: ignore[arg-type]


def test_other_things_are_refused_in_words() -> None:
    scene = make_scene(2)
    for arguments, problem in (
        (("map.ply", CAMERA, POSE), "gaussians: expected a GaussianMap.*found str"),
        ((scene, "camera", POSE), "camera: expected a Camera.*found str"),
        ((scene, [CAMERA, 3], POSE), "camera: expected a Camera.*found int"),
        ((scene, CAMERA, "pose"), "T_camera_world: expected numbers.*found str"),
        ((scene, CAMERA, np.zeros((2, 3, 3))), "4x4"), ((scene, [], POSE), "0 cameras"),
    ):  # fmt: skip
        with pytest.raises(RenderError, match=problem):
            render(*arguments)  # type: ignore[arg-type]
    for values, fisheye in (((1, 2, 3), False), ((0.1,) * 5, True), ((float("nan"),) * 4, True)):
        with pytest.raises(InputError, match="distortion: expected"):
            DistortedCamera(WIDE, values, fisheye)
    with pytest.raises(InputError, match="impossible camera"):
        OrthographicCamera(10, 10, 0.0, 1, 1)
