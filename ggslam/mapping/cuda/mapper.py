# SPDX-License-Identifier: Apache-2.0
"""The mapper on an NVIDIA GPU: map, keyframes, losses, optimizers and identity learning are on the device, and the host
only starts work. It waits at a new keyframe (once, for the number of Gaussians to insert and for what the map shows of
objects; once more where it prunes), and when poses are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial

import numpy as np
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import ByKind
from ggslam.cuda.streams import SideStream
from ggslam.cuda.transfers import download, upload
from ggslam.mapping.between_frames import BetweenFrame
from ggslam.mapping.cuda.between_coder import BetweenCoder
from ggslam.mapping.cuda.between_view import CudaBetweenView
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.insertion import CudaInsertion, Selection
from ggslam.mapping.cuda.keyframe import CudaKeyframe
from ggslam.mapping.cuda.keyframe_look import Explained, KeyframeLook
from ggslam.mapping.cuda.look_memory import LookKind, LookMemory
from ggslam.mapping.cuda.shown_gaussians import mark_shown
from ggslam.mapping.cuda.training_mapper import TrainingMapper
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.labelling import Labeller
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.exposure import identity_exposure
from ggslam.rendering.types import LOW_PASS, RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse


class CudaMapper(TrainingMapper):
    """See `Mapper`. Sums in changing order: runs on a GPU differ in the last digits.

    Args:
        gaussians: the map, on the device.
        library: the kernels.
        context: threads of the CPU; None: all.
        Others: as in `Mapper`.
    """

    def __init__(
        self, gaussians: GaussianMap, settings: MapperSettings, library: CudaLibrary, seed: int = 0,
        identity: CudaIdentityLearner | None = None, context: NativeContext | None = None,
    ) -> None:  # fmt: skip
        super().__init__(gaussians, settings, library, seed, identity)
        self._insertion = CudaInsertion(self.device, library)
        self._anchors: list[np.ndarray] = []  # of the keyframes' exposures, as the device has them
        self.looks: ByKind[LookKind, LookMemory] = ByKind(lambda kind: LookMemory(self._rasterizer, kind))
        """Where new keyframes look at the map, a `LookMemory` for each `LookKind`."""
        self._coder = BetweenCoder()
        self._given_context = context
        self._shown_pixels = 0

    @property
    def image_bytes(self) -> int:
        """Memory on the device that images of keyframes take at present; part of it for good, see `ImageStore`."""
        return self._images.nbytes

    def beside_others(self, host_waits: bool = True) -> AbstractContextManager[object]:
        return SideStream(self.device, host_waits)

    def in_turn(self) -> AbstractContextManager[object]:
        return self._states.in_turn()

    def load_map(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        ours: list[Keyframe] = [CudaKeyframe(keyframe, self._states, self._images) for keyframe in keyframes]
        super().load_map(gaussians.to(self.device), ours)
        self._exposures.load(ours)
        self._exposures_changed()

    def latest_poses(self, count: int) -> np.ndarray:
        return inverse(self._states.read_poses()[-count:])

    # --- growth ------------------------------------------------------------------------------------------------------

    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> CudaKeyframe:
        self._exposures.add()
        keyframe = make_keyframe(len(self.keyframes), frame, T_world_camera)
        return CudaKeyframe(keyframe, self._states, self._images)

    def _insert(
        self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None,
        begin_others: Callable[[], None],
    ) -> None:  # fmt: skip
        begin_others()
        assert isinstance(keyframe, CudaKeyframe)
        labels = self.identity is not None and labeller is not None
        look = KeyframeLook(self, keyframe, T_world_camera, labels, self.settings.exposure.compensate)
        color = self._colors(keyframe, look.view())
        if color is not keyframe.color:
            look.select_again(upload(color, self.device))
        if self.identity is not None and labeller is not None:
            self._take_labels(keyframe, labeller(keyframe, look.labels if look.shows else None))
        births = None if self.identity is None else partial(self.identity.births, self.map, keyframe)
        new = self._insertion.insert(
            look.selection, look.count(), self.map, self.settings.insertion.opacity, keyframe.index, births
        )
        if self.identity is not None:
            self.identity.finish_births(self.map, new.rows)

    def _prune(self) -> None:
        self._insertion.rows.prune(self.map, self.settings.pruning)

    def _keep(self, stays: torch.Tensor) -> None:
        self._insertion.rows.keep(self.map, stays)

    @property
    def _densification(self) -> str:
        return "never"

    @contextmanager
    def _with_room(self, with_room: bool = True) -> Iterator[None]:
        """Renderings within wait for room for all that is in view."""
        self._rasterizer.waits = with_room
        try:
            yield
        finally:
            self._rasterizer.waits = False

    def render_keyframe(self, keyframe: CudaKeyframe, with_room: bool) -> RenderBuffers:
        """The map as a keyframe sees it, without identities; `with_room`: waits for room for all that is in view."""
        with self._with_room(with_room):
            return self._render(keyframe, features=False, close_below=self.settings.close_below)

    def render_view(self, camera: Camera, T_camera_world: np.ndarray) -> RenderBuffers:
        self._rasterizer.low_pass, self._rasterizer.close_below = LOW_PASS, 0.0
        with self.in_turn(), self._with_room():
            view = self._rasterizer.forward(self.map, camera, T_camera_world, features=False)
            return RenderBuffers(*map(torch.from_numpy, download(view.image, view.depth, view.alpha)))

    def _render_all(self, keyframe: Keyframe, grid: PixelGrid = ALL_PIXELS) -> RenderBuffers:
        with self._with_room():
            view = self._render(keyframe, features=False, grid=grid)
        self._shown_pixels = view.alpha.numel()
        return view

    def _fetch(self, *images: torch.Tensor) -> list[np.ndarray]:
        return download(*images)

    def _mark_shown(self, shown: torch.Tensor, least: float) -> None:
        mark_shown(self._rasterizer, self._shown_pixels, shown, least)

    @property
    def _context(self) -> NativeContext:
        if self._given_context is None:
            self._given_context = NativeContext()
        return self._given_context

    def _exposures_changed(self, gain: np.ndarray | None = None) -> None:
        if gain is not None:
            self._states.scale_gradients(gain)
        if not self._exposures.changed:
            return
        anchors = [optimizer.anchor for optimizer in self._exposures.optimizers]
        self._anchors += [identity_exposure() for _ in anchors[len(self._anchors) :]]
        for number, (anchor, sent) in enumerate(zip(anchors, self._anchors, strict=True)):
            if not np.array_equal(anchor, sent):
                self._states.write_anchor(number, anchor)
                self._anchors[number] = anchor.copy()

    def selection(
        self, color: torch.Tensor, keyframe: CudaKeyframe, explained: Explained, T_world_camera: np.ndarray,
        total: torch.Tensor,
    ) -> Selection:  # fmt: skip
        """What chooses, once it is started, the pixels of a keyframe, whose colours are those given, that the map does
        not explain; `explained` has to stay. Their number goes to `total`, int32 [1] on the device."""
        return self._insertion.selection(
            color, keyframe.device_images().depth, keyframe.depth_unit, *explained, keyframe.camera, T_world_camera,
            self._insertion_settings, total,
        )  # fmt: skip

    # --- frames between keyframes ------------------------------------------------------------------------------------

    def _add_between(self, frame: Frame, keyframe: int, T_keyframe_camera: np.ndarray) -> None:
        self._coder.add(frame, keyframe, T_keyframe_camera, self.between)

    def _find_beside(self, numbers: Sequence[int]) -> dict[int, list[int]]:
        self._coder.finish(self.between)
        return super()._find_beside(numbers)

    def _view_beside(self, frame: BetweenFrame, keyframe: Keyframe) -> Keyframe:
        assert isinstance(keyframe, CudaKeyframe)
        if frame.frame_index not in self._views:
            self._views[frame.frame_index] = CudaBetweenView(frame, keyframe, self._images, self.device)
        return self._views[frame.frame_index]

