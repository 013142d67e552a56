# SPDX-License-Identifier: Apache-2.0
"""What moves, with exact truth: where it is, how fast, and that nothing stays of it."""

from __future__ import annotations

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from box_scene import CAMERA, HALF, box_pose, camera_pose, render, view_of

from ggslam.driving.bands import BandMap, HeightLayers
from ggslam.driving.dynamic_layer import DynamicLayer, DynamicSettings, Sighting, sightings_in
from ggslam.driving.outlines import convex_outline, outline_gap
from ggslam.driving.robot import Robot
from ggslam.errors import InputError
from ggslam.movers.detector import MoverDetector
from ggslam.movers.mover_table import FoundMover
from ggslam.movers.settings import MoverSettings
from ggslam.movers.tracks import MoverTracks
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, se3_exp, transform_points
from ggslam.sight.margin import Margin
from ggslam.volumes.cell_grid import CellGrid, SlicePlane
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

PLANE = SlicePlane(np.array([0, 0.4, 0.0]), np.array([1.0, 0, 0]), np.array([0.0, 0, 1]), (-1.5, 0.0), (1.5, 3.2))
"""Seen from above: x right, y away from the camera; heights are against the camera's y."""
GRID, HEIGHTS, RATE = CellGrid.over(PLANE, 0.05), (0.05, 0.9), 30.0
BEGINS, LAST = 12, 40


def way(n: int) -> np.ndarray:
    """T_world_box: rests, then goes to the right with 45 cm/s and away with 18 cm/s, turning by 30 degrees a second."""
    s = max(0, n - BEGINS) / RATE
    T = box_pose(-0.3 + 0.45 * s, np.radians(30) * s)
    T[2, 3] += 0.18 * s
    return T


VELOCITY = np.array([0.45, 0.0, 0.18])


def corners(n: float) -> np.ndarray:
    box = HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return transform_points(box, way(int(n)))


@cache
def film(noise: float = 0.0) -> tuple[list[tuple[int, DynamicLayer]], DistanceField, list[FoundMover]]:
    """Detection, tracks, layer and the map of what stands, frame by frame, with exact poses of the camera."""
    detector, tracks, context = MoverDetector(MoverSettings()), MoverTracks(), NativeContext()
    layer, margin, tsdf = DynamicLayer(), Margin(0.01, 0.0, 3.0, 0.002, 0.001), TsdfMap(TsdfSettings(voxel=0.05))
    seen = []
    for n in range(LAST):
        frame = render(n, [(way(n), 7)], noise=noise)
        detector.look(frame, camera_pose(n), margin, context)
        tracks.look(view_of(frame), detector.things)
        tsdf.integrate(detector.clean(frame).depth, CAMERA, camera_pose(n))
        layer.observe(tracks, n, n / RATE)
        seen.append((n, deepcopy(layer)))
    for n in range(LAST, LAST + 12):  # it is gone
        tsdf.integrate(detector.clean(render(n, [], noise=noise)).depth, CAMERA, camera_pose(n))
    field = DistanceField(tsdf)
    field.update()
    return seen, field, tracks.describe()


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_places_and_velocities_are_exact_to_centimetres(noise: float) -> None:
    places, velocities = [], []
    for n in range(BEGINS + 4, LAST):
        layer = film(noise)[0][n][1]
        obstacles = layer.obstacles_at(n / RATE)
        if n < 22:
            continue
        (obstacle,) = obstacles
        assert obstacle.unseen_s == 0
        truth = transform_points(obstacle.points, inverse(way(n)))
        outside = np.maximum(np.abs(truth) - HALF, 0).max(1)
        places.append(100 * np.percentile(outside, 99))
        before = transform_points(obstacle.middle[None], way(n - 1) @ inverse(way(n)))[0]
        velocities.append(100 * np.linalg.norm(obstacle.velocity - RATE * (obstacle.middle - before)))
    assert len(places) > 10
    assert max(places) < (0.3 if noise == 0 else 1.0), places  # cm outside of the true box
    assert np.median(velocities) < 1.5 and max(velocities) < 3, velocities  # of 48 cm/s


def test_cells_are_where_the_box_is() -> None:
    for n in (24, 32, 39):
        layer = film()[0][n][1]
        cells = layer.cells_at(n / RATE, GRID, HEIGHTS)
        outline = convex_outline(PLANE.coordinates(corners(n))[:, :2])
        gap = outline_gap(outline, GRID.centres().reshape(-1, 2)).reshape(cells.shape)
        assert gap[cells].max() < 0.05 + 0.025 + 0.02  # margin, half a cell
        front = transform_points(np.array([[0.0, 0, -HALF[2]]]), way(n))
        row, column, _ = GRID.cells_of(PLANE.coordinates(front)[:, :2])
        assert cells[row, column].all() and 10 < cells.sum() < 150


def test_cells_ahead_are_where_it_will_be() -> None:
    """It goes on for half a second."""
    n, ahead = 28, 12
    layer = film()[0][n][1]
    now, will = (layer.cells_at(n / RATE, GRID, HEIGHTS, t) for t in (0.0, ahead / RATE))
    assert (will | now == will).all()
    for later in range(n, n + ahead + 1, 3):
        middle = PLANE.coordinates(transform_points(np.array([[0.0, 0, -0.5 * HALF[2]]]), way(later)))
        row, column, _ = GRID.cells_of(middle[:, :2])
        assert will[row, column].all()
    unseen = layer.obstacles_at((n + 6) / RATE)[0]
    truth = layer.obstacles_at(n / RATE)[0].middle + VELOCITY * 6 / RATE
    assert unseen.unseen_s == pytest.approx(0.2) and np.linalg.norm(unseen.middle - truth) < 0.02


def test_the_static_map_is_free_where_it_passed_and_nothing_stays() -> None:
    seen, field, _ = film()
    band = HeightLayers(field, PLANE, 0.05, floor_seen=False).band(Robot(0.6, 0.1, 0.1))
    layer = seen[-1][1]
    passed = np.zeros(GRID.shape, bool)
    for n in range(BEGINS + 6, LAST):
        passed |= seen[n][1].cells_at(n / RATE, GRID, HEIGHTS)
    in_view = band.known
    assert (passed & in_view).sum() > 100 and band.free[passed & in_view].mean() > 0.99
    now = (LAST - 1) / RATE
    with_it = layer.over(band, now)
    cells = layer.cells_at(now, GRID, band.heights)
    assert with_it.occupied[cells].all() and not with_it.free[cells].any() and cells.sum() > 10
    assert np.array_equal(with_it.occupied & ~cells, band.occupied & ~cells) and band.free[cells & in_view].all()
    assert (with_it.distance <= band.distance).all() and (with_it.distance[cells] <= 0.025).all()
    assert len(layer.obstacles_at(now + 0.99)) == 1 and layer.obstacles_at(now + 1.01) == []
    assert not layer.cells_at(now + 1.01, GRID, HEIGHTS).any()
    later = layer.over(band, now + 1.01)
    assert np.array_equal(later.occupied, band.occupied) and np.array_equal(later.distance, band.distance)
    layer.take([], now + 1.01)
    assert len(layer) == 0


def things(x: float, number: int = 1, low: float = 0.1) -> Sighting:
    T = np.eye(4)
    T[0, 3] = x
    box = np.array([[a, b, c] for a in (-0.1, 0.1) for b in (-low - 0.2, -low) for c in (0.9, 1.1)])
    return Sighting(number, T, box)


def flat_band() -> BandMap:
    nothing = np.zeros(GRID.shape, bool)
    far = np.full(GRID.shape, np.inf, np.float32)
    return BandMap(GRID, HEIGHTS, nothing, ~nothing, nothing, far, np.zeros((0, 2)))


def test_distances_to_a_mover_are_exact() -> None:
    layer = DynamicLayer(DynamicSettings(margin=0.1))
    layer.take([things(0.0)], 0.0)
    layer.take([things(0.05)], 0.1)
    band = layer.over(flat_band(), 0.1)
    x, y = np.moveaxis(GRID.centres(), -1, 0)
    truth = np.hypot(np.maximum(np.abs(x - 0.05) - 0.1, 0), np.maximum(np.abs(y - 1.0) - 0.1, 0))
    np.testing.assert_allclose(band.distance, np.maximum(truth - 0.1, 0), atol=1e-5)
    assert np.array_equal(band.occupied, band.distance <= 0.025)
    ahead = layer.over(flat_band(), 0.1, ahead=2.0)  # half a metre a second
    truth = np.hypot(np.maximum(np.abs(x - 0.55) - 0.6, 0), np.maximum(np.abs(y - 1.0) - 0.1, 0))
    np.testing.assert_allclose(ahead.distance, np.maximum(truth - 0.1, 0), atol=1e-5)


def test_a_box_of_few_points_is_held_whole() -> None:
    """Turned against the axes, where each corner is the outermost in some way; flying pixels are left out."""
    turn = se3_exp(np.array([0, 0, 0, 0.1, 0.6, 0.2]))
    sighting = things(0.0)
    layer = DynamicLayer()
    layer.take([Sighting(1, turn, sighting.points)], 0.0)
    np.testing.assert_allclose(layer.obstacles_at(0.0)[0].points, transform_points(sighting.points, turn), atol=1e-12)
    cloud = np.concatenate([np.random.default_rng(0).uniform(-0.1, 0.1, (3000, 3)), [[5.0, 0, 0], [0, 0, -7.0]]])
    layer.take([Sighting(2, np.eye(4), cloud)], 0.0)
    (other,) = (o for o in layer.obstacles_at(0.0) if o.number == 2)
    assert np.abs(other.points).max() <= 0.1 and np.ptp(other.points, axis=0).min() > 0.19 and len(other.points) <= 2000


def test_only_heights_that_the_robot_passes_count() -> None:
    layer = DynamicLayer(DynamicSettings(margin=0.0))
    layer.take([things(0.0, low=0.3)], 0.0)  # between 0.7 and 0.9 above the floor
    assert layer.cells_at(0.0, GRID, (0.05, 1.0)).any() and not layer.cells_at(0.0, GRID, (0.05, 0.6)).any()


def test_it_is_forgotten_by_its_own_time_and_followed_through_corrections() -> None:
    layer = DynamicLayer(DynamicSettings(decay_s=0.5))
    for k in range(5):
        layer.take([things(0.1 * k, 1), things(-0.1 * k, 2)], 0.1 * k)
    layer.take([things(0.5, 1)], 0.8)
    assert {o.number for o in layer.obstacles_at(0.8)} == {1, 2}
    assert {o.number for o in layer.obstacles_at(0.95)} == {1}
    layer.take([things(0.6, 1)], 1.0)
    assert len(layer) == 1
    turn = se3_exp(np.array([0.3, 0, 0, 0, np.pi / 2, 0]))
    before = layer.obstacles_at(1.0)[0]
    layer.move(turn)
    after = layer.obstacles_at(1.0)[0]
    np.testing.assert_allclose(after.velocity, turn[:3, :3] @ before.velocity, atol=1e-9)
    np.testing.assert_allclose(after.points, transform_points(before.points, turn), atol=1e-9)
    for time in (0.9, float("nan")):
        with pytest.raises(InputError, match="time"):
            layer.take([], time)


def test_movers_of_a_finished_run_are_taken_in_too() -> None:
    _, _, movers = film()
    layer = DynamicLayer()
    for n in range(LAST):
        layer.take(sightings_in(movers, n, camera_pose(n)), n / RATE)
    (obstacle,) = layer.obstacles_at((LAST - 1) / RATE)
    assert obstacle.number == 7 and np.linalg.norm(obstacle.velocity - VELOCITY) < 0.05


@pytest.mark.parametrize("points", [[[0, 0]], [[0, 0], [1, 0]], [[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]]])
def test_gaps_to_outlines(points: list[list[float]]) -> None:
    outline = convex_outline(np.array(points, float))
    places = np.random.default_rng(0).uniform(-1, 2, (200, 2))
    high = np.array(points).max(0)
    np.testing.assert_allclose(
        outline_gap(outline, places), np.hypot(*np.maximum(np.maximum(-places, places - high), 0).T), atol=1e-6
    )
