# SPDX-License-Identifier: Apache-2.0
"""What a new keyframe sees of a map on a device."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from ggslam.cuda.memory import ByKind
from ggslam.cuda.transfers import download
from ggslam.mapping.cuda.insertion import Selection
from ggslam.mapping.cuda.keyframe import CudaKeyframe
from ggslam.mapping.cuda.look_memory import LABEL_STRIDE, LookKind, LookMemory
from ggslam.mapping.labelling import MapLabels
from ggslam.rendering.exposure import ExposureTuning, Seen, SeenAgain
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.gaussian_map import GaussianMap

Explained = tuple[torch.Tensor | None, torch.Tensor | None]
"""Alpha and depth in metres of what a map explains, float32 [H, W]; None: it explains nothing."""


class LookedAt(Protocol):
    """What of a `CudaMapper` a look needs; see there."""

    map: GaussianMap
    looks: ByKind[LookKind, LookMemory]

    def render_keyframe(self, keyframe: CudaKeyframe, with_room: bool) -> RenderBuffers: ...

    def valid_on_device(self, keyframe: CudaKeyframe) -> torch.Tensor | None: ...

    def selection(
        self, color: torch.Tensor, keyframe: CudaKeyframe, explained: Explained, T_world_camera: np.ndarray,
        total: torch.Tensor,
    ) -> Selection: ...  # fmt: skip


_SOME = (..., slice(None, None, ExposureTuning.stride), slice(None, None, ExposureTuning.stride))


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
        size = (keyframe.camera.height, keyframe.camera.width)
        self._memory = mapper.looks.of(LookKind(size, with_labels, with_colors))
        self.shows = mapper.map.count > 0
        """Whether there is a map to look at."""
        self._count: int | None = None
        self._start(with_room=False)

    def _start(self, with_room: bool) -> None:
        mapper, keyframe, self._with_room = self._mapper, self._keyframe, with_room
        valid, images = mapper.valid_on_device(keyframe), keyframe.device_images()
        if not self.shows:
            self._explained: Explained = _nothing_explained(valid)
            self._select(images.color).start()
            return
        self._view, self._explained = mapper.render_keyframe(keyframe, with_room), self._memory.explained
        chosen = self._select(images.color)
        self._memory.see(mapper.map, self._view, images, keyframe.depth_unit, valid, chosen)

    def _select(self, color: torch.Tensor) -> Selection:
        self.selection = self._mapper.selection(color, self._keyframe, self._explained, self._T, self._memory.total)
        return self.selection

    def select_again(self, color: torch.Tensor) -> None:
        """Chooses pixels of the keyframe with other colours, uint8 [H, W, 3] on the device."""
        self.count()  # by now it is known whether there was room
        self._color = color  # it has to stay
        self._select(color).start()
        self._count = int(download(self.selection.total)[0][0])

    def labels(self) -> MapLabels:
        """What the map shows of the objects, looked at on every `LABEL_STRIDE`-th pixel and row; on the host."""
        self.count()
        ids, share, depth = self._memory.labels()
        return MapLabels.from_grid(ids, share, depth.copy(), LABEL_STRIDE)

    def view(self) -> Seen | None:
        """What the map shows where the keyframe looks; None: nothing, or colours were not asked for. Good until the
        next rendering."""
        return self if self.shows and self._memory.kind.with_colors else None

    def measure(self, color: np.ndarray) -> np.ndarray | None:
        """The keyframe's exposure, see `Seen`."""
        self.count()
        return self._memory.exposure()

    def pictures(self) -> SeenAgain:
        """See `Seen`. Waits."""
        self.count()
        shown = (self._view.image, self._view.alpha, self._memory.explained[1])
        image, alpha, rendered_depth = download(*(picture[_SOME].contiguous() for picture in shown))
        measured = self._keyframe.depth_m(self._keyframe.depth[_SOME])
        return SeenAgain(image, alpha, rendered_depth, measured, thinned=True)

    def count(self) -> int:
        """Of the Gaussians to insert."""
        while self._count is None:
            total, was_short = self._memory.fetch()
            if was_short and self.shows and not self._with_room:
                self._start(with_room=True)
            else:
                self._count = total
        return self._count


def _nothing_explained(valid: torch.Tensor | None) -> Explained:
    """What is explained without a map: where a keyframe shows nothing, bool [H, W] on a device being False, there is
    nothing to explain."""
    if valid is None:
        return None, None
    return (~valid).float(), torch.zeros(valid.shape, device=valid.device)
