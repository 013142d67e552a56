# SPDX-License-Identifier: Apache-2.0
"""The compiled core's passes over masks against their reference in numpy and OpenCV: equal in every pixel."""

from __future__ import annotations

import ctypes
from dataclasses import replace

import mask_passes_reference as reference
import numpy as np
import pytest
from random_masks import masks, random_depth, random_mask

from ggslam.abi import core
from ggslam.errors import CoreInputError
from ggslam.native.loader import load_library
from ggslam.objects.overlap import MapView, OverlapTuning, distinct_ids, overlap_of
from ggslam.objects.segments import boundary_trust, clean_segments
from ggslam.objects.settings import IDS, AssociationSettings, CleaningSettings
from ggslam.system.tuning import overridden

UNCHANGED = np.arange(IDS).astype(np.uint16)


def test_cleaned_masks_are_those_of_the_reference() -> None:
    changed = 0
    for k, mask in enumerate(masks(0)):
        settings = CleaningSettings(min_area=[2.5e-4, 0.0, 0.01, 0.1][k % 4])
        before = mask.copy()
        cleaned = clean_segments(mask, settings)
        assert cleaned.dtype == np.uint16
        np.testing.assert_array_equal(cleaned, reference.clean_segments(mask, settings))
        np.testing.assert_array_equal(mask, before)
        changed += bool((cleaned != mask).any())
    assert changed > 50


def test_trust_in_borders_is_that_of_the_reference() -> None:
    rng, doubted = np.random.default_rng(1), 0
    for k, mask in enumerate(masks(1)):
        depth, settings = random_depth(rng, mask), CleaningSettings(band_pixels=[0, 2, 8, 20][k % 4])
        with np.errstate(all="ignore"):
            expected = reference.boundary_trust(mask, depth, settings)
        trusted = boundary_trust(mask, depth, settings)
        assert trusted.dtype == bool
        np.testing.assert_array_equal(trusted, expected)
        doubted += int((~trusted).sum())
    assert doubted > 100


def test_depth_that_is_no_number_is_judged_as_by_the_reference() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        mask = random_mask(rng, (48, 64), [1, 2, 3])
        depth = random_depth(rng, mask)
        for odd in (np.nan, np.inf, -1, 1e-40, 3e38):
            depth[rng.random(mask.shape) < 0.03] = odd
        with np.errstate(all="ignore"):
            expected = reference.boundary_trust(mask, depth, CleaningSettings())
        np.testing.assert_array_equal(boundary_trust(mask, depth), expected)


def assert_overlaps_like_reference(
    mask: np.ndarray, view: MapView, depth: np.ndarray, settings: AssociationSettings, renamed: np.ndarray
) -> int:
    """Returns the number of pairs of objects that touch."""
    ours = overlap_of(mask, view, depth, settings, renamed)
    theirs = reference.overlap_of(mask, view, depth, settings, renamed)
    for name in ("segments", "objects", "shared", "area", "row", "column"):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert a.dtype == b.dtype and a.shape == b.shape, name
        np.testing.assert_array_equal(a, b, name)
    assert list(ours.touching) == list(theirs.touching)
    np.testing.assert_array_equal(distinct_ids(mask), ours.segments)
    return len(ours.touching)


def test_overlaps_are_those_of_the_reference() -> None:
    rng, touching = np.random.default_rng(3), 0
    shown = masks(4)
    for k, mask in enumerate(masks(3)):
        depth = random_depth(rng, mask)
        seen = depth + rng.choice([0, 0.05]) * rng.standard_normal(mask.shape).astype(np.float32)
        if k % 7 == 0:
            seen[...] = 0  # the map shows nothing
        odd = rng.random(mask.shape) < 0.02
        seen[odd], depth[np.roll(odd, 1)] = rng.choice([np.nan, np.inf, -1.0]), rng.choice([np.nan, np.inf, -1.0])
        view = MapView(shown[k], rng.random(mask.shape, np.float32), seen.astype(np.float32))
        settings = AssociationSettings(min_confidence=[0.0, 0.5, 1.0][k % 3])
        renamed = UNCHANGED.copy()
        renamed[1:] = (UNCHANGED[1:], rng.integers(0, IDS, IDS - 1), 3)[k % 3 if k % 4 else 0]
        with np.errstate(invalid="ignore"):
            touching += assert_overlaps_like_reference(mask, view, depth, settings, renamed)
    assert touching > 100


def test_more_pairs_than_room_was_made_for() -> None:
    ids = np.arange(1, 1201, dtype=np.uint16).reshape(30, 40)
    depth, sure = np.ones(ids.shape, np.float32), np.ones(ids.shape, np.float32)
    assert len(ids.ravel()) ** 2 > OverlapTuning.room
    touching = assert_overlaps_like_reference(
        ids[::-1], MapView(ids, sure, depth), depth, AssociationSettings(), UNCHANGED
    )
    assert touching == 30 * 39 + 29 * 40
    with overridden(OverlapTuning, room=20):
        few = np.repeat(ids[:2, :8], 3, 0)  # touching ones do not fit, shared ones do
        near = depth[:6, :8]
        assert_overlaps_like_reference(
            np.ones_like(few), MapView(few, near, near), near, AssociationSettings(), UNCHANGED
        )


def test_images_that_are_views_of_others_are_taken() -> None:
    rng = np.random.default_rng(5)
    wide = random_mask(rng, (40, 90), [0, 3, 4, 65535])
    mask, depth = wide[::2, ::3], random_depth(rng, wide)[::2, ::3]
    settings = CleaningSettings()
    np.testing.assert_array_equal(clean_segments(mask), reference.clean_segments(mask, settings))
    with np.errstate(all="ignore"):
        expected = reference.boundary_trust(mask, depth, settings)
    np.testing.assert_array_equal(boundary_trust(mask, depth), expected)
    view = MapView(mask, np.ones(mask.shape, np.float32), depth)
    assert_overlaps_like_reference(mask, view, depth, replace(AssociationSettings()), UNCHANGED)


@pytest.mark.parametrize("function, job", [
    ("ggslam_clean_segments", core.CleaningJob(height=2, width=2)),
    ("ggslam_trust_borders", core.TrustJob(height=2, width=2, reach=1)),
    ("ggslam_segment_overlap", core.OverlapJob(height=2, width=2)),
])  # fmt: skip
def test_jobs_without_images_are_refused(function: str, job: ctypes.Structure) -> None:
    with pytest.raises(CoreInputError, match="null pointer"):
        getattr(load_library(), function)(ctypes.byref(job))
