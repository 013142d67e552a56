# SPDX-License-Identifier: Apache-2.0
"""What a new keyframe sees of a map on a device."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from ggslam.cuda.transfers import download
from ggslam.mapping.cuda.insertion import Selection
from ggslam.mapping.cuda.keyframe import CudaKeyframe
from ggslam.mapping.labelling import MapLabels
from ggslam.rendering.exposure import ExposureTuning, SeenAgain
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap


class LookedAt(Protocol):
    """What of a `CudaMapper` a look needs; see there."""

    map: GaussianMap

    @property
    def room_was_short(self) -> torch.Tensor: ...

    def render_keyframe(self, keyframe: CudaKeyframe, with_room: bool) -> RenderBuffers: ...

    def labels_on_grid(self, alpha: torch.Tensor, stride: int) -> tuple[torch.Tensor, torch.Tensor]: ...

    def find_explained(
        self, keyframe: CudaKeyframe, alpha: torch.Tensor | None, depth: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, torch.Tensor | None]: ...

    def selection(
        self, color: torch.Tensor, keyframe: CudaKeyframe, explained: tuple[torch.Tensor | None, torch.Tensor | None],
        T_world_camera: np.ndarray,
    ) -> Selection: ...  # fmt: skip


_SOME = (..., slice(None, None, ExposureTuning.stride), slice(None, None, ExposureTuning.stride))
_LABEL_STRIDE = 2


class KeyframeLook:
    """At the map from a new keyframe, and at what it lacks there. Everything is started at once, and the host waits
    once for what it has to know. If the rendering found no room for a part of the map, it is all done again with room.

    Args:
        mapper: whose map it is.
        keyframe: the new one.
        T_world_camera: [4, 4], its pose.
        with_labels: whether what the map shows of the objects will be asked for.
        with_colors: whether its colours will be.
    """

    def __init__(
        self, mapper: LookedAt, keyframe: CudaKeyframe, T_world_camera: np.ndarray, with_labels: bool,
        with_colors: bool,
    ) -> None:  # fmt: skip
        self._mapper, self._keyframe, self._T = mapper, keyframe, T_world_camera
        self._with_labels, self._with_colors = with_labels, with_colors
        self.shows = mapper.map.count > 0
        """Whether there is a map to look at."""
        self._count: int | None = None
        self._found: list[np.ndarray] = []
        self._start(with_room=False)

    def _start(self, with_room: bool) -> None:
        mapper, keyframe, self._with_room = self._mapper, self._keyframe, with_room
        alpha = depth = None
        self._wanted: list[torch.Tensor] = []
        if self.shows:
            view = mapper.render_keyframe(keyframe, with_room)
            alpha, depth = view.alpha, view.expected_depth
            if self._with_labels:
                self._wanted += [*mapper.labels_on_grid(alpha, _LABEL_STRIDE), depth]
            if self._with_colors:
                self._wanted += [image[_SOME].contiguous() for image in (view.image, alpha, depth)]
        self._explained = mapper.find_explained(keyframe, alpha, depth)
        self.selection = mapper.selection(keyframe.device_images().color, keyframe, self._explained, self._T)

    def select_again(self, color: torch.Tensor) -> None:
        """Chooses pixels of the keyframe with other colours, uint8 [H, W, 3] on the device."""
        self.count()  # by now it is known whether there was room
        self._color = color  # it has to stay
        self.selection = self._mapper.selection(color, self._keyframe, self._explained, self._T)
        self._count = int(download(self.selection.total)[0][0])

    def labels(self) -> MapLabels:
        """What the map shows of the objects, looked at on every `_LABEL_STRIDE`-th pixel and row; on the host."""
        self.count()
        ids, share, depth = self._found[:3]
        return MapLabels.from_grid(ids, share, depth, _LABEL_STRIDE)

    def view(self) -> SeenAgain | None:
        """What the map shows where the keyframe looks; None: nothing, or colours were not asked for."""
        if not (self.shows and self._with_colors):
            return None
        self.count()
        image, alpha, depth = self._found[-3:]
        return SeenAgain(image, alpha, depth, self._keyframe.depth_m()[_SOME], thinned=True)

    def count(self) -> int:
        """Of the Gaussians to insert."""
        while self._count is None:
            *self._found, total, short = download(*self._wanted, self.selection.total, self._mapper.room_was_short)
            if short[0] and self.shows and not self._with_room:
                self._start(with_room=True)
            else:
                self._count = int(total[0])
        return self._count
