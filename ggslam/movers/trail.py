# SPDX-License-Identifier: Apache-2.0
"""The space that movers passed through, and the parts of earlier views that showed something there that is gone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from ggslam.geometry.image_parts import parts_with_seeds
from ggslam.geometry.voxels import neighbour_step, voxel_keys
from ggslam.movers.segments import Gathering, gather
from ggslam.movers.settings import MoverSettings
from ggslam.scene.poses import transform_points
from ggslam.sight.passed_voxels import PassedParts
from ggslam.sight.places import CoarseView, PairEvidence
from ggslam.system.array_forms import Form
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class TrailTuning(Tuning):
    """Space that movers passed through."""

    voxel_m = 0.05
    """Voxel of the trail in metres."""
    min_in_trail = 0.1
    """Smallest share in the trail of a piece that has gone."""


_STEPS = [neighbour_step(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]


@savable()
@dataclass
class Trail:
    """Voxels in and next to which something was seen that moved.

    Attributes:
        keys: int64 [n], sorted.
        growths: how many times it has grown.
    """

    keys: Annotated[np.ndarray, Form("i8", None)] = field(default_factory=lambda: np.empty(0, np.int64))
    growths: int = 0

    def add(self, view: CoarseView, places: np.ndarray) -> None:
        """Adds what a view shows at some places, bool [h, w]."""
        keys = np.unique(voxel_keys(_world_points(view)[(places & (view.depth > 0)).reshape(-1)], TrailTuning.voxel_m))
        around = np.unique((keys[:, None] + np.array(_STEPS)).reshape(-1))
        joined = np.union1d(self.keys, around)
        if len(joined) > len(self.keys):
            self.keys, self.growths = joined, self.growths + 1

    def contains(self, view: CoarseView) -> np.ndarray:
        """Which places of a view are in it, bool [h, w]."""
        keys = voxel_keys(_world_points(view), TrailTuning.voxel_m)
        if not len(self.keys):
            return np.zeros(view.depth.shape, bool)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return (self.keys[at] == keys).reshape(view.depth.shape) & (view.depth > 0)


def which_may_be_gone(passed: PassedParts, has_segments: np.ndarray, settings: MoverSettings) -> list[int]:
    """The views of which enough is looked past for something to be gone, see `gone_since`; `has_segments`: bool [n]."""
    large_enough = has_segments | (passed.largest >= settings.min_pixels)
    return np.flatnonzero((passed.places >= settings.min_pixels / 4) & large_enough).tolist()


def gone_since(
    earlier: CoarseView, evidence: PairEvidence, trail: Trail, segments: np.ndarray | None,
    shape: tuple[int, int], factor: int, settings: MoverSettings,
) -> np.ndarray | None:  # fmt: skip
    """What an earlier view shows where a mover has been since, and the newest view looks through.

    Args:
        earlier: a view.
        evidence: of the newest view about it, without what moves in that one now.
        trail: of movers.
        segments: ids uint16 [H, W] of the earlier view, or None.
        shape: of its image, (H, W).
        factor: how many times the views are smaller.
        settings: how much of a segment has to be gone.

    Returns:
        bool [H, W]; None: nothing.
    """
    near = trail.contains(earlier)
    if near.sum() < settings.min_pixels / 4:
        return None
    # Movers are found by the side that goes ahead: the rest of what has gone hangs on what lies in their trail.
    passed = parts_with_seeds(evidence.passed & near, evidence.passed, TrailTuning.min_in_trail)
    if passed.sum() < settings.min_pixels / 4:
        return None
    rests, world = np.zeros(passed.shape, bool), evidence.same
    found = gather(
        Gathering(passed, rests, earlier.depth > 0, rests, rests, earlier.depth, world, factor, shape),
        lambda: segments,
        settings,
    )
    return None if found is None else found.full > 0


def _world_points(view: CoarseView) -> np.ndarray:
    return transform_points(view.camera.back_project(view.depth).reshape(-1, 3), view.T_world_camera)
