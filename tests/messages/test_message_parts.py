# SPDX-License-Identifier: Apache-2.0
"""Stamps, poses as numbers, numbers of markers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ggslam.messages.contents import Thing
from ggslam.messages.marker_ids import MarkerIds
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.protobuf_rows import length
from ggslam.messages.sound_content import plain_text
from ggslam.messages.stamps import seconds_and_nanoseconds, whole_nanoseconds
from ggslam.messages.thing_looks import ThingTuning, label_place
from ggslam.scene.poses import quaternion_to_matrix


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        (0.0, (0, 0)),
        (1.25, (1, 250_000_000)),
        (1.9999999999, (2, 0)),
        (math.nextafter(1.0, 0), (1, 0)),
        (1_700_000_000.5, (1_700_000_000, 500_000_000)),
        (-3.0, (0, 0)),
        (math.nan, (0, 0)),
        (math.inf, (2**31 - 1, 0)),
        (-math.inf, (0, 0)),
    ],
)
def test_stamps(stamp: float, expected: tuple[int, int]) -> None:
    assert seconds_and_nanoseconds(stamp) == expected


def test_stamps_are_the_nearest_nanosecond() -> None:
    from fractions import Fraction

    rng = np.random.default_rng(0)
    for stamp in np.concatenate([rng.uniform(0, 100, 500), rng.uniform(1.6e9, 1.9e9, 500)]):
        assert abs(Fraction(whole_nanoseconds(float(stamp))) - Fraction(float(stamp)) * 10**9) <= Fraction(1, 2)


def test_quaternions_are_in_the_order_of_messages_and_of_one_sign() -> None:
    rng = np.random.default_rng(1)
    wxyz = rng.normal(size=(200, 4))
    T = np.tile(np.eye(4), (200, 1, 1))
    T[:, :3, :3] = quaternion_to_matrix(wxyz)
    numbers = position_and_quaternion(T)
    assert (numbers[:, 6] >= 0).all()
    assert np.abs(quaternion_to_matrix(numbers[:, [6, 3, 4, 5]]) - T[:, :3, :3]).max() < 1e-12
    turned = np.eye(4)
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # by 90 degrees about z
    assert np.allclose(position_and_quaternion(turned), [0, 0, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)])


def test_numbers_of_markers() -> None:
    ids = MarkerIds()
    keys: list[int | str] = [0, 2**31 - 1, 2**31, "a", -4, "b", 2**80]
    numbers = [ids.of(key) for key in keys]
    assert numbers[:2] == [0, 2**31 - 1]
    assert len(set(numbers)) == len(keys)
    assert all(-(2**31) <= number < 2**31 for number in numbers)
    assert [ids.of(key) for key in keys] == numbers


def test_names_stand_above_boxes_if_somebody_knows_where_that_is() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # the box's first side is along y
    T[:3, 3] = 1, 2, 3
    thing = Thing(1, "cup", T, np.array([0.4, 0.2, 0.6]))
    assert np.array_equal(label_place(thing, None), [1, 2, 3])
    assert np.allclose(label_place(thing, (0, -1, 0)), [1, 2 - 0.2 - ThingTuning.text_m, 3])
    assert np.allclose(label_place(thing, (0, 0, 1)), [1, 2, 3 + 0.1 + ThingTuning.text_m])


def test_texts() -> None:
    assert plain_text("a\0b") == "a b"
    assert plain_text("\ud800x") == "?x"
    assert len(plain_text("ü" * 1000)) == 500


@pytest.mark.parametrize(("size", "expected"), [(0, b"\0"), (127, b"\x7f"), (128, b"\x80\x01"), (300, b"\xac\x02")])
def test_varints(size: int, expected: bytes) -> None:
    assert length(size) == expected
