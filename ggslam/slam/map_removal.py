# SPDX-License-Identifier: Apache-2.0
"""Removes transient things from a map: Gaussians, pixels of keyframes, points of the surface."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.pruning import blank_part, drop_before, drop_moved, drop_pixels
from ggslam.movers.outdated import OutdatedParts
from ggslam.slam.map_paging import MapPager
from ggslam.system.savable import savable
from ggslam.tracking.surface import MeasuredSurface


@savable(not_saved="_surface _mapper _publishing is_paged")
class MapRemoval:
    """The parts of a run that filters remove things with.

    Args:
        surface: that frames are aligned to.
        mapper: whose map it is.
        pager: of the map; None: all of it is in memory. What is on disk stays.
        publishing: is held while the surface changes, which the tracker's thread reads.
    """

    def __init__(
        self, surface: MeasuredSurface, mapper: Mapper, pager: MapPager | None, publishing: threading.Lock
    ) -> None:
        self._surface, self._mapper, self._publishing = surface, mapper, publishing
        self.is_paged = pager is not None
        """Whether a part of the map is on disk."""

    @property
    def keyframes(self) -> list[Keyframe]:
        """Of the map so far."""
        return self._mapper.keyframes

    def latest_poses(self, count: int) -> np.ndarray:
        """T_world_camera of the latest keyframes, so many or all there are, float64 [n, 4, 4]."""
        return self._mapper.latest_poses(count)

    def drop_pixels(self, mask: np.ndarray, nearest: float) -> None:
        """Removes what all keyframes show at the same pixels, or very near.

        Args:
            mask: bool [H, W].
            nearest: metres; nearer depth goes, wherever it is in the image.
        """
        drop_pixels(self._mapper.map, self._mapper.keyframes, mask, nearest)
        with self._publishing:
            self._surface.drop_pixels(mask, nearest, self._mapper.keyframes[-1].camera)

    def drop_moved(self, parts: Sequence[tuple[Keyframe, np.ndarray]]) -> None:
        """Removes what keyframes show at pixels of each [H, W] where something has moved since."""
        drop_moved(self._mapper.map, list(parts))
        self._forget_pixels([keyframe for keyframe, _ in parts])
        with self._publishing:
            self._surface.drop_pixels_of({k.index: (part, k.camera) for k, part in parts})

    def drop_outdated(self, found: Sequence[tuple[Keyframe, OutdatedParts]]) -> int:
        """Removes what keyframes of the map that the run began with show and newer ones look through; returns how many
        Gaussians went."""
        births = np.array([k.index for k in self._mapper.keyframes if k.frame_index == FROM_EARLIER_RUN])
        gone = [(k, parts) for k, parts in found if parts.gone.any()]
        dropped = [(k, parts.gone, parts.around) for k, parts in gone]
        went = drop_before(self._mapper.map, births, dropped) if gone else 0
        for keyframe, parts in found:
            blank_part(keyframe, parts.around | parts.hidden)
        self._forget_pixels([keyframe for keyframe, _ in found])
        with self._publishing:
            self._surface.drop_pixels_of({k.index: (parts.around, k.camera) for k, parts in gone})
        return went

    def _forget_pixels(self, keyframes: Sequence[Keyframe]) -> None:
        """Identity vectors are not trained on pixels of these keyframes drawn before."""
        if self._mapper.identity is not None:
            self._mapper.identity.forget_pixels([keyframe.index for keyframe in keyframes])
