# SPDX-License-Identifier: Apache-2.0
"""The mapper on an NVIDIA GPU: map, keyframes, losses, optimizers and identity learning are on the device, and the host
only starts work.

It waits at a new keyframe (once, for the number of Gaussians to insert and for what the map shows of objects), and when
poses are read. The losses it reports are those that have arrived without waiting.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.streams import Pace, SideStream
from ggslam.cuda.transfers import HostMirror, download, upload
from ggslam.mapping.between_frames import BetweenFrame
from ggslam.mapping.comparing_mapper import ComparingMapper
from ggslam.mapping.cuda.between_coder import BetweenCoder
from ggslam.mapping.cuda.between_view import CudaBetweenView
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.cuda.insertion import CudaInsertion, Selection
from ggslam.mapping.cuda.keyframe import CudaKeyframe, DeviceKeyframe, ImageStore
from ggslam.mapping.cuda.keyframe_look import KeyframeLook
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.cuda.losses import CudaImageLoss, CudaLossResult
from ggslam.mapping.cuda.shown_gaussians import mark_shown
from ggslam.mapping.cuda.training import CudaTraining, StepKind
from ggslam.mapping.cuda.usable_pixels import UsablePixels
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.extra_loss import new_faults, refuse_faults
from ggslam.mapping.identity import MaskOnGrid
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.keyframe_exposures import KeyframeExposures
from ggslam.mapping.labelling import Labeller
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.mapper import LossSums, MapperTuning
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.settings import MapperSettings
from ggslam.mapping.votes import vote_labels
from ggslam.native.loader import NativeContext
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.exposure import identity_exposure
from ggslam.rendering.types import LOW_PASS, RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse


@dataclass(frozen=True)
class CudaMaskOnGrid(MaskOnGrid):
    """A keyframe's mask at the pixels of a grid, on the device, too."""

    device_mask: torch.Tensor | None = None


class CudaMapper(ComparingMapper):
    """See `Mapper`. Sums in changing order: runs on a GPU differ in the last digits.

    Args:
        gaussians: the map, on the device.
        library: the kernels.
        context: threads of the CPU; None: all.
        Others: as in `Mapper`.
    """

    identity: CudaIdentityLearner | None
    _rasterizer: CudaRasterizer

    def __init__(
        self, gaussians: GaussianMap, settings: MapperSettings, library: CudaLibrary, seed: int = 0,
        identity: CudaIdentityLearner | None = None, context: NativeContext | None = None,
    ) -> None:  # fmt: skip
        super().__init__(gaussians, settings, seed, identity)
        self.device = library.whole_device(None)
        self._rasterizer = CudaRasterizer(self.device, library=library, waits=False)
        self._loss = CudaImageLoss(self.device, library, leaves_saturated=True)
        self._insertion = CudaInsertion(self.device, library)
        self._states = KeyframeStates(self.device, library)
        self._images = ImageStore(self.device)
        self._rasterizer.overflows = self._states.report[6:].view(torch.int64)
        self._report = HostMirror(self._states.report)
        self._pace = Pace(self.device)
        self._repeated = 0
        self._training = CudaTraining(self._rasterizer, self._loss, self._states)
        self._gathers = False  # steps that are started together
        self._exposures = KeyframeExposures(settings.exposure)
        self._anchors: list[np.ndarray] = []  # of the keyframes' exposures, as the device has them
        self._usable = UsablePixels(self.device)
        self._coder = BetweenCoder()
        self._views: dict[int, CudaBetweenView] = {}  # by frame
        self._given_context = context
        self._shown_pixels = 0
        self._faults = new_faults(self.device)
        self._newest_faults = HostMirror(self._faults)

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

    def beside_others(self, host_waits: bool = True) -> AbstractContextManager[object]:
        return SideStream(self.device, host_waits)

    def in_turn(self) -> AbstractContextManager[object]:
        return self._states.in_turn()

    def load_map(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        ours: list[Keyframe] = [CudaKeyframe(keyframe, self._states, self._images) for keyframe in keyframes]
        super().load_map(gaussians.to(self.device), ours)
        self._exposures.load(ours)
        self._exposures_changed()

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
        if self.extra_loss is not None:
            self._newest_faults.send()
            refuse_faults(self._newest_faults.newest())
        self._pace.piece_ends()

    def refine(self, iterations: int, progress: Callable[[int, int], None] | None = None, begin: int = 0) -> None:
        self._repeated = int(download(self._rasterizer.overflows)[0][0])
        super().refine(iterations, progress, begin)
        if self.extra_loss is not None:
            refuse_faults(download(self._faults)[0])
        self._views = {}
        self._report.send()

    def _repeat_missed(self, numbers: Sequence[int], averages: bool) -> None:
        for _ in range(self._count_missed(int(download(self._rasterizer.overflows)[0][0]))):
            falling = self.settings.refine_decay
            self.iterate(self._draw(numbers), 1.0 if averages else falling, averages)
            if averages:
                self._mean.add(self.map)

    @property
    def _loss_faults(self) -> torch.Tensor | None:
        return self._faults

    def _count_missed(self, overflows: int | None = None) -> int:
        """Iterations that did nothing, as far as is known, because their rendering found no room: to be made again."""
        overflows = int(self._report.newest()[6:].view(np.int64)[0]) if overflows is None else overflows
        missed = max(0, overflows - self._repeated)
        self._repeated += missed
        return missed

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
        new = self._insertion.build(look.selection, look.count())
        opacity = self.settings.insertion.opacity
        logit = torch.full_like(new.means[:, 0], float(np.log(opacity / (1 - opacity))))
        rows = self.map.insert(
            new.means, new.quaternions, new.log_scales, logit, new.rgb, birth_keyframe=keyframe.index
        )
        if self.identity is not None:
            self.identity.begin(self.map, rows, self.identity.labels_at(keyframe, new.pixels))

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

    @property
    def room_was_short(self) -> torch.Tensor:
        """int32 [1] on the device: 1 if the last rendering lacks a part of what is in view."""
        return self._rasterizer.last_overflowed

    def selection(
        self, color: torch.Tensor, keyframe: CudaKeyframe, explained: tuple[torch.Tensor | None, torch.Tensor | None],
        T_world_camera: np.ndarray,
    ) -> Selection:  # fmt: skip
        """Starts to choose the pixels of a keyframe, whose colours are those given, that the map does not explain,
        rendered as alpha and depth of `explained`, which has to stay."""
        return self._insertion.select(
            color, keyframe.device_images().depth, keyframe.depth_unit, *explained, keyframe.camera, T_world_camera,
            self._insertion_settings,
        )  # fmt: skip

    def find_explained(
        self, keyframe: CudaKeyframe, alpha: torch.Tensor | None, depth: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """What the map shows from a keyframe, alpha and depth [H, W]; where images show nothing there is nothing to
        explain."""
        valid = self._valid_on_device(keyframe)
        if valid is None:
            return alpha, depth
        if alpha is None:
            return (~valid).float(), torch.zeros(valid.shape, device=self.device)
        return torch.where(valid, alpha, 1.0), depth

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

    @property
    def _steps_wholly(self) -> bool:
        return not self._needs_all_pixels  # with a loss of whole pictures there is one step, as on the CPU

    def last_iterations(self, before: int) -> int:
        return round(MapperTuning.all_pixels_end_share * before) if self.is_live else super().last_iterations(before)

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

    def _masks_on(self, keyframe: Keyframe, grid: PixelGrid) -> Keyframe | MaskOnGrid:
        mask = None if grid.is_whole or not isinstance(keyframe, CudaKeyframe) else keyframe.device_mask
        if mask is None:
            return super()._masks_on(keyframe, grid)
        on_grid: torch.Tensor = grid.of(mask.view(torch.int16))  # type: ignore[assignment,arg-type]
        return CudaMaskOnGrid(keyframe.index, None, on_grid.contiguous().view(torch.uint16))

    def _render(
        self, keyframe: Keyframe, features: bool, grid: PixelGrid = ALL_PIXELS, close_below: float = 0.0
    ) -> RenderBuffers:
        assert isinstance(keyframe, DeviceKeyframe)
        camera = keyframe.camera if grid.is_whole else grid.camera(keyframe.camera)
        self._rasterizer.low_pass, self._rasterizer.close_below = grid.low_pass(LOW_PASS), close_below
        return self._rasterizer.forward(self.map, camera, keyframe.device_pose, features=features)

    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = ALL_PIXELS) -> CudaLossResult:
        assert isinstance(keyframe, DeviceKeyframe)
        images, exposure = keyframe.device_images(grid), None
        if self._exposures.is_exposed(keyframe):
            exposure = self._states.exposure(keyframe.index)
        shown = self._comparable_on_device(keyframe, grid)
        target = LossTarget(images.color, images.depth, keyframe.depth_unit, exposure, shown)
        return self._loss.evaluate(view, target, self._loss_settings(keyframe))

    def _valid_on_device(self, keyframe: Keyframe, grid: PixelGrid = ALL_PIXELS) -> torch.Tensor | None:
        """`valid_of` at a grid's pixels."""
        sources = (self._valid.get(keyframe.camera_number), keyframe.moving)
        return self._usable.valid(keyframe, sources, lambda: self.valid_of(keyframe), grid)

    def _comparable_on_device(self, keyframe: Keyframe, grid: PixelGrid) -> torch.Tensor | None:
        """`_comparable` at a grid's pixels, but for saturated ones, which the loss leaves out."""
        if self._exposures.blind[keyframe.index]:
            return self._usable.nowhere(keyframe, grid)
        return self._valid_on_device(keyframe, grid)

    def _step(
        self, keyframe: Keyframe, factors: tuple[float, float], grid: PixelGrid, learns: bool, settles: bool = False
    ) -> None:
        training, lessons = self._training, self.identity.lessons if learns and self.identity is not None else None
        plain = grid.is_whole and self.extra_loss is None and (lessons is None or lessons.takes(self.map, keyframe))
        if not plain or not training.is_ready or not isinstance(keyframe, CudaKeyframe):
            self._start_steps()
            super()._step(keyframe, factors, grid, learns, settles)
            return
        exposed = self._exposures.is_exposed(keyframe)
        filters = grid.low_pass(LOW_PASS), self.settings.close_below
        kind = StepKind(keyframe.camera, self.settings, self._loss_settings(keyframe), exposed, *filters)
        if not training.fits(kind):
            self._start_steps()
        images, shown = keyframe.device_images(), self._comparable_on_device(keyframe, grid)
        rate_factor, pose_factor = factors
        optimizer, pose_rate = self._optimizer(rate_factor, settles), self._pose_rate_of(keyframe, grid, pose_factor)
        training.add(kind, keyframe.index, images, keyframe.depth_unit, shown, optimizer, pose_rate)
        if lessons is not None:
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
        steps_exposure = keyframe.index > 0 and self._exposures.is_exposed(keyframe)
        self._states.step(
            keyframe.index, twist, loss.results, self._rasterizer.last_overflowed, pose_rate,
            self.settings.exposure if steps_exposure else None,
        )  # fmt: skip
