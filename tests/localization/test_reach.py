# SPDX-License-Identifier: Apache-2.0
"""The map in memory reaches as far as the sensor sees: far in a hall, near in a room, less where it is dense."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds.cloud import cloud_tiles
from worlds.scanner import Scanner
from worlds.special import hall_world
from worlds.walk import walk

from ggslam.errors import ConfigError
from ggslam.localization.localizer import Localizer
from ggslam.localization.reach import (
    AdaptiveReach,
    AdaptiveReachTuning,
    frame_ranges,
    parse_radius,
    reach_of_ranges,
    scan_ranges,
)
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.surface import NORMAL, SCAN_TARGET, PartialSurface, packed_normals
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.submaps.cell_points import POINTS
from ggslam.submaps.cells_around import CellsAround
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points, store_cloud
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import overridden

GROUND = SubmapSettings(axes="xy", voxel=0.0, partial_radius=5.0, cache_megabytes=50)
CONTEXT = NativeContext()


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, list[np.ndarray]]:
    """A store of a world with a hall in its middle, poses of a walk at 3.6 m/s, and scans from them."""
    world = hall_world(50.0, seed=0)
    poses = walk(world, 80.0, seed=0)[::3]
    scans = [Scanner(columns=450).scan(world, T, seed).points for seed, T in enumerate(poses)]
    path = tmp_path_factory.mktemp("hall") / "map.grid"
    points, normals = (np.concatenate(arrays) for arrays in zip(*cloud_tiles(world, 0.15), strict=True))
    with GridStore.create(path, GROUND) as store:
        store_cloud(store, points, {NORMAL: packed_normals(normals)})
    return path, poses, scans


def errors(
    hall: tuple[Path, np.ndarray, list[np.ndarray]], radius: float, adapts: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each scan: distance from the truth (inf where it was not located), R', and points of the map."""
    path, poses, scans = hall
    away, radii, points = [], [], []
    with GridStore.open(path) as store:
        submaps = replace(GROUND, partial_radius=radius)
        with PartialSurface(store, SCAN_TARGET, CONTEXT, submaps) as surface:
            tracker = ScanTracker(ScanTrackerSettings(), CONTEXT, poses[0])
            reach = AdaptiveReach(surface, scan_ranges) if adapts else None
            localizer = Localizer(surface, tracker, poses[0], reach)
            for scan, T in zip(scans, poses, strict=True):
                found = localizer.locate(scan)
                off = float(np.linalg.norm(found.T_world_sensor[:3, 3] - T[:3, 3]))
                away.append(off if found.status.is_located else np.inf)
                radii.append(surface.map.radius)
                points.append(found.map_points)
    return np.array(away), np.array(radii), np.array(points)


def test_the_map_follows_what_is_seen(hall: tuple[Path, np.ndarray, list[np.ndarray]]) -> None:
    away, radii, _ = errors(hall, 5.0, adapts=True)
    assert away.max() < 0.02
    seen = np.array([reach_of_ranges(scan_ranges(scan)) for scan in hall[2]])
    assert np.ptp(seen) > 8 and np.corrcoef(seen[1:], radii[1:])[0, 1] > 0.8
    assert (radii[1:] >= AdaptiveReachTuning.shrink * seen[1:]).all()
    assert len(np.unique(radii)) < len(radii) / 2  # not at every scan
    fixed, _, _ = errors(hall, 5.0, adapts=False)
    assert np.sqrt((fixed**2).mean()) > 1.2 * np.sqrt((away**2).mean())


def test_a_map_without_a_radius_of_its_own_follows_too(hall: tuple[Path, np.ndarray, list[np.ndarray]]) -> None:
    away, radii, _ = errors(hall, 0.0, adapts=True)
    assert away.max() < 0.02 and (radii > 0).all()


def test_a_dense_map_reaches_less_far(hall: tuple[Path, np.ndarray, list[np.ndarray]]) -> None:
    _, radii, points = errors(hall, 5.0, adapts=True)
    with overridden(AdaptiveReachTuning, max_points=20_000):
        _, less, fewer = errors(hall, 5.0, adapts=True)
    assert points.max() > 60_000 and fewer.max() < 40_000 and less.max() < 0.7 * radii.max()
    assert less.min() >= AdaptiveReachTuning.min_cells * GROUND.spacing


def test_cells_are_looked_up_after_so_many_metres_or_with_another_radius(
    hall: tuple[Path, np.ndarray, list[np.ndarray]],
) -> None:
    still = replace(GROUND, lookahead=0.0)
    with GridStore.open(hall[0]) as store, CellsAround(store, load_points, POINTS, lambda cell: 0, still) as cells:
        cells.set_reach(6.0, 3.0)
        cells.update(np.array([20.0, 20, 1]))
        assert set(cells.cells) == set(store.near(np.array([20.0, 20, 1]), 6.0))
        before = cells.cells
        cells.update(np.array([22.9, 20, 9]))  # in another cell; the height is no axis of the grid
        assert cells.cells is before
        cells.update(np.array([23.1, 20, 1]))
        assert set(cells.cells) == set(store.near(np.array([23.1, 20, 1]), 6.0))
        cells.set_reach(9.0, 3.0)
        cells.update(np.array([23.2, 20, 1]))
        assert set(cells.cells) == set(store.near(np.array([23.2, 20, 1]), 9.0))


def test_ranges_are_metres_along_the_rays() -> None:
    camera = Camera(64, 48, 32.0, 32.0, 32.0, 24.0)
    frame = Frame(0, 0, 0.0, np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 2.0, np.float32), camera)
    found = frame_ranges(frame)
    corner = 2 * np.linalg.norm([-1, -0.75, 1])
    assert found.max() == pytest.approx(corner, rel=1e-5) and found.min() == pytest.approx(2, rel=1e-5)
    assert reach_of_ranges(np.array([0, np.inf, np.nan, 5.0])) == pytest.approx(6.0)
    assert reach_of_ranges(np.zeros(0)) == 0


@pytest.mark.parametrize("text", ["-1", "far", "nan", "1e9", ""])
def test_radii_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"`radius`: expected a number .* or auto, found"):
        parse_radius(text)
    assert parse_radius("auto") == "auto" and parse_radius("12.5") == 12.5 and parse_radius(7) == 7.0
