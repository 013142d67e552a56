# SPDX-License-Identifier: Apache-2.0
"""The mapper on an NVIDIA GPU: map, keyframes, losses, optimizers and identity learning are on the device, and the host
only starts work.

It waits at a new keyframe (once, for the number of Gaussians to insert and for what the map shows of objects), and when
poses are read. The losses it reports are those that have arrived without waiting.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.streams import Pace, SideStream
from ggslam.cuda.transfers import HostMirror, download
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.insertion import CudaInsertion, Selection
from ggslam.mapping.cuda.keyframe import CudaKeyframe, CudaKeyframeImages, ImageStore
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.losses import CudaImageLoss, CudaLossResult
from ggslam.mapping.cuda.training import CudaTraining, StepKind
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.labelling import Labeller, MapLabels
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.mapper import LossSums, Mapper, MapperTuning
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.settings import MapperSettings
from ggslam.mapping.votes import vote_labels
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse


class CudaMapper(Mapper):
    """See `Mapper`. Sums in changing order: runs on a GPU differ in the last digits.

    Args:
        gaussians: the map, on the device.
        library: the kernels.
        Others: as in `Mapper`.
    """

    identity: CudaIdentityLearner | None
    _rasterizer: CudaRasterizer

    def __init__(
        self, gaussians: GaussianMap, settings: MapperSettings, library: CudaLibrary, seed: int = 0,
        identity: CudaIdentityLearner | None = None,
    ) -> None:  # fmt: skip
        super().__init__(gaussians, settings, seed, identity)
        self.device = library.whole_device(None)
        self._rasterizer = CudaRasterizer(self.device, library=library, waits=False)
        self._loss = CudaImageLoss(self.device, library)
        self._insertion = CudaInsertion(self.device, library)
        self._states = KeyframeStates(self.device, library)
        self._images = ImageStore(self.device)
        self._rasterizer.overflows = self._states.report[6:].view(torch.int64)
        self._report = HostMirror(self._states.report)
        self._pace = Pace(self.device)
        self._repeated = 0
        self._training = CudaTraining(self._rasterizer, self._loss, self._states)
        self._gathers = False  # steps that are started together

    @property
    def losses(self) -> LossSums:
        return LossSums(*self._report.newest()[:4].tolist())

    @property
    def last_psnr(self) -> float:
        return float(self._report.newest()[4])

    @property
    def image_bytes(self) -> int:
        """Memory on the device that images of keyframes take at present; part of it for good, see `ImageStore`."""
        return self._images.nbytes

    def beside_others(self) -> AbstractContextManager[object]:
        return SideStream(self.device)

    def in_turn(self) -> AbstractContextManager[object]:
        return self._states.in_turn()

    def load_map(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        ours: list[Keyframe] = [CudaKeyframe(keyframe, self._states, self._images) for keyframe in keyframes]
        super().load_map(gaussians.to(self.device), ours)

    def move_keyframes(self, T_new_old: np.ndarray) -> None:
        old = self._states.read_poses()
        for keyframe, T, pose in zip(self.keyframes, T_new_old, old, strict=True):
            keyframe.T_camera_world = inverse(T @ inverse(pose))
        move_with_keyframes(self.map, T_new_old)

    def run(self, iterations: int) -> None:
        self._gathers = True
        try:
            super().run(iterations + self._count_missed())
        finally:
            self._gathers = False
            self._start_steps()
        self._report.send()
        self._pace.piece_ends()

    def refine(self, iterations: int, progress: Callable[[int, int], None] | None = None, begin: int = 0) -> None:
        self._repeated = int(download(self._rasterizer.overflows)[0][0])
        super().refine(iterations, progress, begin)
        numbers = self._trainable()
        for _ in range(self._count_missed(int(download(self._rasterizer.overflows)[0][0]))):
            self.iterate(self._draw(numbers), self.settings.refine_decay)
        self._report.send()

    def drop_hidden(self) -> None:
        """Nothing: it has not been tried on a GPU."""

    @property
    def _averaged_share(self) -> float:
        return 0.0  # the mean has not been tried on a GPU

    def _count_missed(self, overflows: int | None = None) -> int:
        """Iterations that did nothing, as far as is known, because their rendering found no room: to be made again."""
        overflows = int(self._report.newest()[6:].view(np.int64)[0]) if overflows is None else overflows
        missed = max(0, overflows - self._repeated)
        self._repeated += missed
        return missed

    # --- growth ------------------------------------------------------------------------------------------------------

    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> CudaKeyframe:
        keyframe = make_keyframe(len(self.keyframes), frame, T_world_camera)
        return CudaKeyframe(keyframe, self._states, self._images)

    def _insert(
        self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None,
        begin_others: Callable[[], None],
    ) -> None:  # fmt: skip
        begin_others()
        assert isinstance(keyframe, CudaKeyframe)
        look = _Look(self, keyframe, T_world_camera)
        if self.identity is not None and labeller is not None:
            self._take_labels(keyframe, labeller(keyframe, look.labels if self.map.count else None))
        new = self._insertion.build(look.selection, look.count())
        opacity = self.settings.insertion.opacity
        logit = torch.full_like(new.means[:, 0], float(np.log(opacity / (1 - opacity))))
        rows = self.map.insert(
            new.means, new.quaternions, new.log_scales, logit, new.rgb, birth_keyframe=keyframe.index
        )
        if self.identity is not None:
            self.identity.begin(self.map, rows, self.identity.labels_at(keyframe, new.pixels))

    def render_keyframe(self, keyframe: CudaKeyframe, with_room: bool) -> RenderBuffers:
        """The map as a keyframe sees it, without identities; `with_room`: waits for room for all that is in view."""
        self._rasterizer.waits = with_room
        try:
            return self._render(keyframe, features=False)
        finally:
            self._rasterizer.waits = False

    @property
    def room_was_short(self) -> torch.Tensor:
        """int32 [1] on the device: 1 if the last rendering lacks a part of what is in view."""
        return self._rasterizer.last_overflowed

    def selection(
        self, images: CudaKeyframeImages, keyframe: CudaKeyframe, alpha: torch.Tensor | None,
        depth: torch.Tensor | None, T_world_camera: np.ndarray,
    ) -> Selection:  # fmt: skip
        """Starts to choose the pixels of a keyframe that the map, rendered as `alpha` and `depth`, does not explain."""
        return self._insertion.select(
            images.color, images.depth, keyframe.depth_unit, alpha, depth, keyframe.camera, T_world_camera,
            self.settings.insertion,
        )  # fmt: skip

    def labels_on_grid(self, alpha: torch.Tensor, stride: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Object that the last rendering shows on every `stride`-th pixel and row, int32 [h, w], and its share."""
        height, width = alpha.shape
        pixels = torch.arange(height * width, dtype=torch.int32, device=self.device).view(height, width)
        grid = pixels[::stride, ::stride]
        ids, share = self._rasterizer.pixel_terms(grid.reshape(-1)).labels(vote_labels(self.map))
        return ids.view(grid.shape), share.view(grid.shape) * (alpha[::stride, ::stride] > 0.5)

    # --- optimisation ------------------------------------------------------------------------------------------------

    def _choose_grid(self, keyframe: Keyframe) -> PixelGrid:
        return ALL_PIXELS

    def _choose_size(self, keyframe: Keyframe, done: float) -> PixelGrid:
        return ALL_PIXELS

    def last_iterations(self, before: int) -> int:
        return round(MapperTuning.all_pixels_end_share * before)

    def _render(
        self, keyframe: Keyframe, features: bool, grid: PixelGrid = ALL_PIXELS, close_below: float = 0.0
    ) -> RenderBuffers:
        return self._rasterizer.forward(self.map, keyframe.camera, self._states.pose(keyframe.index), features=features)

    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = ALL_PIXELS) -> CudaLossResult:
        assert isinstance(keyframe, CudaKeyframe)
        images, s = keyframe.device_images, self.settings
        exposure = self._states.exposure(keyframe.index) if s.exposure.enabled else None
        shown = self._images.usable_of(keyframe, self._valid.get(keyframe.camera_number), self.valid_of)
        target = LossTarget(images.color, images.depth, keyframe.depth_unit, exposure, shown)
        return self._loss.evaluate(view, target, s.loss)

    def _step(
        self, keyframe: Keyframe, factors: tuple[float, float], grid: PixelGrid, learns: bool, settles: bool = False
    ) -> None:
        training, lessons = self._training, self.identity.lessons if learns and self.identity is not None else None
        plain = grid.is_whole and self.extra_loss is None and (lessons is None or lessons.takes(self.map, keyframe))
        if not plain or not training.is_ready:
            self._start_steps()
            super()._step(keyframe, factors, grid, learns, settles)
            return
        kind = StepKind(keyframe.camera, self.settings, self.settings.loss, self.settings.exposure.enabled)
        if not training.fits(kind):
            self._start_steps()
        images, valid, shown = self._images.of(keyframe), self._valid.get(keyframe.camera_number), None
        if valid is not None or keyframe.moving is not None:
            shown = self._images.usable_of(keyframe, valid, self.valid_of)
        rate_factor, pose_factor = factors
        optimizer = self._standard_adam(settles) if rate_factor == 1 else self._adam(rate_factor, settles)
        fixed = keyframe.index == self._all_numbers[0] or (keyframe.instant is not None and self.is_world(keyframe))
        pose_rate = 0.0 if fixed else pose_factor * self._pose_rate
        training.add(kind, keyframe.index, images, keyframe.depth_unit, shown, optimizer, pose_rate)
        if lessons is not None:
            assert isinstance(keyframe, CudaKeyframe)
            training.teach_last(lessons, self.map, keyframe)
        self.times.steps += 1
        keyframe.iterations += 1

    def _start_steps(self) -> None:
        """Starts the steps that were gathered."""
        if self._training.count:
            start = time.perf_counter()
            self._training.start(self.map)
            self.times.backward += time.perf_counter() - start

    def _count_iteration(self) -> None:
        super()._count_iteration()
        if not self._gathers:
            self._start_steps()

    def _bound_values(self) -> None:
        if self._training.count:
            self._training.bound_last()
        else:
            super()._bound_values()

    def _finish_step(self, keyframe: Keyframe, twist: torch.Tensor, loss: CudaLossResult, pose_rate: float) -> None:
        exposure = self.settings.exposure
        self._states.step(
            keyframe.index, twist, loss.results, self._rasterizer.last_overflowed, pose_rate,
            exposure if exposure.enabled and keyframe.index > 0 else None,
        )  # fmt: skip


class _Look:
    """At the map from a new keyframe, and at what it lacks there. Everything is started at once, and the host waits
    once for what it has to know. If the rendering found no room for a part of the map, it is all done again with room.

    Args:
        mapper: whose map it is.
        keyframe: the new one.
        T_world_camera: [4, 4], its pose.
    """

    def __init__(self, mapper: CudaMapper, keyframe: CudaKeyframe, T_world_camera: np.ndarray) -> None:
        self._mapper, self._keyframe, self._T = mapper, keyframe, T_world_camera
        self._count: int | None = None
        self._start(with_room=False)

    def _start(self, with_room: bool) -> None:
        mapper, keyframe, self._with_room = self._mapper, self._keyframe, with_room
        self._alpha = self._depth = None
        if mapper.map.count:
            view = mapper.render_keyframe(keyframe, with_room)
            self._alpha, self._depth = view.alpha, view.expected_depth
        images = keyframe.device_images
        self.selection = mapper.selection(images, keyframe, self._alpha, self._depth, self._T)

    def labels(self, stride: int = 2) -> MapLabels:
        """What the map shows of the objects, looked at on every `stride`-th pixel and row; on the host."""
        assert self._alpha is not None and self._depth is not None
        ids, share = self._mapper.labels_on_grid(self._alpha, stride)
        found = self._fetch(ids, share, self._depth)
        if found is None:
            return self.labels(stride)
        return MapLabels.from_grid(found[0], found[1], found[2], stride)

    def count(self) -> int:
        """Of the Gaussians to insert."""
        while self._count is None:
            self._fetch()
        return self._count

    def _fetch(self, *tensors: torch.Tensor) -> list[np.ndarray] | None:
        """These on the host, and the count known; None if all has to be done again, and was started."""
        *found, total, short = download(*tensors, self.selection.total, self._mapper.room_was_short)
        if short[0] and self._alpha is not None and not self._with_room:
            self._start(with_room=True)
            return None
        self._count = int(total[0])
        return found
