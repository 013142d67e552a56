# SPDX-License-Identifier: Apache-2.0
"""Bands of a room whose geometry is exact."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rooms import BOXES, SIZE, room_field, turned, wall_distance

from ggslam.driving.band_sources import BandSourceTuning
from ggslam.driving.bands import BandMap, HeightLayers, band_map, floor_plane
from ggslam.driving.robot import Robot
from ggslam.errors import InputError
from ggslam.system.tuning import overridden
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.tsdf import TsdfMap

T_FLOOR_MAP = turned()
VOXEL, CELL = 0.04, 0.05
LOW, TALL = Robot(0.4, 0.18), Robot(1.2, 0.3)


@pytest.fixture(scope="module")
def field() -> DistanceField:
    return room_field(T_FLOOR_MAP, VOXEL)


@pytest.fixture(scope="module")
def layers(field: DistanceField) -> HeightLayers:
    return HeightLayers(field, floor_plane(field, T_FLOOR_MAP), CELL)


def places(band: BandMap) -> np.ndarray:
    return band.grid.centres().reshape(-1, 2)


@pytest.mark.parametrize("robot", [LOW, TALL])
def test_distances_are_those_of_the_room(layers: HeightLayers, robot: Robot) -> None:
    band = layers.band(robot)
    truth = wall_distance(places(band), *robot.band).reshape(band.distance.shape)
    inside = truth > 0
    error = np.abs(band.distance - truth)[inside]
    assert inside.sum() > 3000 and error.mean() < 0.003 and error.max() < 0.035
    assert (band.free == (truth > CELL / 2))[np.abs(truth - CELL / 2) > 0.01].mean() > 0.985


@pytest.mark.parametrize("robot", [LOW, TALL])
def test_what_is_occupied_is_within_half_a_cell_of_a_surface(layers: HeightLayers, robot: Robot) -> None:
    """Half a cell along x or y; upon boxes, whose tops are in the band, all cells are."""
    band = layers.band(robot)
    truth = wall_distance(places(band), *robot.band).reshape(band.distance.shape)
    on_boxes = (truth < 0) & (places(band) > 0).all(1).reshape(truth.shape)
    found = band.occupied & ~on_boxes
    assert found.sum() > 200 and np.abs(truth[found]).max() < np.sqrt(0.5) * CELL + 0.005
    on_wall = np.abs(truth) < CELL / 2 - 0.005
    x, y = np.moveaxis(band.grid.centres(), -1, 0)
    assert band.occupied[on_wall & ~((x > 3.02) & (x < 3.53) & (y > 3.0))].all()  # the cupboard hides the wall


def test_each_robot_meets_what_is_at_its_height(layers: HeightLayers) -> None:
    low, tall = layers.band(LOW), layers.band(TALL)
    under_table = low.grid.cells_of(np.array([[1.0, 2.5]]))[:2]
    assert low.free[under_table].all() and not tall.free[under_table].any()
    on_box = low.grid.cells_of(np.array([[1.3, 0.7]]))[:2]
    assert not low.free[on_box].any() and not tall.free[on_box].any()
    crawler = layers.band(Robot(0.72, 0.1, 0.33))  # its belly is above the low box
    assert crawler.free[crawler.grid.cells_of(np.array([[1.3, 0.75]]))[:2]].all()


def test_the_floor_does_not_count(field: DistanceField) -> None:
    for cell in (CELL, 0.2):
        band = band_map(field, T_FLOOR_MAP, LOW, cell)
        open_floor = band.grid.cells_of(np.array([[2.4, 1.4]]))[:2]
        assert band.distance[open_floor] > 0.6 and band.free[open_floor].all()


def test_bands_of_one_volume_are_those_of_each_alone(field: DistanceField, layers: HeightLayers) -> None:
    for robot in (TALL, LOW):
        one, alone = layers.band(robot), band_map(field, T_FLOOR_MAP, robot, CELL)
        for name in ("occupied", "known", "distance", "behind"):
            assert np.array_equal(getattr(one, name), getattr(alone, name))


def test_bands_of_large_maps_are_the_same(field: DistanceField, layers: HeightLayers) -> None:
    """Of which not all heights are held."""
    cells = layers.grid.shape[0] * layers.grid.shape[1]
    with overridden(BandSourceTuning, most_layer_bytes=5 * cells):
        few = HeightLayers(field, floor_plane(field, T_FLOOR_MAP), CELL)
        for robot in (TALL, LOW, TALL):
            assert np.array_equal(few.band(robot).free, layers.band(robot).free)


@pytest.mark.parametrize("cell", [0.02, 0.04, 0.1, 0.25])
def test_walls_have_no_holes_at_any_resolution(field: DistanceField, cell: float) -> None:
    """Nobody gets out of the room."""
    band = band_map(field, T_FLOOR_MAP, LOW, cell)
    labels = cv2.connectedComponents((~band.occupied).astype(np.uint8), connectivity=4)[1]
    (row,), (column,), _ = band.grid.cells_of(np.array([[2.4, 1.4]]))
    out = wall_distance(places(band), *LOW.band).reshape(labels.shape) < -0.02
    assert labels[row, column] and not (labels[out] == labels[row, column]).any()


def test_any_obstacle_between_two_heights_counts(field: DistanceField, layers: HeightLayers) -> None:
    at = [tuple(int(i[0]) for i in layers.grid.cells_of(np.array([place]))[:2]) for place in ((2.4, 1.4), (1.3, 0.54))]
    open_floor, low_box = at
    assert layers.between(0.1, 0.3).occupied[low_box] and not layers.between(0.5, 0.9).occupied[low_box]
    assert layers.between(-0.2, 0.3).occupied[open_floor]  # the floor is between them
    high = layers.between(3.0, 4.0)
    assert not high.known.any() and not high.occupied.any() and high.heights[0] == 3.0
    partly = layers.between(1.5, 99.0)
    assert partly.known[open_floor] and partly.heights[1] < 4
    with pytest.raises(InputError, match="heights"):
        layers.between(1.0, 0.5)


def test_empty_volumes_know_nothing() -> None:
    band = band_map(DistanceField(TsdfMap()), np.eye(4), LOW, 0.1)
    assert not band.known.any() and not band.occupied.any() and np.isinf(band.distance).all()
    with pytest.raises(InputError, match="resolution"):
        band_map(DistanceField(TsdfMap()), np.eye(4), LOW, 0.0)


def test_the_room_is_asymmetric() -> None:
    grid = np.stack(np.meshgrid(np.arange(0, SIZE[0], 0.1), np.arange(0, SIZE[1], 0.1)), -1)
    truth = wall_distance(grid.reshape(-1, 2), 0.05, 1.2).reshape(grid.shape[:2])
    assert np.abs(truth - truth[::-1]).max() > 0.3 and np.abs(truth - truth[:, ::-1]).max() > 0.3 and len(BOXES) == 3
