# SPDX-License-Identifier: Apache-2.0
"""Masks of what moves are kept small, come back as they were, and take it out of frames that are read again."""

from __future__ import annotations

import io
import pickle
import zlib
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.scene.arrays import arrays_to_bytes
from ggslam.sequences import open_sequence
from ggslam.sequences.moving_pixels import MovingPixels


@pytest.fixture
def masks() -> dict[int, np.ndarray]:
    rng = np.random.default_rng(0)
    return {3: rng.random((121, 161)) > 0.5, 5: np.zeros((121, 161), bool), 9: np.ones((121, 161), bool)}


@pytest.fixture
def moving(masks: dict[int, np.ndarray]) -> MovingPixels:
    found = MovingPixels()
    for frame, mask in masks.items():
        found.add(frame, mask)
    return found


def test_masks_come_back(moving: MovingPixels, masks: dict[int, np.ndarray]) -> None:
    with np.load(io.BytesIO(arrays_to_bytes(**moving.to_arrays())), allow_pickle=False) as arrays:
        again = MovingPixels.from_arrays(arrays)
    for frame, mask in masks.items():
        assert np.array_equal(again.mask(frame, (121, 161)), mask)
    assert again.mask(4, (121, 161)) is None and len(again) == 3


def test_masks_of_other_images(moving: MovingPixels, masks: dict[int, np.ndarray]) -> None:
    half = moving.mask(9, (60, 80))
    assert half is not None and half.shape == (60, 80) and half.all()


def test_selected_and_joined(moving: MovingPixels, masks: dict[int, np.ndarray]) -> None:
    chosen = moving.select(range(1, 10, 2))
    assert chosen.frames == [1, 2, 4] and np.array_equal(chosen.mask(1, (121, 161)), masks[3])
    other = MovingPixels()
    other.add(0, np.ones((10, 10), bool))
    both = MovingPixels.concatenate([(0, moving), (20, None), (30, moving), (60, other)])
    assert both.frames == [3, 5, 9, 33, 35, 39] and np.array_equal(both.mask(33, (121, 161)), masks[3])


@pytest.mark.parametrize("damage", ["data", "offsets", "size", "bomb", "one frame", "frames", "nothing"])
def test_damaged_masks(moving: MovingPixels, damage: str) -> None:
    arrays = moving.to_arrays()
    if damage == "data":
        arrays["data"] = arrays["data"] ^ 255
    elif damage == "offsets":
        arrays["offsets"] = arrays["offsets"][::-1].copy()
    elif damage == "size":
        arrays["size"] = np.array([500, 500], np.int32)
    elif damage == "bomb":
        arrays["size"] = np.array([30_000, 30_000], np.int32)
        arrays["data"] = np.frombuffer(zlib.compress(bytes(30_000 * 30_000 // 8)), np.uint8)
        arrays |= {"offsets": np.array([0, len(arrays["data"])]), "frames": arrays["frames"][:1]}
    elif damage == "one frame":
        arrays["frames"] = np.array(3, np.int32)
    elif damage == "frames":
        arrays["frames"] = arrays["frames"][:-1]
    else:
        arrays = {}
    with pytest.raises(FormatError, match="mask"):
        MovingPixels.from_arrays(arrays)


def test_frames_come_without_what_moves(room: Path) -> None:
    sequence = open_sequence(room)
    shape, moving = sequence[2].depth.shape, MovingPixels()
    mask = np.zeros(shape, bool)
    mask[10:30, 20:60] = True
    moving.add(2, mask)
    before = sequence[2]
    sequence.moving = moving
    for frame in (sequence[2], pickle.loads(pickle.dumps(sequence))[2], sequence[1:4][1]):
        assert frame.moving is not None and not frame.depth[mask].any()
        assert np.array_equal(frame.depth[~mask], before.depth[~mask]) and np.array_equal(frame.color, before.color)
        assert frame.mask is not None and before.mask is not None and not frame.mask[mask].any()
        assert np.array_equal(frame.mask[~mask], before.mask[~mask])
    lazy = sequence.frame(2, masks="lazy").load_mask()
    assert lazy is not None and not lazy[mask].any()
    assert sequence[3].moving is None
