# SPDX-License-Identifier: Apache-2.0
"""Slices of the distance field, and the files made of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from distance_scenes import block_range, box, plane, sphere, union, write_scene

from ggslam.errors import RunFolderError
from ggslam.reporting.pictures import write_picture
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.slices import (
    FieldSlice,
    SlicePlane,
    plane_at_height,
    slice_field,
    slice_picture,
)
from ggslam.volumes.tsdf import TsdfMap

VOXEL = 0.05
BALL = (0.7, 0.5, 0.0)


@pytest.fixture(scope="module")
def field() -> DistanceField:
    """A floor at z = -0.5, a ball at the upper right, a low box at the left; z is up; known for |y| < 1.2, x < 1.6."""
    tsdf = TsdfMap(TsdfSettings(voxel=VOXEL))
    scene = union(plane((0, 0, -0.5), (0, 0, 1)), sphere(BALL, 0.2), box((-1, -0.3, -0.5), (-0.7, 0.3, -0.2)))
    write_scene(tsdf, scene, block_range((-1.6, -1.2, -0.8), (1.6, 1.2, 0.8), VOXEL))
    field = DistanceField(tsdf)
    field.update()
    return field


def at(cut: FieldSlice, x: float, y: float) -> tuple[int, int]:
    """Row and column of a place on the plane."""
    rows = cut.known.shape[0]
    from_bottom = int((y - cut.plane.low[1]) / cut.resolution)
    return rows - 1 - from_bottom, int((x - cut.plane.low[0]) / cut.resolution)


def test_a_slice_lies_the_right_way_round(field: DistanceField) -> None:
    cut = slice_field(field, plane_at_height(field, np.array([0, 0, 1]), 0.0), 0.05)
    assert cut.known.shape == (48, 64)
    assert np.allclose(cut.plane.x_axis, [1, 0, 0]) and np.allclose(cut.plane.y_axis, [0, 1, 0])
    row, column = at(cut, 0.7 - 0.17, 0.5)
    assert row < 24 and column > 32 and cut.occupied[row, column]
    assert not cut.occupied[at(cut, 0.7, -0.5)] and cut.known[at(cut, 0.7, -0.5)]
    free = at(cut, 0.0, 0.5)
    assert cut.distance[free] == pytest.approx(0.5, abs=0.05)
    assert cut.known[at(cut, 1.55, 1.15)]


def test_planes_are_oriented_as_told(field: DistanceField) -> None:
    """Upright: x along the world's y, y along its z."""
    upright = SlicePlane(
        np.array([0.7, 0, 0]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), (-1.0, -0.75), (1.0, 0.75)
    )
    cut = slice_field(field, upright, 0.02)
    assert cut.known.shape == (75, 100)
    assert cut.occupied[at(cut, 0.5, 0.19)] and not cut.occupied[at(cut, 0.5, 0.3)]
    assert cut.occupied[at(cut, -0.8, -0.51)] and not cut.known[at(cut, -0.8, -0.73)]
    truth = np.hypot(0.3 - 0.5, 0.4) - 0.2
    assert cut.distance[at(cut, 0.3, 0.4)] == pytest.approx(truth, abs=0.02)


def test_any_obstacle_in_the_band_counts(field: DistanceField) -> None:
    level = plane_at_height(field, np.array([0, 0, 1]), 0.0)
    alone, band = slice_field(field, level, 0.05), slice_field(field, level, 0.05, (-0.4, 0.3))
    low_box = at(alone, -0.85, 0.28)
    assert not alone.occupied[low_box] and band.occupied[low_box]
    assert band.occupied[at(band, 0.7 - 0.17, 0.5)]
    assert not band.occupied[at(band, 0, 0)] and band.known[at(band, 0, 0)]
    assert slice_field(field, level, 0.05, (-0.7, 0.3)).occupied[at(band, 0, 0)]  # the floor is in the band
    high = slice_field(field, plane_at_height(field, np.array([0, 0, 1]), 0.9), 0.05)
    assert not high.known.any() and not high.occupied.any()
    partly = slice_field(field, plane_at_height(field, np.array([0, 0, 1]), 0.9), 0.05, (-0.3, 0.0))
    assert partly.known[at(partly, 0, 0)] and not partly.occupied[at(partly, 0, 0)]


def test_pictures_show_distances_and_what_is_unknown(field: DistanceField, tmp_path: Path) -> None:
    upright = SlicePlane(np.array([0.7, 0, 0]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), (-1.0, -0.9), (1.0, 0.9))
    cut = slice_field(field, upright, 0.02)
    picture = slice_picture(cut, 1.0)
    times = picture.shape[1] // cut.known.shape[1]
    shown = picture[: times * cut.known.shape[0] : times, ::times].astype(int)
    assert (shown[~cut.known] == 128).all()
    near, far = shown[at(cut, 0.5, 0.35)], shown[at(cut, -0.9, 0.7)]
    assert near[0] > near[2] and far[2] > far[0]  # red and blue
    write_picture(tmp_path / "slice.png", slice_picture(cut, 1.0))
    assert np.array_equal(cv2.imread(str(tmp_path / "slice.png"))[..., ::-1], picture)
    with pytest.raises(RunFolderError, match="nowhere"):
        write_picture(tmp_path / "nowhere" / "slice.png", slice_picture(cut, 1.0))


def test_wrong_numbers_are_refused(field: DistanceField) -> None:
    level = plane_at_height(field, np.array([0, 0, 1]), 0.0)
    for resolution, band in ((0.0, None), (float("nan"), None), (0.1, (1.0, 0.0)), (1e-5, None)):
        with pytest.raises(ValueError, match="resolution"):
            slice_field(field, level, resolution, band)
    empty = DistanceField(TsdfMap())
    assert not slice_field(empty, plane_at_height(empty, np.array([1, 0, 0]), 0.0), 0.1).known.any()
