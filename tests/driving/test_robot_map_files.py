# SPDX-License-Identifier: Apache-2.0
"""Maps for map_server, read back by a reader that knows only its published rules, of a room that looks the same from no
two sides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rooms import SIZE, centres_of, costs_of, occupancy, read_map, room_field, turned, value_at, wall_distance

from ggslam.driving.bands import BandMap, HeightLayers, floor_plane
from ggslam.driving.inflation import Inflation, inflated_cost, parse_inflation
from ggslam.driving.map_files import occupancy_of_cost, scale_pixels, write_costmap, write_map
from ggslam.driving.pictures import band_picture, cost_colors
from ggslam.driving.robot import Robot
from ggslam.errors import ConfigError
from ggslam.volumes.cell_grid import CellGrid, SlicePlane

T_FLOOR_MAP, CELL = turned(), 0.05
LOW, TALL = Robot(0.4, 0.18), Robot(1.2, 0.3)
INFLATION = Inflation(0.55, 3.0)


@pytest.fixture(scope="module")
def layers() -> HeightLayers:
    field = room_field(T_FLOOR_MAP, 0.03)
    return HeightLayers(field, floor_plane(field, T_FLOOR_MAP), CELL)


@pytest.mark.parametrize("robot", [LOW, TALL])
def test_a_trinary_map_lies_where_the_room_is(layers: HeightLayers, robot: Robot, tmp_path: Path) -> None:
    image, description = write_map(layers.band(robot), tmp_path / "map_x")
    assert (image.name, description.name) == ("map_x.pgm", "map_x.yaml") and image.read_bytes().startswith(b"P5\n")
    grid, told = read_map(description)
    centres = centres_of(grid, told)
    truth = wall_distance(centres.reshape(-1, 2), *robot.band).reshape(grid.shape)
    on_boxes = (truth < 0) & ((centres > 0) & (centres < SIZE[:2])).all(2)
    occupied = (grid == 100) & ~on_boxes
    assert occupied.sum() > 200 and np.abs(truth[occupied]).max() < np.sqrt(0.5) * CELL + 0.003
    free = grid == 0
    assert free.sum() > 2000 and truth[free].min() > 0
    assert (grid[(truth > CELL) & (truth < 10)] == 0).all()
    assert set(np.unique(grid)) == {-1, 0, 100}


@pytest.mark.parametrize("robot", [LOW, TALL])
def test_walls_are_at_their_places_to_half_a_cell(layers: HeightLayers, robot: Robot, tmp_path: Path) -> None:
    grid, told = read_map(write_map(layers.band(robot), tmp_path / "map")[1])
    centres, row = centres_of(grid, told), int((1.5 - told["origin"][1]) / CELL)
    x = centres[row, grid[row] == 100, 0]
    assert min(abs(x - 0)) <= CELL / 2 and min(abs(x - SIZE[0])) <= CELL / 2
    column = int((2.4 - told["origin"][0]) / CELL)
    y = centres[grid[:, column] == 100, column, 1]
    assert min(abs(y - 0)) <= CELL / 2 and min(abs(y - SIZE[1])) <= CELL / 2


def test_nothing_is_mirrored(layers: HeightLayers, tmp_path: Path) -> None:
    low, tall = (read_map(write_map(layers.band(r), tmp_path / n)[1]) for r, n in ((LOW, "a"), (TALL, "b")))
    for grid, told in (low, tall):
        assert value_at(grid, told, 1.3, 0.54) == 100 and value_at(grid, told, 3.04, 2.4) == 100
        for x, y in ((SIZE[0] - 1.3, 0.54), (1.3, SIZE[1] - 1.1), (SIZE[0] - 3.2, 1.6), (3.2, SIZE[1] - 2.4)):
            assert value_at(grid, told, x, y) == 0
    assert value_at(*low, 1.0, 2.5) == 0 and value_at(*tall, 1.0, 2.5) == 100  # under the table, at its height


@pytest.mark.parametrize(
    ("grey", "negate", "found"),
    [(0, 0, 100), (88, 0, 100), (90, 0, -1), (204, 0, -1), (205, 0, -1), (206, 0, 0), (254, 0, 0), (255, 1, 100),
     (0, 1, 0), (49, 1, 0), (50, 1, -1)],
)  # fmt: skip
def test_the_reader_keeps_to_the_thresholds(grey: int, negate: int, found: int) -> None:
    told = {"mode": "trinary", "negate": negate, "occupied_thresh": 0.65, "free_thresh": 0.196}
    assert occupancy(np.array([float(grey)]), np.array([255]), told) == found


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_a_value_on_a_threshold_is_beyond_neither(mode: str) -> None:
    told = {"mode": mode, "negate": 0, "occupied_thresh": 1 - 51 / 255, "free_thresh": 1 - 204 / 255}
    found = occupancy(np.array([51.0, 204.0]), np.array([255, 255]), told)
    assert found.tolist() == ([-1, -1] if mode == "trinary" else [100, 0])


def test_every_value_of_a_costmap_is_read_back_as_it_is() -> None:
    values = np.arange(-1, 101)[None]
    rgba, told = scale_pixels(values), {"mode": "scale", "negate": 0, "occupied_thresh": 0.995, "free_thresh": 0.005}
    assert np.array_equal(occupancy(rgba[..., 0].astype(float), rgba[..., 3], told), values)


def test_costs_are_nav2s(layers: HeightLayers, tmp_path: Path) -> None:
    band = layers.band(TALL)
    cost = inflated_cost(band, TALL.radius, INFLATION)
    grid, told = read_map(write_costmap(band, cost, tmp_path / "costmap")[1])
    back = costs_of(grid)[::-1]
    assert np.array_equal(back == 254, band.occupied) and np.array_equal(back == 255, cost == 255)
    some = (cost > 0) & (cost < 254)
    assert some.sum() > 500 and np.abs(back - cost.astype(int))[some].max() <= 2
    assert (back[cost == 0] == 0).all() and (back[some] > 0).all()
    centres = centres_of(grid, told)[::-1]
    truth = wall_distance(centres.reshape(-1, 2), *TALL.band).reshape(cost.shape)
    beyond = (truth > 0.56) & (truth < 9)
    assert (cost[beyond & band.free] == 0).all() and beyond.any()
    ring = band.free & (truth > 0.31) & (truth < 0.51)
    error = np.abs(cost[ring] - 252 * np.exp(-3.0 * (truth[ring] - 0.3)))
    assert ring.sum() > 300 and error.mean() < 3 and error.max() < 25  # 3.5 cm of distance are 25 counts
    assert (cost[(truth > 0.03) & (truth < 0.27) & ~band.occupied] >= 253).all()  # corners are round by 3 cm


def exact_band(distance: list[float], occupied: list[bool], known: list[bool]) -> BandMap:
    flat = [np.array([values]) for values in (occupied, known, [False] * len(known), distance)]
    plane = SlicePlane(np.zeros(3), np.eye(3)[0], np.eye(3)[1], (0.0, 0.0), (0.05 * len(known), 0.05))
    grid = CellGrid(plane, 0.05, (1, len(known)))
    return BandMap(grid, (0.05, 0.4), flat[0], flat[1], flat[2], flat[3].astype(np.float32), np.zeros((0, 2)))


def test_the_formula_at_its_ends() -> None:
    distance = [0.0, 0.18, 0.1801, 0.28, 0.55, 0.5501, np.inf, 0.3, 0.1, 0.18]
    band = exact_band(distance, [True] + 9 * [False], 7 * [True] + 3 * [False])
    cost = inflated_cost(band, 0.18, Inflation(0.55, 10.0))[0]
    assert cost.tolist() == [254, 253, 251, 92, 6, 0, 0, 255, 253, 253]
    assert costs_of(occupancy_of_cost(cost)).tolist() == [254, 251, 251, 91, 5, 0, 0, 255, 251, 251]
    wide = inflated_cost(band, 0.18, Inflation(0.1, 10.0))[0]
    assert wide.tolist() == [254, 253, 0, 0, 0, 0, 0, 255, 253, 253]


def test_inflation_is_read() -> None:
    assert parse_inflation("0.8,3") == Inflation(0.8, 3.0)
    for text in ("", "0.8", "0.8,3,1", "a,b", "-1,3", "nan,1"):
        with pytest.raises(ConfigError, match=r"[iI]nflation"):
            parse_inflation(text)


def test_pictures_show_costs(layers: HeightLayers, tmp_path: Path) -> None:
    band = layers.band(LOW)
    cost = inflated_cost(band, LOW.radius)
    picture = band_picture(band, cost, LOW.radius, "low")
    times = -(-480 // min(cost.shape))
    shown: Any = picture[: times * cost.shape[0] : times, : times * cost.shape[1] : times]
    assert (shown == cost_colors(cost)).all(2).mean() > 0.95 and picture.shape[1] >= 560
    assert cv2.imencode(".png", picture)[0]
