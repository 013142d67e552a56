# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import ConfigError
from ggslam.objects.pixel_passes import connected_pieces
from ggslam.objects.segments import boundary_trust, clean_segments
from ggslam.objects.settings import CleaningSettings
from ggslam.sequences import open_sequence


@pytest.fixture
def table() -> np.ndarray:
    """A wall (7), a table (300) and on it a mug (9) of 10x10 pixels, and ground that nobody labelled."""
    segments = np.full((240, 320), 7, np.uint16)
    segments[120:] = 300
    segments[140:150, 100:110] = 9
    segments[:, 280:] = 0
    return segments


def test_dots_vanish_and_a_mug_stays(table: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    noisy = table.copy()
    dots = rng.random(table.shape) < 0.01
    noisy[dots] = rng.integers(0, 500, dots.sum())
    cleaned = clean_segments(noisy)
    assert set(np.unique(cleaned)) == {0, 7, 9, 300}
    assert (cleaned != table).mean() < 0.001
    assert ((cleaned == 9) & (table == 9)).sum() >= 95


def test_slivers_vanish_and_thin_parts_of_a_segment_stay(table: np.ndarray) -> None:
    with_slivers = table.copy()
    with_slivers[60:62, 20:200] = 55
    with_slivers[136:140, 107:109] = 9  # a straw in the mug
    cleaned = clean_segments(with_slivers)
    assert 55 not in cleaned
    assert (cleaned[60:62, 20:200] == 7).all()
    assert (cleaned[136:140, 107:109] == 9).all()


def test_pieces_apart_by_an_occluder_stay_one_segment(table: np.ndarray) -> None:
    table[:, 150:160] = 44
    np.testing.assert_array_equal(clean_segments(table), table)


def test_masks_without_ids_or_of_one_id_pass() -> None:
    for value in (0, 12):
        mask = np.full((48, 64), value, np.uint16)
        np.testing.assert_array_equal(clean_segments(mask), mask)
        assert boundary_trust(mask, np.ones(mask.shape, np.float32)).all()


def test_exact_masks_are_hardly_touched(room: Path) -> None:
    frame = open_sequence(room).frame(0)
    assert frame.mask is not None
    assert (clean_segments(frame.mask) != frame.mask).mean() < 0.005
    assert boundary_trust(frame.mask, frame.depth).mean() > 0.985


def test_labels_that_bleed_over_a_depth_jump_are_not_trusted() -> None:
    depth = np.full((120, 160), 3.0, np.float32)
    depth[40:80, 40:80] = 1.5
    exact = np.where(depth < 2, 2, 1).astype(np.uint16)
    assert boundary_trust(exact, depth).all()
    bleeding = exact.copy()
    bleeding[40:80, 80] = 2  # the near object's label, one pixel too far
    trusted = boundary_trust(bleeding, depth)
    assert not trusted[44:76, 80].any()
    assert trusted[bleeding == exact].all()


def test_boundaries_on_one_surface_and_unknown_depth_are_trusted() -> None:
    segments = np.ones((60, 80), np.uint16)
    segments[:, 40:] = 2
    depth = np.full((60, 80), 2.0, np.float32)
    assert boundary_trust(segments, depth).all()
    assert boundary_trust(segments, np.zeros_like(depth)).all()


def test_connected_pieces_of_many_ids() -> None:
    segments = np.array([[1, 1, 2], [2, 1, 2], [1, 3, 3]], np.uint16)
    pieces = connected_pieces(segments)
    same = pieces.ravel()[:, None] == pieces.ravel()[None, :]
    expected = np.array([0, 0, 1, 2, 0, 1, 3, 4, 4])
    np.testing.assert_array_equal(same, expected[:, None] == expected[None, :])


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="CleaningSettings.min_area"):
        CleaningSettings(min_area=2)
