# SPDX-License-Identifier: Apache-2.0
"""Distances of a map that is partly on disk, against those of everything in memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from distance_scenes import block_range, plane, sphere, union, write_scene
from paged_corridor import SETTINGS, fuse, views

from ggslam.errors import InputError
from ggslam.scene.poses import se3_exp
from ggslam.volumes.cell_rebuild import StoredView
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.held_distances import HeldValues, distance_to_cells
from ggslam.volumes.maps import Paging, VolumeMaps
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_cells import VolumeCells
from ggslam.volumes.volume_settings import VolumeSettings

WITH_EACH = replace(SETTINGS, esdf_every=1)
ROUNDING = SETTINGS.tsdf.voxel / 8 + 1e-6
"""Metres: each field holds its own surface points, within 1/16 voxel of the map's."""


@pytest.fixture(scope="module")
def seen() -> list[PosedView]:
    return views()


def centres(field: DistanceField) -> np.ndarray:
    """Of all voxels of the field's blocks, metres."""
    k, j, i = np.unravel_index(np.arange(512), (8, 8, 8))
    return ((8 * field.coordinates()[:, None] + np.stack([i, j, k], -1) + 0.5) * field.voxel).reshape(-1, 3)


def in_view(maps: VolumeMaps, view: PosedView) -> np.ndarray:
    """Known voxels in the cells that a view may tell of, [N, 3]."""
    assert maps.field is not None and maps.pager is not None
    cells = maps.pager.cells
    wanted = set(map(tuple, cells.in_view(view, np.zeros(3)).tolist()))
    at = centres(maps.field)
    keys = map(tuple, np.floor(at / cells.edge).astype(int).tolist())
    return at[[key in wanted for key in keys]]


@dataclass
class Compared:
    """Of known points: how far distances are from those of the whole map, metres, and what was said of them."""

    off: np.ndarray
    over: np.ndarray
    exact: np.ndarray


def compare(paged: VolumeMaps, whole: VolumeMaps, points: np.ndarray) -> Compared:
    found = paged.query(points)
    assert whole.field is not None and isinstance(found, HeldValues)
    truth = whole.field.query(points)
    known = found.known
    assert not (known & ~truth.known).any()
    assert np.isnan(found.at_least[~known]).all() and not found.exact[~known].any()
    away = known & (np.abs(truth.distance) > ROUNDING)
    assert (np.signbit(found.distance) == np.signbit(truth.distance))[away].all()
    over = np.abs(found.at_least) - np.abs(truth.distance)
    return Compared(np.abs(found.distance - truth.distance)[known], over[known], found.exact[known])


def assert_what_is_said(found: Compared) -> None:
    assert found.off[found.exact].max(initial=0) <= ROUNDING
    assert found.over.max(initial=0) <= ROUNDING


def test_all_that_is_held_is_right_or_said_not_to_be(seen: list[PosedView], tmp_path: Path) -> None:
    """After every eighth view, in every voxel of the field, on the way there and back."""
    paged, whole = VolumeMaps(WITH_EACH, esdf=True), VolumeMaps(WITH_EACH, esdf=True)
    paged.paging = Paging(tmp_path / "cells", lambda held: 4_000_000)
    not_exact, wrong, most_off, compared = 0, 0, 0.0, 0
    for number, view in enumerate(seen):
        paged.add_together([view]), whole.add_together([view])
        assert paged.field is not None and paged.pager is not None
        if number % 8:
            continue
        paged.field.update()  # follows what the end of the instant took to disk
        found = compare(paged, whole, centres(paged.field))
        assert_what_is_said(found)
        assert_what_is_said(around := compare(paged, whole, in_view(paged, view)))
        assert around.exact.all() and len(around.exact) > 10_000
        assert len(paged.field) == len(paged.tsdf)  # its blocks go with the cells
        compared += len(found.off)
        not_exact += int((~found.exact).sum())
        wrong += int((found.off > 0.05).sum())
        most_off = max(most_off, float(found.off.max()))
    assert paged.pager is not None and paged.pager.written > 20 and paged.pager.read > 10
    assert wrong > 50 and most_off > 0.1, "nothing to be marked: the test does not tell anything"
    assert not_exact < 0.25 * compared  # most of what is held is known to be right


def test_after_a_correction_distances_around_the_camera_are_those_of_the_moved_keyframes(
    seen: list[PosedView], tmp_path: Path
) -> None:
    """The way there was thought to bend. After the correction the camera turns back: cells come from the keyframes."""
    there = seen[:27]
    drifted = [
        replace(view, T_world_camera=se3_exp(np.array([0, 0.01 * k, 0, 0, 0, 0.003 * k])) @ view.T_world_camera)
        for k, view in enumerate(there)
    ]
    stored = [StoredView(v.camera, v.T_world_camera, float(v.depth.max()), lambda v=v: v) for v in there]
    paged = fuse(drifted, Paging(tmp_path / "cells", lambda held: 4_000_000), WITH_EACH, esdf=True)
    whole = fuse(there, None, WITH_EACH, esdf=True)
    before = in_view(paged, drifted[-1])
    assert whole.field is not None and paged.field is not None
    off = np.abs(paged.query(before).distance - whole.field.query(before).distance)
    assert np.nanpercentile(off, 95) > 0.1  # metres: what it is about
    paged.rebuild(stored)
    for view in seen[27:31]:
        paged.add_together([view]), whole.add_together([view])
        around = compare(paged, whole, in_view(paged, view))
        assert_what_is_said(around)
        assert around.exact.all() and len(around.exact) > 10_000
        everywhere = compare(paged, whole, centres(paged.field))
        assert_what_is_said(everywhere)
        assert not everywhere.exact.all()  # beside cells that wait to be fused again


def test_without_a_pager_all_that_is_known_is_exact(seen: list[PosedView]) -> None:
    maps = fuse(seen[:4], None, WITH_EACH, esdf=True)
    assert maps.field is not None
    points = centres(maps.field)
    found = maps.query(points)
    assert np.array_equal(found.exact, found.known) and found.known.any() and not found.known.all()
    assert np.array_equal(found.at_least, found.distance, equal_nan=True)
    with pytest.raises(InputError, match=r"\[N, 3\]"):
        maps.query(np.zeros((3, 2)))
    with pytest.raises(InputError, match="esdf"):
        fuse(seen[:1]).query(points)


def test_what_an_update_had_no_time_for_is_not_exact() -> None:
    """A ball comes before the wall; blocks that wait keep the wall's distances, which are too long, and their
    neighbours are interpolated from them."""
    tsdf, blocks = TsdfMap(TsdfSettings(voxel=0.05)), block_range((-2, -2, -1.2), (2, 2, 1.2), 0.05)
    floor = plane((0, 0, -1), (0, 0, 1))
    write_scene(tsdf, floor, blocks)
    maps = VolumeMaps(VolumeSettings(), esdf=True, onto=tsdf)
    assert maps.field is not None
    maps.field.update()
    points = np.random.default_rng(2).uniform((-1.9, -1.9, -1.1), (1.9, 1.9, 1.1), (20_000, 3))
    before = maps.query(points)
    assert np.array_equal(before.exact, before.known) and not before.stale.any()
    write_scene(tsdf, union(floor, sphere((0, 0, 0), 0.4)), blocks)
    stats = maps.field.update(budget_ms=1e-3, near=np.array([2.0, 2, 0]))
    found = maps.query(points)
    maps.field.update()
    off = np.abs(found.distance - maps.query(points).distance)
    assert stats.stale_blocks and found.stale.any() and not found.stale.all() and found.known[found.stale].all()
    assert np.array_equal(found.exact, found.known & ~found.stale)
    assert off[found.stale].max() > 0.3 and off[found.exact].max() <= ROUNDING
    assert (
        np.isnan(found.at_least[found.stale]).all()
        and (found.at_least[found.exact] == found.distance[found.exact]).all()
    )


def test_distances_from_cells_are_those_of_their_boxes() -> None:
    cells = VolumeCells(2, 0.5, 4.0, 0.3)
    rows = (0.5, 0.5, 0.5), (1.9, 0.2, 0.2), (4.5, 1.5, 0.5), (-2.0, -2.0, 0.5), (np.nan, 0, 0), (90, 0, 0)
    points = np.array(rows)
    present = {(3, 0, 0), (-4, -4, 0)}
    found = distance_to_cells(points, cells, 2.6, lambda keys: keys & present)
    assert np.allclose(found, [2.5, 1.1, np.hypot(0.5, 0.5), np.sqrt(2), np.inf, np.inf])
    assert np.isinf(distance_to_cells(points, cells, 2.6, lambda keys: set())).all()
