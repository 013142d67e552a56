# SPDX-License-Identifier: Apache-2.0
"""Pictures of clouds: near points hide far ones, squares are as large as voxels look, views show the cloud."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.reporting.cloud_pictures import CloudView, contact_sheet, draw_cloud, view_of
from ggslam.scene.camera import Camera

VIEW = CloudView(Camera(100, 80, 100.0, 100.0, 50.0, 40.0), np.eye(4))
RED, BLUE = [255, 0, 0], [0, 0, 255]


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_near_points_hide_far_ones(order: list[int]) -> None:
    points, colors = np.array([[0.0, 0, 2], [0, 0, 4]]), np.array([RED, BLUE], np.uint8)
    picture = draw_cloud(points[order], colors[order], VIEW, 0.2)  # 13 and 7 pixels wide
    assert picture[40, 50].tolist() == RED
    assert (picture == RED).all(2).sum() == 13 * 13 and not (picture == BLUE).all(2).any()
    assert (picture == 255).all(2).sum() == 100 * 80 - 13 * 13


def test_points_behind_the_camera_and_beside_the_picture_are_left_out() -> None:
    points = np.array([[0.0, 0, -2], [50, 0, 2], [0, -50, 2]])
    assert (draw_cloud(points, np.zeros((3, 3), np.uint8), VIEW, 0.1) == 255).all()
    edge = draw_cloud(np.array([[-1.0, 0, 2], [0, 0, 3]]), np.array([RED, RED], np.uint8), VIEW, 0.1)  # column 0
    assert edge[40, 0].tolist() == RED and edge[40, 99].tolist() == [255, 255, 255]


def test_views_show_the_cloud() -> None:
    generator = np.random.default_rng(0)
    block = generator.random((20_000, 3)) * [3, 1, 5]
    for points in (block + [100, 50, 7], block * 1e-3 - 2, block - [1.5, 0.5, 1.0]):
        view = view_of(points, 320, 240)
        R = view.T_world_camera[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        picture = draw_cloud(points, np.zeros((len(points), 3), np.uint8), view, np.ptp(points) / 100)
        assert (picture == 0).all(2).mean() > 0.15
    assert view_of(block - [1.5, 0.5, 1.0]).T_world_camera[2, 3] < 0  # around the origin: from the first camera
    assert view_of(block + 9).T_world_camera[1, 3] > (block + 9)[:, 1].max()  # from above the least extent


def test_contact_sheet() -> None:
    pictures = [np.full((60, 90, 3), level, np.uint8) for level in (10, 20, 30, 40)]
    sheet = contact_sheet(pictures, ["a", "b", "c", "d"])
    assert sheet.shape[1] == 270 and sheet.shape[0] > 120
    assert sheet[5, 5, 0] == 10 and sheet[5, 185, 0] == 30 and (sheet[76:136, :90] == 40).all()
