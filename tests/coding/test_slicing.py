# SPDX-License-Identifier: Apache-2.0
"""How clouds are cut, and partial decoding."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.coding import CodecSettings, decode_box, decode_cloud, decode_slice, encode_cloud, list_slices
from ggslam.coding.container import UnitType, read_units
from ggslam.coding.quantization import choose_quantization
from ggslam.coding.slices import assign_slices
from ggslam.errors import ConfigError, FormatError


def numbers(points: np.ndarray, **choices: object) -> np.ndarray:
    settings = CodecSettings(**choices)  # type: ignore[arg-type]
    quantization = choose_quantization(points, None, 10, 1.0, None)
    found = assign_slices(points, quantization, settings)
    return np.zeros(len(points), np.uint8) if found is None else found


def test_equal_counts(surface: tuple) -> None:
    counts = np.bincount(numbers(surface[0], slices=7))
    assert counts.max() - counts.min() <= 1


def test_equal_intervals(surface: tuple) -> None:
    points = surface[0]
    found = numbers(points, slices=3, split="interval")
    assert np.array_equal(found, points[:, 0] // 50)


def test_cubes(surface: tuple) -> None:
    """Every slice lies in one cube of the octree, and there are no larger ones that would do."""
    points = surface[0]
    found = numbers(points, slices=5, split="cube")
    cubes = {tuple(row) for row in np.unique(np.c_[points - points.min(0) >> 6, found], axis=0)}
    assert len(cubes) == found.max() + 1 >= 5


def test_a_plane_is_cut_within() -> None:
    """All points have the same coordinate along the longest axis but one."""
    rng = np.random.default_rng(0)
    points = np.c_[np.full(1000, 5), rng.integers(0, 300, (1000, 2))]
    points = np.concatenate([points, [[900, 0, 0]]])
    counts = np.bincount(numbers(points, slices=4))
    assert len(counts) == 4 and counts.max() - counts.min() <= 2


@pytest.mark.parametrize("split", ["count", "interval", "cube"])
def test_no_slice_is_too_large(split: str) -> None:
    rng = np.random.default_rng(0)
    points = (rng.normal(size=(4000, 3)) ** 3 * 100).astype(np.int64)
    found = numbers(points, slices=2, split=split, max_points=300)
    counts = np.bincount(found)
    assert counts.max() <= 300 and counts.min() > 0


def test_points_of_a_voxel_stay_together() -> None:
    rng = np.random.default_rng(0)
    points = rng.integers(0, 6, (3000, 3))
    found = numbers(points, slices=9)
    pairs = np.unique(np.c_[points, found], axis=0)
    assert len(pairs) == len(np.unique(points, axis=0))
    assert len(np.unique(found)) == 9


def test_equal_points_make_one_slice() -> None:
    assert len(list_slices(encode_cloud(np.full((50, 3), 7), settings=CodecSettings(slices=4)).data)) == 1


def test_partial_decoding_by_box(surface: tuple) -> None:
    points, colors = surface
    data = encode_cloud(points, {"color": colors}, CodecSettings(slices=6)).data
    whole = decode_cloud(data)
    low, high = (30, 20, 0), (70, 60, 20)
    inside = ((whole.points >= low) & (whole.points <= high)).all(1)
    part = decode_box(data, low, high)
    assert 0 < inside.sum() < len(whole)
    assert np.array_equal(part.points, whole.points[inside])
    assert np.array_equal(part.attributes["color"], whole.attributes["color"][inside])


def test_slices_outside_a_box_are_not_decoded(surface: tuple) -> None:
    """Damage in one slice does not reach a box in another."""
    points, colors = surface
    data = bytearray(encode_cloud(points, {"color": colors}, CodecSettings(slices=6)).data)
    geometry = [unit for unit in read_units(bytes(data)) if unit.kind == UnitType.GEOMETRY][-1]
    start = geometry.offset + 20
    data[start : start + 30] = bytes(30)
    assert len(decode_box(data, (0, 0, 0), (10, 100, 100))) > 0
    assert len(decode_slice(data, 0)) > 0
    with pytest.raises(FormatError, match="slice 5"):
        decode_cloud(data)


def test_an_empty_box_is_an_empty_cloud(surface: tuple) -> None:
    data = encode_cloud(surface[0], {"color": surface[1], "grey": surface[1][:, 0]}).data
    cloud = decode_box(data, (900, 900, 900), (901, 901, 901))
    assert cloud.points.shape == (0, 3)
    assert cloud.attributes["color"].shape == (0, 3) and cloud.attributes["grey"].shape == (0,)


def test_an_unknown_slice_is_refused(surface: tuple) -> None:
    data = encode_cloud(surface[0], settings=CodecSettings(slices=3)).data
    with pytest.raises(FormatError, match=r"\b3\b.*0 to 2"):
        decode_slice(data, 3)


@pytest.mark.parametrize(
    ("choices", "name"),
    [
        ({"split": "random"}, "split"), ({"slices": 0}, "slices"), ({"max_points": 2_000_000}, "max_points"),
        ({"qp": 3}, "qp"), ({"neighbour_boundary": 1}, "neighbour_boundary"), ({"duplicates": "drop"}, "duplicates"),
        ({"threads": 0}, "threads"), ({"voxel_size": 0}, "voxel_size"),
    ],
)  # fmt: skip
def test_impossible_settings_are_named(choices: dict, name: str) -> None:
    with pytest.raises(ConfigError, match=f"CodecSettings.{name}"):
        CodecSettings(**choices)
