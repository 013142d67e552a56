# SPDX-License-Identifier: Apache-2.0
"""Tiles: what is in them, and which of them are sent again."""

from __future__ import annotations

import numpy as np
import torch
from serve_tools import KeptOutlet

from ggslam.jobs.serve import channels as c
from ggslam.jobs.serve.map_contents import MapContents, MapCopy
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.things import growing_objects
from ggslam.jobs.serve.tiles import SentTiles, ThinPoints, TileTuning, at_most, thin_points, tile_of
from ggslam.rendering.types import GaussianTensors

RNG = np.random.default_rng(0)
MEANS = RNG.uniform([-5, -1, 0], [5, 1, 6], (20_000, 3)).astype(np.float32)
COLORS = RNG.integers(60, 200, (20_000, 3), dtype=np.uint8)
IDS = np.zeros(20_000, np.uint16)


def thin(means: np.ndarray, colors: np.ndarray = COLORS) -> ThinPoints:
    return thin_points(means, colors, IDS[: len(means)])


def test_one_point_for_each_cell() -> None:
    found = thin(MEANS)
    cells = np.floor(MEANS / np.float32(TileTuning.point_m)).astype(int)
    assert len(found) == len(np.unique(cells, axis=0)) and found.count.sum() == len(MEANS)
    assert (np.diff(found.codes) > 0).all()
    one = np.flatnonzero((cells == np.floor(found.xyz[7] / TileTuning.point_m)).all(axis=1))
    np.testing.assert_allclose(MEANS[one].mean(axis=0), found.xyz[7], atol=1e-5)
    assert TileTuning.edge_m == TileTuning.points_in_tile * TileTuning.point_m
    assert len(at_most(MEANS, COLORS, IDS, 500)) <= 500
    assert len(thin_points(MEANS[:0], COLORS[:0], IDS[:0])) == 0
    bad = MEANS.copy()
    bad[0], bad[1] = np.nan, 1e9
    assert thin(bad).count.sum() == len(MEANS) - 2


def test_only_what_changed_is_sent() -> None:
    sent = SentTiles()
    first = sent.find_changes(thin(MEANS))
    assert sum(len(rows) for rows in first.values()) == len(thin(MEANS))
    assert sent.find_changes(thin(MEANS)) == {}
    moved = MEANS.copy()
    inside = (tile_of(MEANS) == [1, 0, 1]).all(axis=1)
    moved[inside] += np.float32(0.07)
    changed = sent.find_changes(thin(moved))
    assert (1, 0, 1) in changed and len(changed) <= 8  # and neighbours that got some of its points
    gone = moved[~(tile_of(moved) == [-2, 0, 0]).all(axis=1)]
    left = thin_points(gone, COLORS[: len(gone)], IDS[: len(gone)])
    assert (-2, 0, 0) not in sent.find_changes(left, whole=False)  # it may be on disk
    changed = sent.find_changes(left)
    assert len(changed[-2, 0, 0]) == 0


def test_noise_is_no_change_unless_it_is_the_end() -> None:
    sent = SentTiles()
    sent.find_changes(thin(MEANS))
    brighter = COLORS + np.uint8(3)
    assert sent.find_changes(thin(MEANS, brighter)) == {}
    assert len(sent.find_changes(thin(MEANS, brighter), exactly=True)) == len(np.unique(tile_of(MEANS), axis=0))
    assert len(sent.find_changes(thin(MEANS, brighter + np.uint8(20)))) == len(np.unique(tile_of(MEANS), axis=0))


def gaussians(means: np.ndarray) -> GaussianTensors:
    count = len(means)
    turns = torch.zeros(count, 4)
    turns[:, 0] = 2
    return GaussianTensors(
        torch.from_numpy(means), turns, torch.full((count, 3), -4.0), torch.full((count,), 3.0),
        torch.zeros(count, 4, 3), torch.zeros(count, 0),
    )  # fmt: skip


def test_contents_of_tiles() -> None:
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, True)], (c.POINTS, c.POINT_TILES, c.SPLATS, c.SPLAT_TILES))
    contents = MapContents(publisher)
    contents.show(MapCopy(gaussians(MEANS), IDS), 1.0)
    publisher.wait_idle(5.0)
    tiles, splats = outlet.of(c.POINT_TILES.name), outlet.of(c.SPLAT_TILES.name)
    assert sum(len(splat.means) for splat in splats) == len(MEANS)
    assert len(tiles) == len(splats) == len(np.unique(tile_of(MEANS), axis=0))
    np.testing.assert_allclose(splats[0].quaternions, [[1, 0, 0, 0]] * len(splats[0].means))
    assert splats[0].sh.shape[1] == 1
    left = MEANS[~(tile_of(MEANS) == [-2, 0, 0]).all(axis=1)]
    contents.show(MapCopy(gaussians(left), IDS[: len(left)]), 2.0)
    publisher.wait_idle(5.0)
    new_points, new_splats = outlet.of(c.POINT_TILES.name)[len(tiles) :], outlet.of(c.SPLAT_TILES.name)[len(splats) :]
    assert len(new_points) == len(new_splats) == 1
    assert new_points[0].values["count"].tolist() == [0] and new_splats[0].opacities.tolist() == [0]
    assert tile_of(new_points[0].xyz).tolist() == tile_of(new_splats[0].means).tolist() == [[-2, 0, 0]]
    assert len(publisher.newest(c.POINT_TILES)) == len(tiles) - 1
    assert len(outlet.of(c.POINTS.name)) == 1  # the whole map rests longer
    publisher.close()


def test_a_map_without_surfaces_has_no_objects() -> None:
    nothing = growing_objects(np.zeros((0, 3), np.float32), np.zeros(0, np.uint16))
    assert nothing.things == () and growing_objects(MEANS, IDS).things == ()
