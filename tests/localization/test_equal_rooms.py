# SPDX-License-Identifier: Apache-2.0
"""Rooms that are all alike: what tells them apart is a rough position alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from worlds.cloud import cloud_tiles
from worlds.scanner import Scanner
from worlds.special import ROOM_PITCH, changed, equal_rooms

from ggslam.localization.level import about_z
from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.near import Near
from ggslam.localization.scan_look_up import ScanLookUp
from ggslam.localization.scan_maps import scan_places
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.surface import NORMAL, SCAN_TARGET, PartialSurface, packed_normals
from ggslam.native.loader import NativeContext
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings

GROUND = SubmapSettings(axes="xy", voxel=0.0, partial_radius=10.0, cache_megabytes=50)
SCANNER = Scanner(columns=450, farthest=6.0)
"""Sees no farther than the next room, so that no outer wall tells where it is."""
WORLD = equal_rooms(42.0, seed=0)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GridStore]:
    points, normals = (np.concatenate(arrays) for arrays in zip(*cloud_tiles(WORLD, 0.15), strict=True))
    with GridStore.create(tmp_path_factory.mktemp("equal") / "map.grid", GROUND) as made:
        store_cloud(made, points, {NORMAL: packed_normals(normals)})
        yield made


def pose(column: int, row: int) -> np.ndarray:
    """In a room, off its middle."""
    T = np.eye(4)
    T[:3, :3] = about_z(0.3)
    T[:3, 3] = [(column + 0.5) * ROOM_PITCH + 0.4, (row + 0.5) * ROOM_PITCH - 0.3, 1.3]
    return T


def look_up(store: GridStore, scan: np.ndarray, near: Near | None) -> Localization:
    context = NativeContext()
    with PartialSurface(store, SCAN_TARGET, context) as surface:
        places = ScanLookUp(lambda: scan_places(store, near), store.settings.axes, near=near)
        return Localizer(surface, ScanTracker(ScanTrackerSettings(), context, None, places), None).locate(scan)


def test_without_a_position_no_room_is_believed(store: GridStore) -> None:
    found = look_up(store, SCANNER.scan(WORLD, pose(3, 3), 1).points, None)
    assert found.status is LocalizationStatus.LOST and "neither is believed" in found.reason


@pytest.mark.parametrize("place", [(3, 3), (2, 4)])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_position_tells_which_of_equal_rooms(store: GridStore, place: tuple[int, int], share: float) -> None:
    T = pose(*place)
    scan = SCANNER.scan(changed(WORLD, share, 1) if share else WORLD, T, 2).points
    found = look_up(store, scan, Near((T[0, 3] + 0.5, T[1, 3] - 0.4), 0.8))
    assert found.status is LocalizationStatus.FOUND, found.reason
    assert np.linalg.norm(found.T_world_sensor[:3, 3] - T[:3, 3]) < 0.02


def test_a_position_where_two_rooms_are_near_does_not(store: GridStore) -> None:
    T = pose(3, 3)
    found = look_up(store, SCANNER.scan(WORLD, T, 3).points, Near((T[0, 3] + 3, T[1, 3]), 3.0))
    assert found.status is LocalizationStatus.LOST and "neither is believed" in found.reason


def test_a_wrong_position_is_told(store: GridStore) -> None:
    T = pose(3, 3)
    found = look_up(store, SCANNER.scan(WORLD, T, 4).points, Near((T[0, 3] + ROOM_PITCH / 2, T[1, 3]), 0.5))
    assert found.status is LocalizationStatus.LOST and "which is not within 1.5 m of (24.4, 20.7)" in found.reason
