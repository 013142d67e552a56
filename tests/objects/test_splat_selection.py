# SPDX-License-Identifier: Apache-2.0
"""Selections of Gaussians on exact cases, and what is no selection."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from ggslam.errors import ConfigError
from ggslam.objects.selection import ScreenShape, parse_selection, read_selection

MEANS = np.array([[0, 0, 1], [0, 0, 3], [1, 0, 2], [-1, 0, 2], [0, 0.5, 2], [0, 0, -1]], np.float32)
OWNERS = np.array([1, 1, 2, 0, 3, 2])
EYE = np.eye(4).ravel().tolist()


def screen(mask: np.ndarray, T: np.ndarray | None = None, **more: Any) -> dict[str, Any]:
    """A screen of 40 x 20 pixels with a focal length of 20, looking along z."""
    flat, runs, value = np.asarray(mask, bool).ravel(), list[int](), False
    while len(flat):
        end = np.flatnonzero(flat != value)
        runs.append(int(end[0]) if len(end) else len(flat))
        flat, value = flat[runs[-1] :], not value
    T_camera_world = EYE if T is None else T.ravel().tolist()
    shape = {"kind": "screen", "T_camera_world": T_camera_world, "width": 40, "height": 20, "focal": 20.0, "near": 0.1}
    return {**shape, "mask": {"width": mask.shape[1], "height": mask.shape[0], "runs": runs}, **more}


def rows(*steps: tuple[str, dict[str, Any]], depth: Any = None) -> list[int]:
    selection = read_selection([{"mode": mode, "shape": shape} for mode, shape in steps])
    return np.flatnonzero(selection.rows(MEANS, OWNERS, depth)).tolist()


def test_shapes() -> None:
    assert rows(("set", {"kind": "all"})) == [0, 1, 2, 3, 4, 5]
    assert rows(("set", {"kind": "objects", "ids": [2, 0]})) == [2, 3, 5]
    ball = {"kind": "sphere", "center": [0, 0, 2], "radius": 1.0}
    assert rows(("set", ball)) == [0, 1, 2, 3, 4]  # its edge belongs to it
    assert rows(("set", {"kind": "sphere", "center": [0, 0, 2], "radius": 0.9})) == [4]
    c = float(np.cos(np.pi / 4))
    box = {"kind": "box", "center": [0, 0, 2], "axes": [[c, 0, c], [0, 1, 0], [-c, 0, c]], "size": [1.5, 2, 1.5]}
    assert rows(("set", box)) == [0, 1, 2, 3, 4]
    assert rows(("set", {**box, "size": [1.3, 2, 1.5]})) == [4]


def test_steps_follow_each_other() -> None:
    objects = {"kind": "objects", "ids": [1]}
    near = {"kind": "sphere", "center": [0, 0, 1], "radius": 0.5}
    assert rows(("add", objects), ("remove", near)) == [1]
    assert rows(("set", objects), ("intersect", near)) == [0]
    assert rows(("set", objects), ("add", {"kind": "objects", "ids": [3]})) == [0, 1, 4]
    assert rows(("set", {"kind": "all"}), ("remove", objects)) == [2, 3, 4, 5]
    assert rows(("set", objects), ("remove", near), ("invert", {"kind": "all"})) == [0, 2, 3, 4, 5]
    assert rows(("set", objects), ("invert", near)) == [1]


def test_a_screen_takes_what_is_drawn_on_and_nothing_behind_the_camera() -> None:
    left = np.zeros((10, 20), bool)
    left[:, :10] = True
    assert rows(("set", screen(np.ones((10, 20), bool)))) == [0, 1, 2, 3, 4]
    assert rows(("set", screen(left))) == [3]  # the middle column belongs to the right half
    assert rows(("set", screen(np.ones((10, 20), bool), near=1.5))) == [1, 2, 3, 4]
    T = np.eye(4)
    T[0, 3] = -1.0  # a camera 1 m to the right
    assert rows(("set", screen(left, T))) == [0, 1, 3, 4]


def test_only_what_is_seen() -> None:
    surface = np.full((10, 20), 1.0, np.float32)
    everything = screen(np.ones((10, 20), bool), seen_only=True)
    assert rows(("set", everything), depth=lambda shape: surface) == [0]
    assert rows(("set", everything), depth=lambda shape: 1.94 * surface) == [0, 2, 3, 4]  # 2 <= 1.05 * 1.94 + 0.03
    assert rows(("set", everything), depth=lambda shape: 0 * surface) == []
    asked = list[ScreenShape]()
    rows(("set", {**everything, "seen_only": False}), depth=asked.append)
    assert not asked


def test_what_is_hidden_is_in_no_shape() -> None:
    ball = {"kind": "sphere", "center": [0, 0, 2], "radius": 1.0}
    assert rows(("set", {**ball, "hidden": [2, 0]})) == [0, 1, 4]
    assert rows(("set", {"kind": "all"}), ("remove", {**ball, "hidden": [3]})) == [4, 5]
    asked = list[ScreenShape]()

    def depth_of(shape: ScreenShape) -> np.ndarray:
        asked.append(shape)
        return np.full((10, 20), 9.0, np.float32)

    everything = screen(np.ones((10, 20), bool), seen_only=True, hidden=[1])
    assert rows(("set", everything), depth=depth_of) == [2, 3, 4]
    assert [shape.hidden for shape in asked] == [{1}]  # so that it covers nothing


def test_whole_objects_are_told_from_gaussians() -> None:
    def of(*steps: dict[str, Any]) -> list[int] | None:
        return read_selection(list(steps)).objects()

    objects = {"kind": "objects", "ids": [3, 1]}
    assert of({"mode": "set", "shape": objects}) == [1, 3] == of({"mode": "add", "shape": objects})
    assert of({"mode": "remove", "shape": objects}) is None is of({"mode": "set", "shape": {"kind": "all"}})


GOOD = screen(np.ones((2, 3), bool))
BAD: tuple[Any, ...] = (
    [], {}, "all", [1], [{"mode": "set"}], [{"mode": "xor", "shape": {"kind": "all"}}],
    *([{"mode": "set", "shape": shape}] for shape in (
        {"kind": "cone"}, {"kind": "objects", "ids": [70000]}, {"kind": "objects", "ids": [True]}, {"kind": "objects"},
        {"kind": "sphere", "center": [0, 0], "radius": 1}, {"kind": "sphere", "center": [0, 0, 0], "radius": 0},
        {"kind": "sphere", "center": [0, 0, float("nan")], "radius": 1},
        {"kind": "sphere", "center": "abc", "radius": 1},
        {"kind": "box", "center": [0, 0, 0], "axes": [[1, 0, 0], [1, 0, 0], [0, 0, 1]], "size": [1, 1, 1]},
        {"kind": "box", "center": [0, 0, 0], "axes": [[1, 0], [1, 0, 0]], "size": [1, 1, 1]},
        {"kind": "box", "center": [0, 0, 0], "axes": np.eye(3).tolist(), "size": [1, 1, -1]},
        {"kind": "all", "hidden": [-1]}, {**GOOD, "hidden": "1"},
        {**GOOD, "focal": -1}, {**GOOD, "width": 0}, {**GOOD, "T_camera_world": [1, 2]}, {**GOOD, "mask": None},
        *({**GOOD, "mask": {"width": 3, "height": 2, "runs": runs}} for runs in ([0, 7], [-1], "x", [1.5])),
        {**GOOD, "mask": {"width": 10**6, "height": 10**6, "runs": []}},
        {"kind": "sphere", "center": [0, 10**400, 0], "radius": 1}, {"kind": "sphere", "center": [0, 0, 0],
                                                                     "radius": 10**400},
    )),
    [{"mode": "add", "shape": {**GOOD, "mask": {"width": 1 << 22, "height": 1, "runs": []}}}] * 65,
)  # fmt: skip


@pytest.mark.parametrize("values", BAD, ids=range(len(BAD)))
def test_what_is_no_selection_is_refused(values: Any) -> None:
    with pytest.raises(ConfigError, match="selection"):
        read_selection(values)
    with pytest.raises(ConfigError, match="selection"):
        parse_selection(json.dumps(values))


def test_text_that_is_no_json() -> None:
    for text in ("", "[", "[" * 100_000):
        with pytest.raises(ConfigError, match="selection: expected"):
            parse_selection(text)
