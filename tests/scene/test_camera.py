# SPDX-License-Identifier: Apache-2.0
"""The camera's pixel convention (centre of the top-left pixel at (0, 0)) holds through resizing and back-projection."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.scene.camera import Camera

CAMERA = Camera(640, 480, 525.0, 520.0, 319.5, 239.5)


def test_halving_keeps_rays_where_they_are() -> None:
    """A pixel of the half image covers four: its centre lies between theirs, and so does its ray."""
    full, half = CAMERA.rays(), CAMERA.scale(0.5).rays()
    mean = full.reshape(240, 2, 320, 2, 3).mean((1, 3))
    np.testing.assert_allclose(half, mean, atol=1e-6)
    assert (CAMERA.scale(0.5).cx, CAMERA.scale(0.5).fx) == (159.5, 262.5)


def test_resizing_keeps_the_edges_of_the_view() -> None:
    for size in ((320, 240), (200, 333), (1280, 960)):
        small = CAMERA.resize(*size)
        assert (small.width, small.height) == size
        assert (-0.5 - small.cx) / small.fx == pytest.approx((-0.5 - CAMERA.cx) / CAMERA.fx)
        right = (small.width - 0.5 - small.cx) / small.fx
        assert right == pytest.approx((CAMERA.width - 0.5 - CAMERA.cx) / CAMERA.fx)
    assert CAMERA.scale(1.0) == CAMERA and CAMERA.scale(1e-6).width == 1


def test_back_projected_points_project_to_their_pixels() -> None:
    camera = CAMERA.scale(0.1)
    depth = np.random.default_rng(0).uniform(1, 5, (camera.height, camera.width)).astype(np.float32)
    depth[3, 4] = 0
    points = camera.back_project(depth)
    assert points.dtype == np.float32 and (points[3, 4] == 0).all()
    pixel = points[7, 11] @ camera.matrix().T
    np.testing.assert_allclose(pixel[:2] / pixel[2], [11, 7], atol=1e-4)
    assert points[7, 11, 2] == depth[7, 11]


@pytest.mark.parametrize("change", [{"width": 0}, {"fx": -1.0}, {"fy": 0.0}, {"cx": float("nan")}])
def test_impossible_cameras_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="impossible camera"):
        Camera(**{"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, **change})  # type: ignore[arg-type]


def test_projection_tells_pixels_and_what_is_outside() -> None:
    camera = CAMERA.scale(0.1)
    depth = np.random.default_rng(0).uniform(1, 5, (camera.height, camera.width)).astype(np.float32)
    rows, columns, inside = camera.project(camera.back_project(depth).reshape(-1, 3))
    assert inside.all() and rows.dtype == columns.dtype == np.int64
    assert (rows * camera.width + columns == np.arange(depth.size)).all()
    behind, beside, near, there = [0, 0, -1], [9, 0, 1], [0, 0, 0.05], [0, 0, 0.2]
    rows, columns, inside = camera.project(np.array([behind, beside, near, there], float), nearest=0.1)
    assert inside.tolist() == [False, False, False, True]
    assert (rows[:3] == 0).all() and (columns[:3] == 0).all()
    assert (rows[3], columns[3]) == (round(camera.cy), round(camera.cx))
