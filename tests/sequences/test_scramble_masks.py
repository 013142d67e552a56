# SPDX-License-Identifier: Apache-2.0
"""The script that spoils masks: shares of split, dropped and dotted, and masks that open again."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence

SCRIPT = Path(__file__).parents[2] / "scripts" / "tools" / "scramble_masks.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("scramble_masks", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def tiles(count: int = 20, size: int = 12) -> np.ndarray:
    """count^2 square segments with ids 1001, 1002, ...; every segment has `size`^2 pixels."""
    return np.kron(np.arange(1001, 1001 + count**2).reshape(count, count), np.ones((size, size), int)).astype(np.uint16)


def test_shares(script: ModuleType) -> None:
    mask = tiles()
    pieces, dropped, dotted = [], [], []
    for seed in range(5):
        split = script.scramble(mask, np.random.default_rng(seed), 0.2, 0, 0)
        pieces.append(len(np.unique(split)))
        dropped.append((script.scramble(mask, np.random.default_rng(seed), 0, 0.05, 0) == 0).mean())
        dots = script.scramble(mask, np.random.default_rng(seed), 0.2, 0, 0.01)
        dotted.append((dots != split).mean())
    assert np.mean(pieces) == pytest.approx(400 * 1.2, rel=0.03)
    assert np.mean(dropped) == pytest.approx(0.05, abs=0.02)
    assert np.mean(dotted) == pytest.approx(0.01, rel=0.15)


def test_pieces_are_halves(script: ModuleType) -> None:
    mask = tiles(3, 21)
    result = script.scramble(mask, np.random.default_rng(1), 1, 0, 0)
    for segment in np.unique(mask):
        ids, counts = np.unique(result[mask == segment], return_counts=True)
        assert len(ids) == 2 and counts.min() > 0.4 * 21**2  # a line through the centre of a square
    assert set(np.unique(result)) == set(range(1, 19))


def test_ids_are_shuffled_and_unlabelled_stays(script: ModuleType) -> None:
    mask = tiles(4)
    mask[mask == 1001] = 0
    first, second = (script.scramble(mask, np.random.default_rng(seed), 0, 0, 0) for seed in (0, 1))
    assert first.dtype == np.uint16 and (first != second).any()
    np.testing.assert_array_equal(first == 0, mask == 0)
    pairs = {(int(a), int(b)) for a, b in zip(mask.ravel(), first.ravel(), strict=True)}
    assert len(pairs) == 16 and {b for _, b in pairs} == set(range(16))  # one to one


@pytest.mark.parametrize("value", [0, 9])
def test_plain_masks(script: ModuleType, value: int) -> None:
    mask = np.full((6, 8), value, np.uint16)
    np.testing.assert_array_equal(script.scramble(mask, np.random.default_rng(0), 0, 0, 0.5), mask > 0)
    assert not script.scramble(mask, np.random.default_rng(0), 0.5, 1, 0.5).any()
    lone = np.zeros((6, 8), np.uint16)
    lone[2, 3] = value
    np.testing.assert_array_equal(script.scramble(lone, np.random.default_rng(0), 1, 0, 0), lone > 0)


def test_recording(script: ModuleType, room: Path, tmp_path: Path) -> None:
    written = script.scramble_recording(room, tmp_path / "a", 0, 0.2, 0.05, 0.01)
    assert written == 24
    true, spoilt = open_sequence(room), open_sequence(room, masks=tmp_path / "a")
    assert spoilt.warnings == true.warnings and spoilt.instance_names == {}
    script.scramble_recording(room, tmp_path / "again", 0, 0.2, 0.05, 0.01)
    script.scramble_recording(room, tmp_path / "other", 1, 0.2, 0.05, 0.01)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
        assert path.read_bytes() != (tmp_path / "other" / path.name).read_bytes()
    a, b = spoilt.frame(3).mask, spoilt.frame(4).mask
    assert a is not None and b is not None
    same = true.frame(3).mask == true.frame(4).mask
    assert same.mean() > 0.5 and (a[same] == b[same]).mean() < 0.5  # ids do not carry over


def test_recording_without_masks(script: ModuleType, tmp_path: Path, make: object) -> None:
    with pytest.raises(SequenceError, match="has no masks"):
        script.scramble_recording(make("tum"), tmp_path / "out", 0, 0.2, 0.05, 0.01)  # type: ignore[operator]
    assert not (tmp_path / "out").exists()
