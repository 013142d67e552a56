# SPDX-License-Identifier: Apache-2.0
"""Slices, bands and distances of cells on disk, a few at a time, are those of everything in memory, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from paged_corridor import LENGTH, SETTINGS, corridor, fuse, views

from ggslam.driving.bands import HeightLayers
from ggslam.driving.robot import Robot
from ggslam.system.tuning import overridden
from ggslam.volumes.cell_field import CellField, CellFieldTuning
from ggslam.volumes.cell_grid import SlicePlane
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.slices import plane_at_height, slice_field

LEVEL, TILTED = np.array([0.0, 0.0, 1.0]), np.array([0.03, -0.05, 1.0])
FIELDS = ("distance", "gradient", "known", "stale")


def moved(seen: list[PosedView], by: np.ndarray) -> list[PosedView]:
    T = np.eye(4)
    T[:3, 3] = by
    return [replace(view, T_world_camera=T @ view.T_world_camera) for view in seen]


def both(folder: Path, seen: list[PosedView]) -> tuple[CellField, DistanceField]:
    """The field of cells on disk, and that of the same map in memory."""
    paged = fuse(seen, Paging(folder / "cells", lambda held: 2_500_000), SETTINGS, esdf=True)
    whole = fuse(seen, None, SETTINGS, esdf=True)
    paged.finish(), whole.finish()
    assert isinstance(paged.finished_field, CellField) and whole.field is not None
    assert len(paged.tsdf) == 0 and len(paged.finished_field) == len(whole.field) > 500
    return paged.finished_field, whole.field


@pytest.fixture(scope="module")
def fields(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellField, DistanceField]:
    return both(tmp_path_factory.mktemp("paged"), views()[:40])


def assert_same(a: object, b: object, names: tuple[str, ...]) -> None:
    for name in names:
        one, other = getattr(a, name), getattr(b, name)
        assert one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), name


@pytest.mark.parametrize(
    ("up", "height", "side", "resolution"),
    [(LEVEL, 0.41, 2, 0.16), (TILTED, 0.0, 3, 0.08), (LEVEL, -1.3, 4, 0.08), (TILTED, 0.41, 4, 0.05)],
)
def test_slices_are_those_of_the_whole_map(
    up: np.ndarray, height: float, side: int, resolution: float, fields: tuple[CellField, DistanceField]
) -> None:
    cells, whole = fields
    plane = plane_at_height(whole, up, height)
    own = plane_at_height(cells, up, height)
    assert own.low == plane.low and own.high == plane.high
    with overridden(CellFieldTuning, side=side):
        found = slice_field(cells, own, resolution)
    expected = slice_field(whole, plane, resolution)
    assert_same(found, expected, ("distance", "known", "occupied", "behind", "free"))
    assert expected.known.sum() > 100 and expected.occupied.any() and (height < -1 or expected.free.sum() > 100)


@pytest.mark.parametrize(("up", "side", "resolution"), [(LEVEL, 2, 0.16), (TILTED, 3, 0.08), (TILTED, 4, 0.05)])
def test_bands_are_those_of_the_whole_map(
    up: np.ndarray, side: int, resolution: float, fields: tuple[CellField, DistanceField]
) -> None:
    cells, whole = fields
    plane = plane_at_height(whole, up, -1.3)
    with overridden(CellFieldTuning, side=side):
        layers, expected = HeightLayers(cells, plane, resolution), HeightLayers(whole, plane, resolution)
        for robot in (Robot(0.4, 0.2), Robot(1.6, 0.3, 0.12), Robot(2.2, 0.3, 1.0)):
            found, band = layers.band(robot), expected.band(robot)
            assert_same(found, band, ("occupied", "known", "behind", "free", "distance", "points"))
            assert np.array_equal(layers.drops(robot.step), expected.drops(robot.step))
            assert band.known.sum() > 100 and band.occupied.sum() > 20
        found, band = layers.between(-0.5, 99.0), expected.between(-0.5, 99.0)
        assert found.heights == band.heights and not band.free.all()
        assert_same(found, band, ("occupied", "known", "behind", "distance"))


def test_free_space_is_known_and_distances_are_true(fields: tuple[CellField, DistanceField]) -> None:
    """So that what is compared is the corridor."""
    cells, _ = fields
    plane = plane_at_height(cells, LEVEL, 0.0)
    cut = slice_field(cells, plane, 0.08)
    truth = corridor().distance(plane_places(cut.plane, cut.known.shape, 0.08)).reshape(cut.known.shape)
    off = np.abs(cut.distance - np.minimum(truth, 2.0))[cut.free]
    assert np.median(off) < 0.005 and cut.free.sum() > 0.5 * LENGTH * 2.4 / 0.08**2 / 2
    band = HeightLayers(cells, plane_at_height(cells, LEVEL, -1.3), 0.08).band(Robot(0.8, 0.2, 0.2))
    assert 0.9 * 1.2 < band.distance[band.free].max() < 2.0


def plane_places(plane: SlicePlane, shape: tuple[int, int], resolution: float) -> np.ndarray:
    x = plane.low[0] + (np.arange(shape[1]) + 0.5) * resolution
    y = plane.high[1] - (np.arange(shape[0]) + 0.5) * resolution
    at = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return plane.origin + at @ np.stack([plane.x_axis, plane.y_axis])


def test_distances_and_gradients_anywhere_are_those_of_the_whole_map(fields: tuple[CellField, DistanceField]) -> None:
    cells, whole = fields
    rng = np.random.default_rng(3)
    points = rng.uniform((-2, -2, -2), (LENGTH + 2, 2, 2), (4000, 3))
    points[:3] = [np.nan, 0, 0], [1e9, 0, 0], [np.inf, 1, 1]
    found, expected = cells.query(points), whole.query(points)
    assert_same(found, expected, FIELDS)
    assert 1000 < expected.known.sum() < 4000
    assert 0 < cells.memory_bytes < whole.memory_bytes


def test_far_from_zero_maps_are_the_same(tmp_path: Path) -> None:
    cells, whole = both(tmp_path, moved(views()[:30], np.array([412_345.678, 5_312_345.9, 88.8])))
    assert np.abs(cells.origin).max() > 1e5
    at = plane_at_height(whole, TILTED, 0.1)
    assert_same(slice_field(cells, at, 0.08), slice_field(whole, at, 0.08), ("distance", "occupied", "behind"))
    plane = plane_at_height(whole, TILTED, -1.3)
    found, band = HeightLayers(cells, plane, 0.08).band(Robot()), HeightLayers(whole, plane, 0.08).band(Robot())
    assert_same(found, band, ("occupied", "known", "behind", "distance"))


def test_finished_maps_answer_for_the_whole_map_and_can_go_on(tmp_path: Path) -> None:
    seen = views()
    settings = replace(SETTINGS, esdf_every=1)
    paged = fuse(seen[:30], Paging(tmp_path / "cells", lambda held: 4_000_000), settings, esdf=True)
    whole = fuse(seen[:30], None, SETTINGS, esdf=True)
    paged.finish(), whole.finish()
    points = np.random.default_rng(4).uniform((0, -1.2, -1.3), (LENGTH, 1.2, 1.2), (1000, 3))
    found, expected = paged.query(points), whole.query(points)
    assert_same(found, expected, (*FIELDS, "exact", "at_least"))
    assert found.exact.sum() > 700
    for view in seen[30:34]:
        paged.add_together([view]), whole.add_together([view])
    assert paged.cell_field is None and paged.query(points).exact.sum() > 100
    paged.finish(), whole.finish()
    assert_same(slice_field(of(paged), plane_at_height(of(paged), LEVEL, 0.0), 0.08),
                slice_field(anew(whole), plane_at_height(of(whole), LEVEL, 0.0), 0.08),
                ("distance", "occupied", "behind"))  # fmt: skip


def of(maps: VolumeMaps) -> CellField | DistanceField:
    assert maps.finished_field is not None
    return maps.finished_field


def anew(maps: VolumeMaps) -> DistanceField:
    """Anew: one that was brought up to date holds surface points of before."""
    field = DistanceField(maps.tsdf, maps.settings.esdf)
    field.update()
    return field
