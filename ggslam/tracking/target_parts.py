# SPDX-License-Identifier: Apache-2.0
"""Targets composed of parts that come and go, such as the cells of a stored map around the sensor.

A part is gathered in voxels once, on its own, in any thread. To compose a target then costs a copy of what it shares
with the one before, and work only where parts came, went or meet.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.native.loader import NativeContext, load_library
from ggslam.tracking.gicp import GicpTarget, native_target_settings
from ggslam.tracking.settings import TargetSettings


class TargetPart:
    """Gaussians gathered in voxels, to be part of targets. Never changes.

    Args:
        means, quaternions, log_scales, opacity_logits: contiguous float32 [n, 3], [n, 4] wxyz, [n, 3], [n], as for
            `GicpTarget.from_arrays`. The third axis of a disc points to the side that was seen.
        settings: voxel sizes and bounds.
        context: instruction set; its threads are left alone, so that another thread may be using it.
        rank: 0 to 2^64 - 1, different for all parts of one target. Where parts meet, the one of the lowest rank is
            asked first which side of a thin sheet is meant, and sums are made in the order of the ranks.
    """

    def __init__(
        self, means: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray, opacity_logits: np.ndarray,
        settings: TargetSettings, context: NativeContext, rank: int,
    ) -> None:  # fmt: skip
        self._handle: int | None = None
        self._library = load_library()
        self.settings, self.rank, self.count = settings, rank, len(means)
        arrays = (means, quaternions, log_scales, opacity_logits)
        given = structures.TargetInput(*(address(a) for a in arrays), None, None, len(means), 0)
        arguments = native_target_settings(settings, settings.voxel)
        self._handle = self._library.ggslam_target_part_create(context.handle, given, arguments, rank)
        self.nbytes: int = self._library.ggslam_target_part_bytes(self._handle)
        """Memory that it takes."""

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.ggslam_target_part_destroy(self._handle)

    @property
    def handle(self) -> int:
        """Pointer for the core."""
        assert self._handle is not None
        return self._handle


def composed_target(
    parts: Sequence[TargetPart], settings: TargetSettings, context: NativeContext, before: GicpTarget | None = None,
    origin: np.ndarray | None = None,
) -> GicpTarget:  # fmt: skip
    """The target of all parts together.

    Up to rounding it is what `GicpTarget.from_arrays` makes of all their Gaussians, ordered by rank. It depends, to the
    bit, on the parts alone: `before` only saves work.

    Args:
        parts: of these settings and of different ranks, in any order.
        before: a target composed with the same settings; what it shares with this one is copied from it.
        origin: where in the world the parts' coordinates are zero, [3]; None: at its own origin.

    Raises:
        ValueError: parts of other settings, or two of one rank; or `before` is of another kind or has another origin.
    """
    if any(part.settings != settings for part in parts):
        raise ValueError("the parts have other settings")
    if len({part.rank for part in parts}) < len(parts):
        raise ValueError("two parts have the same rank")
    if before is not None and before.composed_with != settings:
        raise ValueError("the previous target was composed with other settings")
    target = GicpTarget()
    if origin is not None:
        target.origin = np.array(origin, np.float64)
    if before is not None and (before.origin != target.origin).any():
        raise ValueError("the previous target has another origin")
    target.voxel, target.composed_with = settings.voxel, settings
    handles = (ctypes.c_void_p * len(parts))(*(part.handle for part in parts))
    load_library().ggslam_gicp_target_compose(
        context.handle, target.handle, None if before is None else before.handle, handles, len(parts),
        native_target_settings(settings, settings.voxel),
    )  # fmt: skip
    return target
