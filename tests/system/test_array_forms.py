# SPDX-License-Identifier: Apache-2.0
"""What attributes are declared to hold is what is let into them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.system.array_forms import Form, MaybeNan, ObjectId, Points32, Pose, PoseForm, check_arrays, check_indices
from ggslam.system.typed_values import Example, problem

TURNED = np.array([[0.0, -1, 0, 5], [1, 0, 0, -3], [0, 0, 1, 2], [0, 0, 0, 1]])
MIRRORED = np.diag([1.0, 1, -1, 1])
ROWS = Annotated[np.ndarray, Form("int", None, below=4)]


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (int, [0, -5, np.int32(7), 2**53], [1.0, True, "1", None, 2**53 + 1, 10**30]),
        (float, [0, 0.5, np.float32(2), 1e30], [float("nan"), float("inf"), 1e31, True, "1", None, 10**40]),
        (MaybeNan, [float("nan"), float("-inf"), 1], ["nan", None, True]),
        (bool, [True, np.bool_(False)], [0, 1, None]),
        (str, ["", "x"], [1, None, b"x"]),
        (ObjectId, [0, 65535], [-1, 65536, 1.5]),
        (int | None, [None, 3], ["", 1.5]),
        (Literal["a", "b"], ["a"], ["c", 1]),
        (list[int], [[], [1]], [(1,), ["a"], None, {1}]),
        (dict[ObjectId, list[float]], [{}, {1: [0.5]}], [{-1: []}, {1: 0.5}, {1: ["a"]}, []]),
        (tuple[int, ...], [(), (1, 2)], [[1], (1.5,)]),
        (tuple[int | None, int], [(None, 1)], [(1,), (1, None), (1, 2, 3)]),
        (frozenset[int], [frozenset({1})], [{1}, frozenset({"a"})]),
        (Pose, [np.eye(4), TURNED], [np.eye(3), np.eye(4, dtype=np.float32), 2 * np.eye(4), MIRRORED, TURNED + 1e7,
                                     np.full((4, 4), np.nan), np.zeros((4, 4)), TURNED.T, None]),
        (Points32, [np.zeros((0, 3), np.float32)], [np.zeros((3, 3)), np.full((1, 3), np.inf, np.float32)]),
        (ROWS, [np.array([0, 3], np.uint8)], [np.array([-1]), np.array([4]), np.zeros(2)]),
    ],
)  # fmt: skip
def test_values_of_other_types_are_told(hint: Any, good: list[Any], bad: list[Any]) -> None:
    assert [problem(value, hint, {}) for value in good] == [None] * len(good)
    assert all(problem(value, hint, {}) for value in bad), [v for v in bad if not problem(v, hint, {})]


def test_lengths_of_one_name_agree_within_an_object() -> None:
    lengths: dict[str, int] = {}
    assert problem(np.zeros((5, 3), np.float32), Points32, lengths) is None
    assert "with 5 for n" in str(problem(np.zeros((4, 3), np.float32), Points32, lengths))


def test_what_stood_there_before_is_an_example() -> None:
    for before, good, bad in [
        (0, 7, 7.5), (0.5, 1, "1"), (True, False, 1), (float("nan"), float("inf"), None), ([], [1], {}),
        (np.zeros((0, 3)), np.zeros((9, 3)), np.zeros((9, 4))), (np.zeros(3), np.zeros(9), np.zeros(3, np.float32)),
    ]:  # fmt: skip
        example = Example.of(before)
        assert example is not None
        assert example.problem(good) is None and example.problem(bad)
    assert Example.of(None) is None


def test_arrays_and_indices_out_of_files() -> None:
    forms = {"poses": PoseForm("float", "n"), "counts": Form("int", "n", below=100)}
    good = {"poses": np.tile(np.eye(4, dtype=np.float32), (2, 1, 1)), "counts": np.array([1, 2])}
    check_arrays(good, forms, "places")
    for name, value, message in [
        ("counts", np.array([1]), "'counts': expected int .* with 2 for n"), ("counts", np.array([1, 100]), "0 to 99"),
        ("poses", 3 * good["poses"], "rotation"), ("poses", good["poses"][0], "'poses': expected float"),
    ]:  # fmt: skip
        with pytest.raises(FormatError, match=f"places: .*{message}|places: '.*' {message}|{message}"):
            check_arrays({**good, name: value}, forms, "places")
    with pytest.raises(FormatError, match="places: .*'counts'"):
        check_arrays({"poses": good["poses"]}, forms, "places")
    check_indices("rows", [0, 4], 5)
    for number in (-1, 5):
        with pytest.raises(FormatError, match=f"rows: .*0 .*5.* {number}"):
            check_indices("rows", [0, number], 5)
