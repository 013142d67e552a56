# SPDX-License-Identifier: Apache-2.0
"""What `ggslam.objects.segments` and `overlap` have the compiled core do, in numpy and OpenCV: the tests' reference, by
the same names."""

from __future__ import annotations

import cv2
import numpy as np
from pixel_passes_reference import connected_pieces

from ggslam.objects.overlap import MapView, SegmentOverlap
from ggslam.objects.settings import REFERENCE_WIDTH, AssociationSettings, CleaningSettings

_SMALL_SQUARE = np.ones((3, 3), np.uint8)
_DIRECTIONS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


def fill_from_nearest(segments: np.ndarray, missing: np.ndarray) -> np.ndarray:
    if not missing.any() or missing.all():
        return segments
    _, nearest = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3, labelType=cv2.DIST_LABEL_PIXEL
    )
    kept = ~missing
    source = np.zeros(int(nearest.max()) + 1, segments.dtype)
    source[nearest[kept]] = segments[kept]
    return np.where(missing, source[nearest], segments)


def clean_segments(segments: np.ndarray, settings: CleaningSettings) -> np.ndarray:
    pieces = connected_pieces(segments)
    small = np.bincount(pieces.ravel()) < settings.min_area * segments.size
    cleaned = fill_from_nearest(segments, small[pieces])
    # Only without the dots does the width of a piece show.
    inner = cv2.erode(cleaned, _SMALL_SQUARE) == cv2.dilate(cleaned, _SMALL_SQUARE)
    pieces = connected_pieces(cleaned)
    thin = np.ones(int(pieces.max()) + 1, bool)
    thin[pieces[inner]] = False
    return fill_from_nearest(cleaned, thin[pieces])


def boundary_trust(segments: np.ndarray, depth: np.ndarray, settings: CleaningSettings) -> np.ndarray:
    height, width = segments.shape
    trusted = np.ones(segments.shape, bool)
    reach = max(1, round(settings.band_pixels * width / REFERENCE_WIDTH)) if settings.band_pixels else 0
    if not reach:
        return trusted
    size = 2 * reach + 1
    square = np.ones((size, size), np.uint8)
    edge = cv2.erode(segments, square) != cv2.dilate(segments, square)
    measured = (segments > 0) & (depth > 0)
    rows, columns = np.nonzero(edge & measured)
    own, z = segments[rows, columns], depth[rows, columns]
    tolerance = np.maximum(settings.jump_m, settings.jump_relative * z)
    inner = np.where(~edge & measured, segments, np.uint16(0))
    fits_own, fits_other, has_inside = (np.zeros(len(rows), bool) for _ in range(3))
    for dy, dx in _DIRECTIONS:
        near, far = (
            ((rows + k * dy).clip(0, height - 1), (columns + k * dx).clip(0, width - 1))
            for k in (reach + 1, 2 * reach + 2)
        )
        found = inner[near]
        fits = np.abs(depth[near] - z) < tolerance
        # Inverse depth is linear on a plane: a floor seen from afar falls off fast, but straight.
        line = (found > 0) & (inner[far] == found)
        ahead = 2 / depth[near][line] - 1 / depth[far][line]
        fits[line] |= np.abs(1 / np.maximum(ahead, 1e-3) - z[line]) < tolerance[line]
        has_inside |= found == own
        fits_own |= (found == own) & fits
        fits_other |= (found > 0) & (found != own) & fits
    trusted[rows, columns] = fits_own | ~has_inside | ~fits_other
    return trusted


def number_ids(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    present = np.bincount(ids.ravel(), minlength=1) > 0
    present[0] = False
    found = np.flatnonzero(present)
    table = np.full(len(present), -1, np.int32)
    table[found] = np.arange(len(found))
    return found.astype(np.uint16), table[ids]


def same_surface(view: MapView, depth: np.ndarray, settings: AssociationSettings) -> np.ndarray:
    tolerance = np.maximum(settings.depth_tolerance_m, settings.depth_tolerance_relative * depth)
    return (view.depth > 0) & ((depth <= 0) | (np.abs(view.depth - depth) < tolerance))


def overlap_of(
    segments: np.ndarray, view: MapView, depth: np.ndarray, settings: AssociationSettings, renamed: np.ndarray
) -> SegmentOverlap:
    known = same_surface(view, depth, settings) & (view.confidence >= settings.min_confidence)
    segment_ids, row = number_ids(segments)
    object_ids, column = number_ids(np.where(known, renamed[view.ids], np.uint16(0)))
    both = (row >= 0) & (column >= 0)
    shape = len(segment_ids), len(object_ids)
    pairs = row[both].astype(np.int64) * shape[1] + column[both]
    shared = np.bincount(pairs, minlength=shape[0] * shape[1]).reshape(shape)
    area = np.bincount(row[row >= 0], minlength=shape[0])
    touching = find_touching_pairs(np.where(known, renamed[view.ids], np.uint16(0)))
    return SegmentOverlap(segment_ids, object_ids, shared, area, row, column, touching)


def find_touching_pairs(ids: np.ndarray) -> list[tuple[int, int]]:
    pairs = []
    for a, b in ((ids[:, :-1], ids[:, 1:]), (ids[:-1], ids[1:])):
        edge = (a != b) & (a > 0) & (b > 0)
        low, high = np.minimum(a[edge], b[edge]).astype(np.int64), np.maximum(a[edge], b[edge])
        pairs.append(low << 16 | high)
    return [(int(code >> 16), int(code & 0xFFFF)) for code in np.unique(np.concatenate(pairs))]
