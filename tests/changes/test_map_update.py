# SPDX-License-Identifier: Apache-2.0
"""Of two visits' maps what shows the latest state is told apart, and moved things lie where they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial import cKDTree
from small_visits import Box, SmallVisit, detect

from ggslam.changes.map_update import NEW, OLD, MapUpdate
from ggslam.changes.settings import ChangeSettings
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, transform_points

CUP, CRATE, BRICK, PLATE = (
    Box(2, (-0.2, 0.1)), Box(3, (0.25, -0.15), (0.12, 0.12, 0.2), 20, 2.0), Box(4, (0.1, 0.3), hue=4.0),
    Box(5, (-0.35, -0.2), (0.1, 0.1, 0.15), hue=1.0),
)  # fmt: skip
MOVED = Box(2, (-0.05, -0.3), turn=50)


@dataclass
class Pair:
    """The maps of two visits, and what tells which of their Gaussians hold."""

    map_update: MapUpdate
    old: GaussianMap
    new: GaussianMap

    def ids(self, number: int) -> np.ndarray:
        return (self.old, self.new)[number].object_id.numpy()


def pair_of(old: SmallVisit, new: SmallVisit) -> Pair:
    found, detector = detect(old, new)
    maps = [visit.gaussians for visit in detector.visits]
    return Pair(MapUpdate(detector, found, ChangeSettings()), maps[0], maps[1])


@pytest.fixture(scope="module")
def pair() -> Pair:
    """A cup was moved, a crate taken away, a plate put there; the newer visit looks from one side only."""
    return pair_of(SmallVisit([CUP, CRATE, BRICK]), SmallVisit([MOVED, BRICK, PLATE], around=(150, 190, 230, 270)))


@pytest.mark.long("visits to a small scene are rendered and compared")
def test_what_went_is_gone_and_what_stayed_is_not(pair: Pair) -> None:
    before, ids = pair.old.means.numpy().astype(float), pair.ids(OLD).copy()
    came = pair.map_update.came(pair.new)
    fate = pair.map_update.renew(pair.old)
    assert fate.gone[ids == CRATE.id].all() and not fate.gone[ids == BRICK.id].any()
    assert fate.gone[ids == 1].mean() < 0.01  # the floor
    assert came[np.isin(pair.ids(NEW), (MOVED.id, PLATE.id))].all() and not came[pair.ids(NEW) == BRICK.id].any()
    # the cup's Gaussians were moved to where it is; those of the side that is seen anew go
    cup, true = ids == CUP.id, MOVED.pose() @ inverse(CUP.pose())
    off = pair.old.means.numpy()[cup] - transform_points(before[cup], true)
    assert np.linalg.norm(off, axis=1).max() < 0.015
    assert np.array_equal(fate.moved[cup], ~fate.gone[cup]) and not fate.moved[~cup].any()
    assert 0.05 < fate.moved[cup].mean() < 0.7
    unseen = transform_points(pair.old.means.numpy()[cup].astype(float), inverse(MOVED.pose()))[fate.moved[cup]]
    away = (MOVED.pose()[:3, :3] @ unseen.T).T  # seen from its middle in the world's axes
    assert away @ np.array([np.cos(np.radians(30)), np.sin(np.radians(30)), 0]) @ np.ones(len(away)) > 0


def test_measured_points_of_what_went_count_nothing_and_of_what_came_most(pair: Pair) -> None:
    def weights(number: int, box: Box) -> np.ndarray:
        return pair.map_update.weights(number, box.surface(0.02)[0])

    assert weights(OLD, CRATE).mean() < 0.1 and weights(OLD, BRICK).min() == 1
    favour = ChangeSettings().favour
    assert np.median(weights(NEW, PLATE)) > 1e5 and np.median(weights(NEW, BRICK)) == favour
    middle = SmallVisit([])
    assert pair.map_update.holds(np.zeros((0, 3))).shape == (0,) and middle.boxes == []


def test_views_that_hold_what_changed_are_known(pair: Pair) -> None:
    visit = SmallVisit([BRICK], target=(0.1, 0.5, 0.0), distance=0.15, around=(80, 100)).build()
    assert pair.map_update.shows_changes(visit.cameras, visit.T_world_camera, 20).tolist() == [False, False]
    everything = SmallVisit([]).build()
    assert pair.map_update.shows_changes(everything.cameras, everything.T_world_camera, 20).all()


def test_what_the_newer_visit_did_not_see_stays_as_it_was() -> None:
    """It looks at a corner only: of what is elsewhere it says nothing."""
    corner = SmallVisit([], target=(-0.55, 0.55, 0.0), distance=0.2, around=(100, 135, 170))
    pair = pair_of(SmallVisit([CUP, CRATE, BRICK]), corner)
    before = pair.old.means.clone()
    fate = pair.map_update.renew(pair.old)
    assert pair.map_update.found.changes == []
    assert not fate.gone.any() and not fate.moved.any() and bool((pair.old.means == before).all())


def test_an_object_of_another_look_is_taken_from_the_newer_visit() -> None:
    painted = Box(2, CUP.at, hue=3.0)
    pair = pair_of(SmallVisit([CUP, CRATE]), SmallVisit([painted, CRATE]))
    assert [change.kind for change in pair.map_update.found.changes] == ["look"]
    fate = pair.map_update.renew(pair.old)
    ids = pair.ids(OLD)
    tree = cKDTree(pair.new.means.numpy()[pair.map_update.came(pair.new)])
    assert fate.gone[ids == CUP.id].mean() > 0.9 and not fate.gone[ids == CRATE.id].any()
    assert tree.query(pair.old.means.numpy()[fate.gone])[0].max() < 0.01


@pytest.mark.long("visits to a small scene are rendered and compared")
def test_what_was_brought_to_another_things_old_place_is_not_that_things() -> None:
    """Told by surfaces: a thing in two pieces went, and one that moved stands a centimetre beside where it stood."""
    cut = Box(3, (0.2, -0.1), (0.1, 0.14, 0.16), 20, 2.0, cut=4)
    moved = Box(2, (0.055, -0.1), turn=20)
    old, new = SmallVisit([Box(2, (-0.3, 0.1)), cut]), SmallVisit([moved], around=(100, 150, 190, 230, 270))
    found, detector = detect(old, new, False)
    assert [change.kind for change in found.changes] == ["moved", "removed"]
    gaussians = detector.visits[OLD].gaussians
    ids = gaussians.object_id.numpy().copy()
    fate = MapUpdate(detector, found, ChangeSettings()).renew(gaussians)
    assert fate.moved[ids == 2].any() and not (fate.moved & fate.gone).any()
    assert fate.gone[np.isin(ids, (3, 4))].all()
