# SPDX-License-Identifier: Apache-2.0
"""Cleaning of segment masks: dots and slivers are filled, labels that bleed over depth jumps are found.

Pieces of one segment that an occluder keeps apart stay one segment: they are one object.
"""

from __future__ import annotations

import ctypes

import numpy as np

from ggslam.abi import core
from ggslam.abi.arrays import address
from ggslam.native.loader import load_library
from ggslam.objects.settings import REFERENCE_WIDTH, CleaningSettings


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
    segments = np.ascontiguousarray(segments, np.uint16)
    cleaned = np.empty_like(segments)
    smallest = settings.min_area * segments.size
    job = core.CleaningJob(address(segments), *segments.shape, smallest, address(cleaned))
    load_library().ggslam_clean_segments(ctypes.byref(job))
    return cleaned


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
    if not settings.band_pixels:
        return np.ones(segments.shape, bool)
    segments, depth = np.ascontiguousarray(segments, np.uint16), np.ascontiguousarray(depth, np.float32)
    trusted = np.empty(segments.shape, bool)
    reach = max(1, round(settings.band_pixels * segments.shape[1] / REFERENCE_WIDTH))
    job = core.TrustJob(
        address(segments), address(depth), *segments.shape, reach, settings.jump_m, settings.jump_relative,
        address(trusted),
    )  # fmt: skip
    load_library().ggslam_trust_borders(ctypes.byref(job))
    return trusted
