# SPDX-License-Identifier: Apache-2.0
"""When the turn of a thing that moved is known."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_visits import Box, SmallVisit, detect

from ggslam.changes import rotation_ambiguity
from ggslam.changes.alignment_score import Fit
from ggslam.changes.rotation_ambiguity import hidden_sector, with_rotation_ambiguity
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.shape import Shape
from ggslam.scene.poses import inverse, rotation_about, transform_points, turning_angle

UP = np.array([0.0, 0.0, 1.0])


def thing(colors: np.ndarray) -> Shape:
    """Points in a row, of colours [n, 3]."""
    points = np.stack([np.linspace(0, 0.2, len(colors)), np.zeros(len(colors)), np.zeros(len(colors))], 1)
    return Shape(points, colors.astype(np.float32), np.tile(UP, (len(colors), 1)))


THING = thing(np.full((60, 3), 0.5))
COLORFUL = thing(np.random.default_rng(0).random((60, 3)))


def directions(*degrees: float) -> np.ndarray:
    """To cameras at these azimuths, 30 degrees up, and one straight above."""
    turn = np.radians(degrees)
    sides = np.stack([0.87 * np.cos(turn), 0.87 * np.sin(turn), np.full(len(turn), 0.5)], 1)
    return np.concatenate([np.repeat(sides, 10, 0), UP[None]])


def patched(*rows: int) -> Shape:
    """A white thing with dark patches."""
    colors = np.full((60, 3), 0.85)
    colors[list(rows)] = 0.1
    return thing(colors)


@pytest.mark.parametrize("azimuths, hidden", [
    (range(0, 360, 15), 0), ((5, 15, 35, 45), 300), ((5, 95, 185, 275), 60), ((5, 185), 150), ((), 360),
])  # fmt: skip
def test_sides_that_a_thing_was_not_seen_from(azimuths: tuple[float, ...], hidden: float) -> None:
    assert hidden_sector(directions(*azimuths), UP) == hidden


@pytest.mark.parametrize("shape, hidden, tilts, color_apart, share, known", [
    (THING, (60, 60), False, 0.0, 1.0, True),
    (THING, (120, 120), False, 0.0, 1.0, True),
    (THING, (150, 150), False, 0.0, 1.0, False),  # either may have seen another side
    (COLORFUL, (240, 240), False, 0.02, 1.0, True),  # of which the colours tell that it is one
    (COLORFUL, (240, 240), False, 0.2, 1.0, False),
    (patched(*range(12)), (240, 240), False, 0.0, 1.0, False),  # a patch elsewhere leaves as little
    (THING, (360, 0), False, 0.0, 1.0, False),  # seen from above alone
    (COLORFUL, (240, 240), False, 0.02, 0.85, False),
    (COLORFUL, (240, 240), True, 0.02, 1.0, False),  # few things fall over
    (COLORFUL, (60, 60), True, 0.02, 1.0, True),
])  # fmt: skip
def test_visits_that_saw_different_sides_do_not_tell_a_turn(
    shape: Shape, hidden: tuple[float, float], tilts: bool, color_apart: float, share: float, known: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Where no other turn fits as well, and the thing may stand there turned otherwise."""
    monkeypatch.setattr(rotation_ambiguity, "_others", lambda *args: iter(()))
    T = np.eye(4)
    if tilts:
        T[:3, :3] = rotation_about(np.array([1.0, 0, 0]), 90)
    judge: Any = SimpleNamespace(settings=ChangeSettings(), clashes=lambda motions: np.zeros(len(motions)))
    found = with_rotation_ambiguity(Fit(T, share, 1.0, color_apart), shape, shape, judge, hidden, UP)
    assert found.turn_known == known
    assert known or "different sides" in str(found.turn_reason)


def test_what_fell_over_is_also_tried_rolled_and_upright(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bottle on its side looks alike, however it was rolled."""
    lying = np.eye(4)
    lying[:3, :3] = rotation_about(np.array([1.0, 0, 0]), 90)
    rolled = lying[:3, :3] @ rotation_about(UP, 60)
    tried: list[np.ndarray] = []

    def fit(T: np.ndarray) -> Fit:
        tried.append(T)
        return Fit(T, 0.9 if np.allclose(T[:3, :3], rolled, atol=1e-6) else 0.0, 1.0, 0.0)

    target = SimpleNamespace(refine=lambda sample, T, reach, free: T)
    monkeypatch.setattr(rotation_ambiguity, "Target", lambda *args, **kwargs: target)
    judge: Any = SimpleNamespace(fit=fit, settings=ChangeSettings())
    found = with_rotation_ambiguity(Fit(lying, 0.9, 1.0, 0.0), THING, THING, judge, (0, 0), UP)
    assert found.as_good_deg == 60
    assert any(np.allclose(T[:3, :3], np.eye(3)) for T in tried)


@pytest.mark.parametrize("free_m, known", [(0.02, True), (0.12, False)])
def test_a_shape_of_which_visits_saw_parts_tells_a_turn_if_others_find_no_room(
    free_m: float, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its middle may be so far aside if it is turned by 90 degrees more; everywhere else the visits saw through."""
    monkeypatch.setattr(rotation_ambiguity, "_others", lambda *args: iter(()))

    def clashes(motions: list[np.ndarray]) -> np.ndarray:
        place = np.array([*THING.points.mean(0), 1.0])
        aside = np.array([np.linalg.norm((T @ place)[:3] - place[:3]) for T in motions])
        turned = np.degrees([turning_angle(T, np.eye(4)) for T in motions])
        fits = (turned < 1) | ((abs(turned - 90) < 1) & (aside > 0.04) & (aside < free_m))
        return np.where(fits, 0.01, 0.2)

    judge: Any = SimpleNamespace(settings=ChangeSettings(), clashes=clashes)
    found = with_rotation_ambiguity(Fit(np.eye(4), 1.0, 1.0, 0.0), THING, THING, judge, (240, 240), UP)
    assert found.turn_known == known


@pytest.mark.long("shapes are compared from starts all around")
def test_a_plain_box_of_which_visits_saw_opposite_sides_tells_no_turn() -> None:
    """Its faces fit perfectly if it was turned by 180 degrees."""
    marks = [Box(8, (0.4, 0.4), (0.1, 0.1, 0.14), hue=1.0), Box(9, (-0.4, -0.4), (0.14, 0.1, 0.1), hue=2.0)]
    before, after = (Box(2, at, (0.2, 0.12, 0.15), plain=True) for at in ((-0.2, 0.0), (0.1, 0.1)))
    old = SmallVisit([before, *marks], around=(-40, -20, 0, 20, 40))
    new = SmallVisit([after, *marks], around=(140, 160, 180, 200, 220))
    found, _ = detect(old, new, True)
    moved = [change for change in found.changes if change.kind == "moved"]
    assert [change.fit is not None and change.fit.turn_known for change in moved] == [False]


@pytest.mark.parametrize("share, other_share, told", [
    (0.95, 0.75, None),  # a good fit, and the other turn's is not
    (0.95, 0.92, 97.0),
    (0.5, 0.4, 97.0),  # of a bad fit the other turn is about as bad
    (0.5, 0.2, None),
])  # fmt: skip
def test_another_turn_between_the_probed_ones_that_fits_about_as_well(
    share: float, other_share: float, told: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing fits but where the thing is, and turned by 97 degrees more, which is between the turns that are tried."""
    other = np.eye(4)
    other[:3, :3] = rotation_about(UP, 97)

    def refine(sample: Shape, T: np.ndarray, fit_m: float, free: np.ndarray) -> np.ndarray:
        turns = free[3:].any()
        return other if turns and turning_angle(T, other) < np.radians(10) else T

    def fit(T: np.ndarray) -> Fit:
        fits = share if np.allclose(T, np.eye(4)) else other_share if np.allclose(T, other) else 0.0
        return Fit(T, share=fits, seen=1.0, color_apart=0.0)

    monkeypatch.setattr(rotation_ambiguity, "Target", lambda *args, **kwargs: SimpleNamespace(refine=refine))
    judge: Any = SimpleNamespace(fit=fit, settings=ChangeSettings())
    found = with_rotation_ambiguity(fit(np.eye(4)), THING, THING, judge, (60, 60), UP)
    assert found.as_good_deg == told and found.turn_known == (told is None)


@dataclass(frozen=True)
class PatchedBox(Box):
    """White, with a dark patch low on its front and one high on its back, neither where the other one is."""

    def surface(self, spacing: float = 0.008) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        points, normals, colors, ids = super().surface(spacing)
        local, deep = transform_points(points, inverse(self.pose())), self.size[1] / 2 - 1e-4
        colors = np.full_like(colors, 0.85)
        colors[(local[:, 1] < -deep) & (local[:, 0] < -0.01) & (local[:, 2] < 0)] = 0.1
        colors[(local[:, 1] > deep) & (local[:, 0] < -0.01) & (local[:, 2] > 0)] = 0.1
        return points, normals, colors, ids


@pytest.mark.long("shapes are compared from starts all around")
def test_a_plain_thing_with_a_patch_that_was_seen_from_opposite_sides_tells_no_turn() -> None:
    """Its front is laid upon its back; that is known only if it could not stand there turned otherwise."""
    old, new = PatchedBox(2, (-0.2, 0.0), (0.2, 0.1, 0.16)), PatchedBox(2, (0.2, 0.1), (0.2, 0.1, 0.16), turn=10)
    visits = SmallVisit([old], around=(230, 250, 270, 290, 310)), SmallVisit([new], around=(50, 70, 90, 110, 130))
    found, _ = detect(*visits, True)
    [change] = found.changes
    assert change.T_new_old is not None and change.fit is not None
    off = np.degrees(turning_angle(change.T_new_old, new.pose() @ inverse(old.pose())))
    assert off < 5 or not change.fit.turn_known
