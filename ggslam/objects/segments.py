# SPDX-License-Identifier: Apache-2.0
"""Cleaning of segment masks: dots and slivers are filled, labels that bleed over depth jumps are found.

Pieces of one segment that an occluder keeps apart stay one segment: they are one object.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.objects.pixel_passes import connected_pieces
from ggslam.objects.settings import REFERENCE_WIDTH, CleaningSettings

_SMALL_SQUARE = np.ones((3, 3), np.uint8)
_DIRECTIONS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


def fill_from_nearest(segments: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """`segments` [H, W] with the pixels `missing` (bool [H, W]) taken from the nearest pixel that is not."""
    if not missing.any() or missing.all():
        return segments
    _, nearest = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3, labelType=cv2.DIST_LABEL_PIXEL
    )
    kept = ~missing
    source = np.zeros(int(nearest.max()) + 1, segments.dtype)
    source[nearest[kept]] = segments[kept]
    return np.where(missing, source[nearest], segments)


def clean_segments(segments: np.ndarray, settings: CleaningSettings | None = None) -> np.ndarray:
    """Takes dots and slivers out of a mask and fills them from their surroundings.

    A connected piece goes if it is smaller than `min_area` or nowhere three pixels wide. Unlabelled pieces are treated
    alike: unlabelled dots are filled, and dots on unlabelled ground become unlabelled.

    Args:
        segments: uint16 [H, W], 0 = unlabelled.
        settings: sizes.

    Returns:
        uint16 [H, W].
    """
    settings = settings or CleaningSettings()
    pieces = connected_pieces(segments)
    small = np.bincount(pieces.ravel()) < settings.min_area * segments.size
    cleaned = fill_from_nearest(segments, small[pieces])
    # Only without the dots does the width of a piece show.
    inner = cv2.erode(cleaned, _SMALL_SQUARE) == cv2.dilate(cleaned, _SMALL_SQUARE)
    pieces = connected_pieces(cleaned)
    thin = np.ones(int(pieces.max()) + 1, bool)
    thin[pieces[inner]] = False
    return fill_from_nearest(cleaned, thin[pieces])


def boundary_trust(segments: np.ndarray, depth: np.ndarray, settings: CleaningSettings | None = None) -> np.ndarray:
    """Where a mask can be believed: not where a label has bled over a depth jump onto another surface.

    Near the boundary of its segment, a pixel is on the wrong side if its depth continues the inside of another segment
    along a straight line, but in no direction that of its own. Boundaries that lie on the jump itself are believed, so
    that an exact mask loses next to nothing, and so are boundaries on smooth surfaces and segments too thin to have an
    inside.

    Args:
        segments: uint16 [H, W], 0 = unlabelled.
        depth: float32 [H, W], metres, 0 = unknown.
        settings: width of the band and size of a jump.

    Returns:
        bool [H, W]; False: leave this pixel unlabelled.
    """
    settings = settings or CleaningSettings()
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
