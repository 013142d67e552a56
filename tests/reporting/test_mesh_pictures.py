# SPDX-License-Identifier: Apache-2.0
"""Pictures of meshes."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.native.loader import NativeContext
from ggslam.reporting.cloud_pictures import CloudView, outside_view
from ggslam.reporting.mesh_pictures import draw_mesh
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse

CAMERA = Camera(120, 90, 100, 100, 59.5, 44.5)
FRONT = CloudView(CAMERA, np.eye(4))


def square(z: float, half: float, color: tuple[int, int, int]) -> tuple[np.ndarray, ...]:
    """Vertices, triangles, normals, colours of a square that faces a camera at the origin."""
    vertices = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    triangles = np.array([[0, 2, 1], [0, 3, 2]])
    return vertices, triangles, np.tile([0, 0, -1.0], (4, 1)), np.tile(np.array(color, np.uint8), (4, 1))


def joined(*parts: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    first = np.cumsum([0] + [len(p[0]) for p in parts[:-1]])
    triangles = np.concatenate([p[1] + f for p, f in zip(parts, first, strict=True)])
    vertices, _, normals, colors = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return vertices, triangles, normals, colors


def test_square_covers_its_pixels() -> None:
    picture = draw_mesh(*square(2.0, 0.4, (200, 100, 50)), FRONT)
    drawn = (picture != 255).any(-1)
    v, u = np.mgrid[:90, :120]
    assert np.array_equal(drawn, (np.abs(u - 59.5) <= 20) & (np.abs(v - 44.5) <= 20))
    middle = picture[44, 59].astype(int)
    assert np.abs(middle - (200, 100, 50)).max() <= 6  # seen along its normal nearly everywhere
    assert (picture[drawn].max(0) <= (200, 100, 50)).all()


@pytest.mark.parametrize("order", [0, 1])
def test_the_nearer_surface_is_seen(order: int) -> None:
    parts = [square(2.0, 0.4, (250, 0, 0)), square(1.0, 0.1, (0, 250, 0))]
    picture = draw_mesh(*joined(*(parts if order else parts[::-1])), FRONT)
    assert picture[44, 59, 1] > 200 and picture[44, 45, 0] > 200


def test_slanted_surfaces_cut_each_other() -> None:
    """Depth is interpolated perspectively: two planes that cross do so where they should."""
    slant = square(0.0, 1.0, (250, 0, 0))
    slant[0][:, 2] = 3 + 2 * slant[0][:, 0]  # z = 3 + 2 x
    picture = draw_mesh(*joined(slant, square(3.0, 3.0, (0, 250, 0))), FRONT, cull=False)
    assert (picture[44, :58, 0] > 50)[50:].all() and (picture[44, 62:, 0] == 0).all() and picture[44, 62:, 1].all()


def test_back_faces_are_seen_through_or_not() -> None:
    vertices, triangles, normals, colors = square(2.0, 0.4, (200, 100, 50))
    turned = (vertices, triangles[:, ::-1], normals, colors)
    assert (draw_mesh(*turned, FRONT) == 255).all()
    assert np.array_equal(draw_mesh(*turned, FRONT, cull=False), draw_mesh(vertices, triangles, normals, colors, FRONT))


def test_what_is_behind_the_camera_is_not_drawn() -> None:
    assert (draw_mesh(*square(-2.0, 0.4, (9, 9, 9)), FRONT, cull=False) == 255).all()
    assert (draw_mesh(*square(0.04, 0.4, (9, 9, 9)), FRONT) == 255).all()
    across = square(2.0, 0.4, (9, 9, 9))
    across[0][0, 2] = -1
    across[0][1, 2] = -1
    assert (draw_mesh(*across, FRONT, cull=False) == 255).mean() > 0.8


def test_surfaces_seen_from_the_side_are_darker() -> None:
    vertices, triangles, normals, colors = square(2.0, 0.4, (200, 200, 200))
    slanted = np.tile([np.sin(1.2), 0, -np.cos(1.2)], (4, 1))
    bright, dark = (draw_mesh(vertices, triangles, n, colors, FRONT)[44, 59, 0] for n in (normals, slanted))
    assert 0.3 * bright < dark < 0.7 * bright


def test_threads_do_not_matter() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(0, 0.5, (300, 3)) + (0, 0, 3)
    normals = rng.normal(0, 1, (300, 3))
    mesh = (vertices, rng.integers(0, 300, (500, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True),
            rng.integers(0, 255, (300, 3)))  # fmt: skip
    pictures = [draw_mesh(*mesh, FRONT, cull=False, context=NativeContext(n)) for n in (1, 2, 3)]
    assert np.array_equal(pictures[0], pictures[1]) and np.array_equal(pictures[0], pictures[2])
    assert (pictures[0] != 255).any(-1).mean() > 0.3


def test_wrong_arrays_are_refused() -> None:
    vertices, triangles, normals, colors = square(2.0, 0.4, (1, 2, 3))
    with pytest.raises(ValueError, match="3 colors"):
        draw_mesh(vertices, triangles, normals, colors[:3], FRONT)
    with pytest.raises(ValueError, match="vertices 0 to 4 of 4"):
        draw_mesh(vertices, triangles + [[0, 1, 1], [0, 1, 2]], normals, colors, FRONT)


@pytest.mark.parametrize("upwards", [(0, -1, 0), (0, 0, 1), (0.1, -0.9, 0.3)])
def test_outside_view_shows_all_from_above(upwards: tuple[float, float, float]) -> None:
    points = np.random.default_rng(1).uniform([-3, -1, 0], [2, 1.5, 4], (2000, 3))
    view = outside_view(points, np.array(upwards), 320, 240)
    T = inverse(view.T_world_camera)
    p = points @ T[:3, :3].T + T[:3, 3]
    u, v = view.camera.fx * p[:, 0] / p[:, 2] + view.camera.cx, view.camera.fy * p[:, 1] / p[:, 2] + view.camera.cy
    assert (p[:, 2] > 0).all() and (u > -8).all() and (u < 328).all() and (v > -8).all() and (v < 248).all()
    up = T[:3, :3] @ (np.array(upwards) / np.linalg.norm(upwards))
    assert up[1] < -0.5 and up[2] < -0.3  # upwards in the picture, and towards the camera: seen from above
    assert np.linalg.det(view.T_world_camera[:3, :3]) == pytest.approx(1)
