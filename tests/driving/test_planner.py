# SPDX-License-Identifier: Apache-2.0
"""Paths through generated rooms of exact geometry: clear of it, found where there are ways, short."""

from __future__ import annotations

import numpy as np
import pytest
from plan_scenes import (
    Column,
    Room,
    ShortestWays,
    along,
    exact_clearance,
    random_room,
    room_field,
    room_planner,
    room_tsdf,
    trials,
)

from ggslam.driving.plan_maps import FieldCells, PlanMap, WholeArray
from ggslam.driving.plan_settings import PlanSettings
from ggslam.driving.planner import PlannedPath, Planner, headings
from ggslam.driving.way_grid import cell_distances
from ggslam.errors import InputError
from ggslam.native.loader import NativeContext

VOXEL = 0.05
ASKED = 0.25


def flat_planner(occupied: np.ndarray, cell: float = 0.1, clearance: float = 0.2) -> Planner:
    """On a floor of cells, bool [Y, X], of which all are known."""
    clear = cell_distances(occupied, cell, 30, NativeContext(1))
    T = np.eye(4)
    return Planner(PlanMap("floor", 2, cell, T, WholeArray((0, 0, 0), clear), T), clearance)


def room_with_door(cells: int) -> np.ndarray:
    """6 x 4 m in cells of 10 cm, with a wall across at x = 3 m and a door of so many cells in its middle."""
    occupied = np.zeros((40, 60), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[:, 30] = True
    occupied[20 - cells // 2 : 20 - cells // 2 + cells, 30] = False
    return occupied


@pytest.mark.long("scipy's shortest ways through rooms of 40,000 cells and their volumes")
def test_paths_on_the_floor() -> None:
    found = []
    for seed in range(3):
        room = random_room(seed, (8.0, 8.0, 2.5), 3, 16)
        found += trials(room_planner(room, VOXEL, False, ASKED), room, seed, 4, 5)
    exist = [t for t in found if t.exists]
    assert len(exist) > 40
    assert sum(t.found for t in exist) >= 0.99 * len(exist)
    assert not any(t.found for t in found if not t.exists)
    assert max(t.told for t in found if t.found) <= 1e-6, "less clearance than asked for"
    assert max(t.missing for t in found if t.found) <= VOXEL / 2, "nearer to the exact room than half a voxel explains"
    assert max(t.ratio for t in exist if t.found) <= 1.05


@pytest.mark.long("scipy's shortest ways in space")
def test_paths_in_space() -> None:
    found = []
    for seed in range(2):
        room = random_room(seed, (4.0, 4.0, 2.0), 1, 10)
        found += trials(room_planner(room, VOXEL, True, ASKED), room, seed, 2, 8)
    exist = [t for t in found if t.exists]
    assert len(exist) > 20
    assert sum(t.found for t in exist) >= 0.99 * len(exist)
    assert max(t.told for t in found if t.found) <= 1e-6
    assert max(t.missing for t in found if t.found) <= VOXEL / 2
    assert max(t.ratio for t in exist if t.found) <= 1.05


def test_a_straight_way_is_straight() -> None:
    planner = flat_planner(np.zeros((50, 50), bool))
    path = planner.plan(np.array([0.77, 0.93, 7.0]), np.array([4.21, 3.02, 0.0]))
    assert path.is_found and path.length == pytest.approx(np.hypot(3.44, 2.09), abs=1e-4)
    assert path.points[0] == pytest.approx([0.77, 0.93, 0.0], abs=1e-6)
    assert path.points[-1] == pytest.approx([4.21, 3.02, 0.0], abs=1e-6)
    assert path.yaw == pytest.approx(np.full(len(path.points), np.arctan2(2.09, 3.44)), abs=1e-3)


@pytest.mark.parametrize("shift", [0.0, 1e-9, 0.03])
def test_hardly_any_way(shift: float) -> None:
    planner = flat_planner(np.zeros((50, 50), bool))
    path = planner.plan(np.array([2.0, 2.03, 0.0]), np.array([2.0 + shift, 2.03, 0.0]))
    assert path.is_found and path.length == pytest.approx(shift, abs=1e-6)
    assert path.yaw is not None and np.isfinite(path.yaw).all() and np.isfinite(path.points).all()


def test_wider_paths_cost_what_they_may() -> None:
    """Past one corner: with a margin the path keeps away from it, and is hardly longer."""
    room = Room((6.0, 6.0, 1.0), (Column((2.0, 2.0), (1.5, 1.5), 0.0, 0.0, 1.0, False),))
    start, goal = np.array([0.25 + 3.9, 0.4, 0.0]), np.array([0.4, 4.15, 0.0])
    lengths, clearances = [], []
    for weight in (0.0, 0.03, 1.0):
        planner = room_planner(room, VOXEL, False, ASKED, PlanSettings(weight=weight, passes=0 if weight == 0 else 40))
        path = planner.plan(start, goal)
        assert path.is_found
        lengths.append(path.length)
        clearances.append(float(exact_clearance(room, along(path.points), 2).mean()))
    assert clearances[0] < clearances[1] <= clearances[2] + 0.02
    assert lengths[0] <= lengths[1] <= 1.03 * lengths[0] + 1e-6


def test_a_smoothed_path_turns_less() -> None:
    planner = flat_planner(room_with_door(10))
    start, goal = np.array([1.6, 0.6, 0]), np.array([4.6, 0.6, 0])
    smooth = planner.plan(start, goal)
    planner.settings = PlanSettings(passes=0)
    straight = planner.plan(start, goal)

    def sharpest(path: PlannedPath) -> float:
        turns = np.diff(headings(path.points)[:-1])
        return float(np.degrees(np.abs((turns + np.pi) % (2 * np.pi) - np.pi).max()))

    assert sharpest(smooth) < 0.6 * sharpest(straight)
    assert smooth.least_clearance >= 0.2


# --- no path ---------------------------------------------------------------------------------------------------------


def test_the_widest_way_is_named() -> None:
    path = flat_planner(room_with_door(3), clearance=0.3).plan(np.array([1.05, 1, 0]), np.array([5, 3, 0]))
    assert not path.is_found and path.narrowest is not None and len(path.points) == 0
    assert path.narrowest == pytest.approx([3.05, 2.05, 0.0], abs=0.06)
    assert path.reason == "no way: the widest one has 0.15 m clearance at (3.05, 2.05, 0.00), 0.30 m asked"
    assert flat_planner(room_with_door(3), clearance=0.149).plan(np.array([1.05, 1, 0]), np.array([5, 3, 0])).is_found


def test_no_door_at_all() -> None:
    path = flat_planner(room_with_door(0)).plan(np.array([1, 1, 0]), np.array([5, 3, 0]))
    assert not path.is_found and "separate start and goal" in str(path.reason)


@pytest.mark.parametrize(
    ("start", "reason"),
    [
        ((3.05, 0.5, 0), "the start lies in an obstacle; the nearest place that fits is (2.75, 0.45, 0.00), 0.30 m"),
        ((2.9, 1, 0), "the start is 0.10 m from an obstacle, 0.20 m asked"),
        ((70, 1, 0), "the start lies in unknown space, or outside the map"),
    ],
)
def test_starts_that_do_not_fit(start: tuple[float, float, float], reason: str) -> None:
    path = flat_planner(room_with_door(8)).plan(np.array(start), np.array([5, 3, 0]))
    assert not path.is_found and reason in str(path.reason)


def test_places_that_are_none_are_refused() -> None:
    planner = flat_planner(room_with_door(8))
    with pytest.raises(InputError, match="goal: expected three finite numbers"):
        planner.plan(np.zeros(3), np.array([1, np.nan, 0]))


# --- what changes ----------------------------------------------------------------------------------------------------


def test_a_new_obstacle_is_gone_around() -> None:
    planner = flat_planner(room_with_door(16))
    start, goal = np.array([1, 2, 0]), np.array([5, 2, 0])
    before = planner.plan(start, goal)
    block = np.stack(np.meshgrid(np.arange(2.6, 3.3, 0.05), np.arange(1.8, 2.1, 0.05), [0.2]), -1).reshape(-1, 3)
    planner.add_obstacles(block)
    after = planner.plan(start, goal)
    assert before.length < 4.05 and after.is_found and after.length > 4.05
    gaps = np.linalg.norm(along(after.points)[:, None, :2] - block[None, :, :2], axis=2).min()
    assert gaps >= 0.2 - 1e-6
    planner.update((0, 0, 0), cell_distances(room_with_door(16), 0.1, 30, NativeContext(1)))
    assert planner.plan(start, goal).length == pytest.approx(before.length, abs=1e-6)


def test_blocks_of_a_field_that_changed() -> None:
    """A column comes into a room, and goes again: the planner takes the field's blocks over."""
    empty = Room((4.0, 2.0, 1.0), ())
    full = Room(empty.size, (Column((2.0, 0.9), (0.15, 0.15), 0.0, 0.0, 1.0, True),))
    field, T = room_field(empty, 0.05), np.eye(4)
    planner = Planner(PlanMap("room", 3, 0.05, T, FieldCells(field, 1), T), 0.2)
    start, goal = np.array([0.5, 0.9, 0.5]), np.array([3.5, 0.95, 0.5])
    lengths = []
    for room in (empty, full, empty):
        changed = room_tsdf(room, 0.05)
        coordinates = changed.blocks().coordinates
        voxels = changed.read(coordinates)
        field.tsdf.write(coordinates, value=voxels.value, weight=voxels.weight)
        field.update()
        planner.update_blocks(field.coordinates())
        path = planner.plan(start, goal)
        assert path.is_found
        assert exact_clearance(room, along(path.points), 3).min() >= 0.2 - 0.025
        lengths.append(path.length)
    assert lengths[0] == pytest.approx(3.0, abs=0.01) and lengths[1] > 3.03
    assert lengths[2] == pytest.approx(lengths[0], abs=1e-3)


def test_what_was_learned_of_a_goal_changes_no_cost() -> None:
    """Searches for the same goal, obstacle after obstacle, find what a planner that knows nothing yet finds."""
    planner, start, goal = flat_planner(room_with_door(16)), np.array([1, 2, 0]), np.array([5, 2, 0])
    blocks = [np.array([[x, y, 0.0]]) for x, y in ((2.05, 2.05), (3.05, 1.85), (3.05, 2.35), (4.15, 2.05))]
    looked_at = np.zeros(2, int)
    planner.plan(start, goal)
    for number, block in enumerate(blocks):
        planner.add_obstacles(block)
        fresh = flat_planner(room_with_door(16))
        for there in blocks[: number + 1]:
            fresh.add_obstacles(there)
        again, first = (p.grid.search(start, goal, p.costs, lambda page: None) for p in (planner, fresh))
        assert again.cost == pytest.approx(first.cost, rel=0.006)  # what a search takes for worthwhile
        looked_at += again.expanded, first.expanded
    assert looked_at[0] < looked_at[1]


def test_a_goal_behind_a_wall_is_not_looked_for() -> None:
    planner = flat_planner(room_with_door(0))
    way = planner.grid.search(np.array([1.0, 1, 0]), np.array([5.0, 3, 0]), planner.costs, lambda page: None)
    assert way.points is None and way.expanded == 0


def test_a_way_around_is_found_without_looking_everywhere() -> None:
    """Out of a pocket that opens away from the goal: as short as scipy's way, and few of the cells are looked at."""
    occupied = np.zeros((300, 300), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[50:250, 200] = occupied[50, 40:201] = occupied[249, 40:201] = True
    planner = flat_planner(occupied)
    clear = cell_distances(occupied, 0.1, 30, NativeContext(1))
    start, goal = (150, 190), (150, 260)
    ends = [np.array([at[1] + 0.5, at[0] + 0.5, 0]) * 0.1 for at in (start, goal)]
    way = planner.grid.search(ends[0], ends[1], planner.costs, lambda page: None)
    assert way.points is not None
    length = float(np.linalg.norm(np.diff(way.points, axis=0), axis=1).sum())
    shortest = 0.1 * float(ShortestWays(clear >= 0.2).lengths(np.array(start), np.array([goal]))[0])
    assert length <= 1.03 * shortest
    assert way.expanded < 0.2 * np.count_nonzero(clear >= 0.2)


def test_searches_repeat_bit_for_bit() -> None:
    room = random_room(5, (6.0, 6.0, 2.0), 2, 10)
    one, other = (room_planner(room, 0.1, True, 0.2) for _ in range(2))
    start, goal = np.array([0.5, 0.5, 1.5]), np.array([5.5, 5.4, 1.6])
    first, again = one.plan(start, goal), one.plan(start, goal)
    assert np.array_equal(first.points, again.points) and np.array_equal(first.points, other.plan(start, goal).points)
