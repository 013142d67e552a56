# SPDX-License-Identifier: Apache-2.0
"""The mapper: inserts Gaussians for new keyframes and optimises the map against the keyframes' images."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from ggslam.mapping.between_frames import BetweenFrame, BetweenTuning, code_frame, end_share, frame_of_turn
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.duplicates import remove_duplicates
from ggslam.mapping.extra_loss import ExtraLoss, add_extra_loss, uses_features
from ggslam.mapping.identity import IdentityLearner, MaskOnGrid, ids_of
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.labelling import KeyframeLabels, Labeller
from ggslam.mapping.losses import LossGradients
from ggslam.mapping.mean_map import MeanMap
from ggslam.mapping.other_sizes import picture_of_turn
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid, grid_of_turn
from ggslam.mapping.pruning import is_look_due, prune
from ggslam.mapping.residency import Residency
from ggslam.mapping.sampling import last_visits, make_sampler
from ggslam.mapping.settings import MapperSettings
from ggslam.mapping.votes import vote_labels
from ggslam.rendering.adam import ADAM_GROUPS, AdamSettings
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, orthonormalize
from ggslam.system.array_forms import Mask
from ggslam.system.savable import savable
from ggslam.system.spent import part
from ggslam.system.tuning import Tuning


class MapperTuning(Tuning):
    """Training of the map."""

    bound_every = 4
    """Iterations between two clampings of sizes and colours. Unclamped colours overshoot by up to 0.4, which costs up
    to 0.4 dB once they are cut to bytes."""
    noisy_steps = 2
    """Steps per iteration of the final refinement where depth is noisy, each on a quarter of the pixels."""
    end_share = 1.3
    """Iterations of the final refinement per iteration before it."""
    live_end_share = 0.4
    """The same in real time."""
    all_pixels_end_share = 0.7
    """The same where the iterations before it used all pixels."""
    min_visits = 10
    """Fewest iterations of the final refinement per keyframe of the recording."""
    average_every = 4
    """Most steps between two maps that enter the average."""
    averaged_maps = 8
    """Fewest maps that enter the average, if there are as many steps."""
    settling_from = 0.5
    """First share of a final refinement that averages in which steps are as before: Gaussians find their places for all
    sizes of pictures."""
    settling_means = 0.4
    """Steps of means in its later part, as a share of those before. Longer ones shake small Gaussians about the edges
    that they draw, by up to a third of a pixel at 640x480."""
    settling_scales = 0.6
    """The same of standard deviations."""
    final_identity_decay = 0.2
    """Share of their length to which the last identity steps shrink."""
    final_steps_per_view = 4
    """Last identity steps made on one rendering. Rendering takes as long as a step."""


_FALLING = ("means", "quaternions", "sh_dc")
"""Groups whose rates fall with the root of a Gaussian's updates."""
_YOUNG = ("log_scales", "opacity_logits", "sh_rest")
"""Groups whose first steps are longer."""


@savable()
@dataclass
class MapperTimes:
    """Seconds spent so far in each part, and how often."""

    insertion: float = 0.0
    forward: float = 0.0
    loss: float = 0.0
    backward: float = 0.0
    identity: float = 0.0
    identity_finish: float = 0.0
    iterations: int = 0
    steps: int = 0
    keyframes: int = 0

    @property
    def iteration_ms(self) -> float:
        """Mean milliseconds of one iteration."""
        return 1e3 * (self.forward + self.loss + self.backward + self.identity) / max(1, self.iterations)


@savable()
@dataclass
class LossSums:
    """Sums over all steps so far of the terms of the loss, see `LossValues`: the loss itself, colour (L1), SSIM
    and depth (metres)."""

    total: float = 0.0
    color: float = 0.0
    ssim: float = 0.0
    depth: float = 0.0


class TrainingRasterizer(Protocol):
    """The part of a rasterizer that training needs: a backward pass that includes the optimizer step."""

    def backward_step(
        self, map: GaussianMap, grad_image: torch.Tensor | None, grad_depth: torch.Tensor | None = None,
        grad_alpha: torch.Tensor | None = None, grad_features: torch.Tensor | None = None, *, optimizer: AdamSettings,
        detach_features: bool = False,
    ) -> Any:  # fmt: skip
        """See `CpuRasterizer.backward_step`; the result has the pose's gradient as `twist`."""

    def backward(self, grad_image: torch.Tensor | None) -> Any:
        """See `CpuRasterizer.backward`; the result has the gradient of the colours as `sh`."""


class _Stopwatch:
    """Seconds from lap to lap."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        seconds, self._last = now - self._last, now
        return seconds


class Mapper(ABC):
    """Holds the map and its keyframes. The schedule and the order of the steps are here; `CpuMapper` and `CudaMapper`
    say how each step is computed.

    Args:
        gaussians: the map; empty or loaded.
        settings: see `MapperSettings`.
        seed: of the draw of keyframes.
        identity: learns objects from the keyframes' masks, into the map's feature channels; None: no objects.
    """

    keyframes: list[Keyframe]
    left_out: set[int]
    between: list[BetweenFrame]
    unfit: set[int]
    _valid: dict[int, Mask | None]

    def __init__(
        self, gaussians: GaussianMap, settings: MapperSettings, seed: int = 0, identity: IdentityLearner | None = None
    ) -> None:
        self.map = gaussians
        self.settings = settings
        self.identity: IdentityLearner | None = identity
        self.keyframes = []
        self.times = MapperTimes()
        self.depth_sigma = 0.004
        """Standard deviation of the depth camera at the scene's median depth, metres; set it when it is known."""
        self.depth_noise_px = 0.0
        """The same as it moves a point in the image, pixels; see `MapperSettings.sparse_noise`."""
        self.has_soft_outlines = False
        """Whether the depth camera smooths outlines: depth beside them is missing then."""
        self.pixel_m = 0.0
        """Metres that a pixel of the images is wide at the scene's median depth; 0: not known."""
        self.is_live = False
        """Whether frames come at a camera's pace: keyframes do not wait then while one looks for what surfaces hide."""
        self.fits_view_colors = False
        """Whether the final refinement ends with colours that depend on the view; see `mapping.view_colors`."""
        self.residency: Residency | None = None
        """Keeps a part of the map on disk; None: all of it is in memory."""
        self.left_out = set()
        """Numbers of the keyframes that neither train the map nor have Gaussians in it any more."""
        self.between = []
        """Frames between keyframes for the final refinement."""
        self.unfit = set()
        """Places in `between` of those that it does not train on after all."""
        self._beside: dict[int, list[BetweenFrame]] = {}
        self._valid = {}
        self.extra_loss: ExtraLoss | None = None
        """A loss of the user's own, added to the mapper's."""
        self._rasterizer: TrainingRasterizer
        self._mean = MeanMap()
        self._adam_of_pixel: tuple[float, bool, AdamSettings] | None = None
        self._sampler = make_sampler(settings.order, seed)

    @property
    @abstractmethod
    def losses(self) -> LossSums:
        """Sums over the steps so far."""

    @property
    @abstractmethod
    def last_psnr(self) -> float:
        """Of the last iteration's view before its step, dB; NaN before the first."""

    def vote_labels(self) -> np.ndarray:
        """Object with the most votes of each Gaussian, uint16 [N], 0 where there are none. Waits for the device."""
        return vote_labels(self.map).cpu().numpy().astype(np.uint16)

    def beside_others(self, host_waits: bool = True) -> AbstractContextManager[object]:
        """Context for work on the device beside the mapper's, which goes first. May be entered repeatedly. Inside, use
        of the mapper what is `in_turn` alone.

        Args:
            host_waits: whether the host waits for it at each end, as it has to if another thread uses the mapper
                meanwhile. Else the mapper's work after it waits.
        """
        return nullcontext()

    def in_turn(self) -> AbstractContextManager[object]:
        """Context in which this thread's work on the device takes turns with the mapper's: it reads a consistent map
        even while the mapper works in another thread."""
        return nullcontext()

    # --- growth ------------------------------------------------------------------------------------------------------

    def add_keyframe(
        self,
        frame: Frame,
        T_world_camera: np.ndarray,
        labeller: Labeller | None = None,
        begin_others: Callable[[], None] = lambda: None,
    ) -> Keyframe:
        """Makes a keyframe of `frame` seen from `T_world_camera` [4, 4] and inserts what the map lacks there.

        Args:
            labeller: tells the keyframe's object mask, if objects are learned.
            begin_others: starts what other threads do meanwhile; called as soon as this needs one thread only.
        """
        start = time.perf_counter()
        self.note_valid(frame)
        keyframe = self._new_keyframe(frame, T_world_camera)
        self._insert(keyframe, T_world_camera, labeller, begin_others)
        self.keyframes.append(keyframe)
        self._sampler.arrive(self.keyframes)
        self.use_typical_exposure()
        if len(self.keyframes) % self.settings.pruning.every_keyframes == 0:
            self._densify()
            if self.settings.pruning.enabled:
                self._prune()
        if self._is_noisy and not self.is_live and is_look_due(len(self.keyframes)):
            self.drop_hidden()
        self.times.insertion += time.perf_counter() - start
        self.times.keyframes += 1
        return keyframe

    @property
    def keeps_between(self) -> bool:
        """Whether the final refinement trains on frames between keyframes, if there are any. Where depth is noisy they
        are not where they are thought to be; with the whole map in memory."""
        return False

    def keep_between(self, frame: Frame, keyframe: int, T_keyframe_camera: np.ndarray) -> None:
        """Where `keeps_between`: keeps a frame that is no keyframe, while there is memory for it, if it can be compared
        with the map; arguments as the attributes of `BetweenFrame`."""
        kept_bytes = sum(kept.color.nbytes for kept in self.between)
        if self._is_plain(self.keyframes[keyframe]) and kept_bytes < BetweenTuning.kept_bytes:
            self._add_between(frame, keyframe, T_keyframe_camera)

    def _add_between(self, frame: Frame, keyframe: int, T_keyframe_camera: np.ndarray) -> None:
        """A frame joins `between`."""
        self.between.append(code_frame(frame, keyframe, T_keyframe_camera))

    def judge_between(self) -> None:  # noqa: B027
        """Before the final refinement: finds which frames between keyframes are not of the map's exposure, or much less
        sharp than their keyframes."""

    def _find_beside(self, numbers: Sequence[int]) -> dict[int, list[int]]:
        """By the number of a keyframe the places in `between` of the frames that can be compared with the map."""
        found: dict[int, list[int]] = {}
        for place, frame in enumerate(self.between if self.keeps_between else ()):
            if frame.keyframe in numbers and self._is_plain(self.keyframes[frame.keyframe]):
                found.setdefault(frame.keyframe, []).append(place)
        return found

    def _trained_beside(self, numbers: Sequence[int]) -> dict[int, list[BetweenFrame]]:
        """By the number of a keyframe the frames that are trained with it; none: it is not there."""
        fit = {
            number: [self.between[place] for place in places if place not in self.unfit]
            for number, places in self._find_beside(numbers).items()
        }
        return {number: frames for number, frames in fit.items() if frames}

    def _is_plain(self, keyframe: Keyframe) -> bool:
        """Whether frames after a keyframe can be compared with the map as they are."""
        return keyframe.frame_index != FROM_EARLIER_RUN and keyframe.moving is None

    def load_map(self, gaussians: GaussianMap, keyframes: list[Keyframe]) -> None:
        """Goes on with a map made before. Keyframes without images keep their Gaussians but are never trained on."""
        self.map, self.keyframes = gaussians, keyframes

    def use_typical_exposure(self, at_end: bool = False) -> None:  # noqa: B027
        """If exposures are compensated and most keyframes are brighter or darker than the map, the map gets the
        exposure that is typical of them.

        Args:
            at_end: before the final refinement: exposures are measured again first, and every difference counts.
        """

    def latest_poses(self, count: int) -> np.ndarray:
        """T_world_camera of the latest keyframes, so many or all there are, float64 [n, 4, 4], as refined so far."""
        return inverse(np.array([keyframe.T_camera_world for keyframe in self.keyframes[-count:]]).reshape(-1, 4, 4))

    def move_keyframes(self, T_new_old: np.ndarray) -> None:
        """Moves keyframes, and with each the Gaussians that it inserted.

        Args:
            T_new_old: [K, 4, 4], for each keyframe what moves the world about it.

        Raises:
            ValueError: there are not as many keyframes.
        """
        if len(T_new_old) != len(self.keyframes):
            raise ValueError(f"T_new_old: expected [{len(self.keyframes)}, 4, 4], found {list(np.shape(T_new_old))}")
        poses = self.latest_poses(len(self.keyframes))
        move_with_keyframes(self.map, T_new_old)  # first: where memory is short it is this that fails
        for keyframe, T, T_world_camera in zip(self.keyframes, T_new_old, poses, strict=True):
            keyframe.T_camera_world = inverse(T @ T_world_camera)

    def leave_out(self, numbers: set[int]) -> None:
        """Takes the Gaussians of some keyframes out of the map, which is all in memory, and trains on these no more."""
        self.left_out |= numbers
        gone = torch.tensor(sorted(self.left_out), dtype=self.map.birth_keyframe.dtype, device=self.map.device)
        self._keep(~torch.isin(self.map.birth_keyframe, gone))

    def retrain_loop_ends(self, kept: list[int], doubted: list[int], iterations: int) -> None:
        """After the keyframes were moved so that two ends of a loop meet: drops what the newer end had mapped again,
        and trains both ends.

        Args:
            kept: numbers of the keyframes at the older end.
            doubted: of those that may have mapped the same again.
            iterations: optimisation steps, on keyframes of either end by turns.
        """
        remove_duplicates(self.map, np.array(kept, int), np.array(doubted, int), 2 * self.depth_sigma)
        there = set(self._trainable())
        pairs = zip(reversed(doubted), reversed(kept), strict=False)
        ends = [self.keyframes[n] for pair in pairs for n in pair if n in there]
        for i in range(iterations if ends else 0):
            self.iterate(ends[i % len(ends)])

    @abstractmethod
    def _new_keyframe(self, frame: Frame, T_world_camera: np.ndarray) -> Keyframe:
        """The next keyframe, with what its training needs besides."""

    @abstractmethod
    def _insert(
        self, keyframe: Keyframe, T_world_camera: np.ndarray, labeller: Labeller | None,
        begin_others: Callable[[], None],
    ) -> None:  # fmt: skip
        """Inserts Gaussians for what the map lacks at a keyframe seen from `T_world_camera`, and takes its labels."""

    def _densify(self) -> None:  # noqa: B027
        """Clones and splits Gaussians if `MapperSettings.densification` says so; on the CPU."""

    def _prune(self) -> None:
        """Drops useless Gaussians."""
        prune(self.map, self.settings.pruning)

    def _keep(self, stays: torch.Tensor) -> None:
        """Drops Gaussians where `stays`, bool [N] where the map is, is False."""
        self.map.keep(stays)

    def _take_labels(self, keyframe: Keyframe, labels: KeyframeLabels) -> None:
        """The keyframe's objects become its mask. What was rendered last is the map as the keyframe sees it, if
        there was one."""
        keyframe.mask = labels.mask
        if labels.mask is None or self.identity is None:
            return
        mask = labels.mask if keyframe.moving is None else np.where(keyframe.moving, np.uint16(0), labels.mask)
        keyframe.mask = mask
        self.identity.merge(self.map, labels.merges)
        if labels.forgotten:
            self.identity.forget(self.map, labels.forgotten)
        self.identity.observe(mask)
        self.identity.split(self.map, self._rasterizer, mask, labels.splits)

    # --- optimisation ------------------------------------------------------------------------------------------------

    def run(self, iterations: int) -> None:
        """Optimisation, see `mapping.sampling` for the order of keyframes."""
        numbers = self._trainable()
        for _ in range(iterations):
            if self.residency is not None:  # a part on disk comes late to the last steps, and for short
                self._iterate_wholly(numbers)
                continue
            keyframe = self._draw(numbers)
            self._step(keyframe, (1.0, 1.0), self._choose_grid(keyframe), self._is_identity_due(keyframe))
            self._count_iteration()

    def _iterate_wholly(
        self, numbers: Sequence[int], rate_factor: float = 1.0, pose_factor: float = 1.0, done: float = 1.0,
        settles: bool = False,
    ) -> None:  # fmt: skip
        """One iteration of the final refinement, of which `done`, 0 to 1, is over, on some keyframes: a step on all
        pixels of one or, where depth is noisy, several on every second pixel of as many. It is the same whether
        identities are trained, too, or not. `settles` as of `_adam`."""
        count = MapperTuning.noisy_steps if self._is_noisy else 1
        if self._steps_wholly:
            pose_factor /= count
        for step in range(count):
            keyframe = self._draw(numbers)
            grid = self._choose_grid(keyframe) if self._is_noisy else self._choose_size(keyframe, done)
            candidates = self._beside.get(keyframe.index, ())
            beside = frame_of_turn(keyframe.iterations, candidates)
            if beside is None:
                learns = step == 0 and self._is_identity_due(keyframe)
                self._step(keyframe, (rate_factor, pose_factor), grid, learns, settles)
            else:
                self._step(self._view_beside(beside, keyframe), (rate_factor, 0.0), grid, False, settles)
                keyframe.iterations += 1
            if grid.is_whole and not self._steps_wholly:
                break
        self._count_iteration()

    def _view_beside(self, frame: BetweenFrame, keyframe: Keyframe) -> Keyframe:
        """A frame between keyframes as a step sees it, with the pose that its keyframe gives it."""
        return frame.view(keyframe)

    def _masks_on(self, keyframe: Keyframe, grid: PixelGrid) -> Keyframe | MaskOnGrid:
        """What identity steps read of a keyframe at a grid's pixels."""
        return keyframe if grid.is_whole else MaskOnGrid.of(keyframe, grid)

    @property
    def _steps_wholly(self) -> bool:
        """Whether each of several steps of an iteration is on all pixels."""
        return False

    def _choose_size(self, keyframe: Keyframe, done: float) -> PixelGrid:
        """The picture of a step of the final refinement; the recording's own if a loss needs it."""
        return ALL_PIXELS if self._needs_all_pixels else picture_of_turn(self.times.iterations, done, keyframe.camera)

    def _choose_grid(self, keyframe: Keyframe) -> PixelGrid:
        """Every second pixel of every second row of a keyframe, other ones each time; all if a loss needs them all."""
        if self._needs_all_pixels:
            return ALL_PIXELS
        return grid_of_turn(keyframe.iterations + keyframe.index, keyframe.camera)

    @property
    def _needs_all_pixels(self) -> bool:
        """Whether a loss is of whole pictures of the recording's size."""
        return self.extra_loss is not None or self._is_identity_dense

    @property
    def _loss_faults(self) -> torch.Tensor | None:
        """Where gradients of `extra_loss` that are not finite are noted; None: they are refused at once."""
        return None

    @property
    def _is_noisy(self) -> bool:
        """Whether depth is, see `MapperSettings.sparse_noise`."""
        return self.depth_noise_px >= self.settings.sparse_noise

    @property
    def _is_identity_dense(self) -> bool:
        """Whether identities are trained on whole rendered images of them."""
        return self.identity is not None and self.identity.settings.renders_images

    def _is_identity_due(self, keyframe: Keyframe) -> bool:
        return self.identity is not None and self.identity.due(keyframe)

    def note_valid(self, frame: Frame) -> None:
        """Remembers where images of a frame's camera show something: nothing else is trained on."""
        self._valid[frame.camera_number] = frame.valid

    def valid_of(self, keyframe: Keyframe) -> np.ndarray | None:
        """Where a keyframe shows something, bool [H, W]; None: everywhere, or it is of another recording."""
        valid = self._valid.get(keyframe.camera_number) if keyframe.frame_index != FROM_EARLIER_RUN else None
        if valid is not None and valid.shape != keyframe.color.shape[:2]:
            valid = None
        if keyframe.moving is None:
            return valid
        return ~keyframe.moving if valid is None else valid & ~keyframe.moving

    def _trainable(self) -> Sequence[int]:
        return self._all_numbers if self.residency is None else self.residency.trainable()

    @property
    def _all_numbers(self) -> Sequence[int]:
        numbers = range(len(self.keyframes))
        return [k for k in numbers if k not in self.left_out] if self.left_out else numbers

    def _draw(self, numbers: Sequence[int]) -> Keyframe:
        return self.keyframes[self._sampler.choose(numbers)]

    def stages(self) -> Iterable[Sequence[int]]:
        """Numbers of all keyframes, some after the others: of those handed out the whole map is in memory."""
        return (self._all_numbers,) if self.residency is None else self.residency.stages()

    def _stages(self, steps: int) -> Iterator[tuple[Sequence[int], int]]:
        """Keyframes to train together, and how many of `steps` are theirs: as many as their share of all keyframes."""
        done, total = 0, len(self._all_numbers)
        for numbers in self.stages():
            before, done = done, done + len(numbers)
            yield numbers, steps * done // total - steps * before // total

    def last_iterations(self, before: int) -> int:
        """Iterations of the final refinement after so many, unless a user says how many there are."""
        if self.residency is not None:
            return round(MapperTuning.all_pixels_end_share * before)
        if self.is_live or not before:
            return round(MapperTuning.live_end_share * before)
        own = sum(self.keyframes[k].frame_index != FROM_EARLIER_RUN for k in self._all_numbers)
        beside = self._find_beside(self._all_numbers)  # fit or not, which is not known before
        share = end_share(self.keyframes[min(beside)].camera) if beside else MapperTuning.end_share
        return max(round(share * before), MapperTuning.min_visits * own)

    def iterate(self, keyframe: Keyframe, rate_factor: float = 1.0, settles: bool = False) -> None:
        """One iteration on the whole images of one keyframe.

        Args:
            keyframe: what to train on.
            rate_factor: multiplies every learning rate.
            settles: whether Gaussians are about where they belong: steps of means and standard deviations are shorter.
        """
        self._step(keyframe, (rate_factor, rate_factor), ALL_PIXELS, self._is_identity_due(keyframe), settles)
        self._count_iteration()

    def average(self, left: int, averaged: float) -> None:
        """After a step that `left` others follow, of which the last `averaged` count: now and then the map as it is
        joins those whose mean `end_refinement` makes of it."""
        every = max(1, min(MapperTuning.average_every, int(averaged) // MapperTuning.averaged_maps))
        if left < averaged and left % every == 0:
            self._mean.add(self.map)

    def _step(
        self, keyframe: Keyframe, factors: tuple[float, float], grid: PixelGrid, learns: bool, settles: bool = False
    ) -> None:
        """One optimisation step: forward, loss, identity, backward with the optimizer fused in.

        Args:
            keyframe: what to train on.
            factors: multiply the learning rates of the Gaussians, and of poses.
            grid: its pixels that count.
            learns: whether identities are trained, too.
            settles: as of `_adam`.
        """
        times, watch, identity = self.times, _Stopwatch(), self.identity
        rate_factor, pose_factor = factors
        features = learns and self._is_identity_dense
        features = features or uses_features(self.extra_loss)
        view = self._render(keyframe, features, grid, self.settings.close_below)
        times.forward += watch.lap()
        loss = self._evaluate_loss(keyframe, view, grid)
        times.loss += watch.lap()
        grad_features = None
        if learns and identity is not None:
            masked = self._masks_on(keyframe, grid)
            with part("objects"):
                grad_features = identity.step(self.map, self._rasterizer, masked, view)
        times.identity += watch.lap()
        if self.extra_loss is not None:
            grad_features = add_extra_loss(
                self.extra_loss, view, keyframe, loss, grad_features, self._loss_faults
            )  # fmt: skip
            times.loss += watch.lap()
        step = self._rasterizer.backward_step(
            self.map, loss.d_image, loss.d_depth, loss.d_alpha, grad_features,
            optimizer=self._optimizer(rate_factor, settles),
            detach_features=identity is None or identity.settings.detach,
        )  # fmt: skip
        self._finish_step(keyframe, step.twist, loss, self._pose_rate_of(keyframe, grid, pose_factor))
        times.backward += watch.lap()
        times.steps += 1
        keyframe.iterations += 1

    def _pose_rate_of(self, keyframe: Keyframe, grid: PixelGrid, pose_factor: float) -> float:
        """Size of a step of a keyframe's pose, metres and radians; 0: it stays."""
        share = 1 if grid.is_whole else 1 / MapperTuning.noisy_steps  # fewer pixels tell less of where the camera was
        return 0.0 if self.is_world(keyframe) else share * pose_factor * self._pose_rate

    def _count_iteration(self) -> None:
        self.times.iterations += 1
        if self.times.iterations % MapperTuning.bound_every == 0:
            self._bound_values()

    def _bound_values(self) -> None:
        """Colours that do not depend on the direction stay between black and white: formats with whole numbers have no
        others. Gaussians stay of a size that is not dropped: what is hardly seen grows without end."""
        self.map.bound_scales(self.settings.pruning.max_scale_m)
        if self.map.sh_degree == 0:
            self.map.bound_colors()

    def is_world(self, keyframe: Keyframe) -> bool:
        """Whether the pose is fixed (gauge): the first keyframe, with those of its rig then, defines the world."""
        number, first = self._all_numbers[0], self.keyframes[self._all_numbers[0]].instant
        if keyframe.index == number or first is None or keyframe.instant != first:
            return keyframe.index == number
        return all(earlier.instant == first for earlier in self.keyframes[: keyframe.index])

    def _move_rig(self, keyframe: Keyframe, T_before: np.ndarray) -> None:
        """Lets keyframes that a rig took at the same instant follow one whose T_camera_world was `T_before` [4, 4]."""
        if keyframe.instant is None:
            return
        T_before_now = inverse(T_before) @ keyframe.T_camera_world
        for step in (-1, 1):
            k = keyframe.index + step
            while 0 <= k < len(self.keyframes) and self.keyframes[k].instant == keyframe.instant:
                moved = self.keyframes[k].T_camera_world @ T_before_now
                self.keyframes[k].T_camera_world = orthonormalize(moved)  # they move one another, and so would rounding
                k += step

    @property
    def _pose_rate(self) -> float:
        """Step size of keyframes' poses, metres and radians; 0: they stay."""
        refinement = self.settings.pose_refinement
        sigmas = refinement.noisy_rate_sigmas if self._is_noisy else refinement.rate_sigmas
        return min(sigmas * self.depth_sigma, refinement.max_rate) if refinement.enabled else 0.0

    @abstractmethod
    def _render(
        self, keyframe: Keyframe, features: bool, grid: PixelGrid = ALL_PIXELS, close_below: float = 0.0
    ) -> RenderBuffers:
        """The map as a keyframe sees it at a grid's pixels, with or without identities. `close_below` as the CPU
        rasterizer's."""

    @abstractmethod
    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = ALL_PIXELS) -> LossGradients:
        """The loss of a view rendered at a grid's pixels against its keyframe's images."""

    @abstractmethod
    def _finish_step(self, keyframe: Keyframe, twist: Any, loss: Any, pose_rate: float) -> None:
        """The pose and, of all keyframes but the first, the exposure follow their gradients; the loss joins the sums.

        Args:
            keyframe: that was trained on.
            twist: gradient of its pose [6], as the rasterizer gave it.
            loss: as `_evaluate_loss` gave it.
            pose_rate: size of the pose's step, metres and radians; 0: it stays.
        """

    @abstractmethod
    def drop_hidden(self) -> None:
        """Drops Gaussians that keyframes inserted and none of them shows, see `PruningSettings.min_weight`; but those
        of the newest keyframe and of others of its instant, which are hardly trained, stay, and so does what a map has
        from before."""

    def refine(self, iterations: int, progress: Callable[[int, int], None] | None = None, begin: int = 0) -> None:
        """Final refinement, for each part of a map that is in memory by turns: steps are short and the map becomes the
        mean over the last ones, see `MapperSettings.average_last`, or learning rates fall exponentially. The first
        `begin` steps were made before; between steps `progress` is told how many of how many are."""
        share, done = self._averaged_share, 0
        self._sampler.end()
        for numbers, steps in self._stages(iterations):
            self._beside = self._trained_beside(numbers)
            for i in range(steps):
                done += 1
                if done > begin:
                    falling = self.settings.refine_decay ** (i / max(1, steps - 1))
                    settles = share > 0 and i >= MapperTuning.settling_from * steps
                    self._iterate_wholly(numbers, 1.0 if share else falling, falling, i / steps, settles)
                    self.average(steps - 1 - i, share * steps)
                if progress is not None and done > begin and (done % 20 == 0 or done == iterations):
                    progress(done, iterations)
            self._repeat_missed(numbers, share > 0)
            self._mean.move_into(self.map)
            self._bound_values()
        if self.fits_view_colors and (self.residency is None or self.residency.is_whole):
            self._fit_view_colors()
        self._beside = {}

    def _repeat_missed(self, numbers: Sequence[int], averages: bool) -> None:  # noqa: B027
        """Steps of the final refinement on these keyframes in the place of those that did nothing, if there are such.
        `averages`: the map becomes a mean, which they join."""

    def _fit_view_colors(self) -> None:  # noqa: B027
        """Gives Gaussians colours that depend on the view where keyframes ask for them."""

    def end_refinement(self) -> None:
        """The map becomes the mean over what a refinement, perhaps cut off, has made of it in the last steps."""
        self._mean.move_into(self.map)

    @property
    def _averaged_share(self) -> float:
        """Share of the steps, the last ones, that the map becomes the mean over; 0: it is what the last one leaves."""
        return self.settings.average_last

    def finish_identity(self) -> None:
        """The last identity steps, see `IdentitySettings.final_passes`, and every Gaussian's object. Colours, shapes
        and poses stay as they are."""
        if self.identity is None:
            return
        start, settings = time.perf_counter(), self.identity.settings
        passes = settings.final_passes if settings.schedule == "sampled" else 0
        for numbers in self.stages() if passes else ():
            shown = {number: self._objects_of(self.keyframes[number]) for number in numbers}
            visits = list(last_visits(shown, passes, MapperTuning.final_steps_per_view))
            for i, (number, steps) in enumerate(visits):
                falling = MapperTuning.final_identity_decay ** (i / len(visits))
                self._train_identity(self.keyframes[number], steps, falling)
        self.identity.label(self.map)
        self.times.identity_finish += time.perf_counter() - start

    def _objects_of(self, keyframe: Keyframe) -> np.ndarray:
        """Ids of the objects in a keyframe's mask, as they are called by now."""
        assert self.identity is not None
        mask = keyframe.mask
        if mask is None:
            return np.zeros(0, np.int64)
        ids = np.unique(self.identity.current(ids_of(mask)))
        return ids[ids > 0].astype(np.int64)

    def _train_identity(self, keyframe: Keyframe, steps: int, rate_factor: float) -> None:
        """Identity steps on one rendering of a keyframe that has a mask."""
        assert self.identity is not None
        view = self._render(keyframe, features=False)
        for _ in range(steps):
            self.identity.step(self.map, self._rasterizer, keyframe, view, rate_factor)

    def _optimizer(self, rate_factor: float, settles: bool) -> AdamSettings:
        return self._standard_adam(settles) if rate_factor == 1 else self._adam(rate_factor, settles)

    def _standard_adam(self, settles: bool = False) -> AdamSettings:
        """Made once: every step asks for it."""
        if self._adam_of_pixel is None or self._adam_of_pixel[:2] != (self.pixel_m, settles):
            self._adam_of_pixel = self.pixel_m, settles, self._adam(1.0, settles)
        return self._adam_of_pixel[2]

    def _adam(self, rate_factor: float, settles: bool = False) -> AdamSettings:
        """Rates of all groups times `rate_factor`; `settles`: Gaussians are about where they belong, and those of means
        and standard deviations are shorter."""
        r = self.settings.rates
        young = r.young_factor
        decay = (1 / young) ** (1 / max(1, r.young_updates)) if young > 1 else 1.0
        trained = [name for name in ADAM_GROUPS if name != "features"]
        rates = {name: rate_factor * getattr(r, name) * (young if name in _YOUNG else 1) for name in trained}
        if self.pixel_m > 0:
            rates["means"] = min(rates["means"], rate_factor * r.means_px * self.pixel_m)
        if self.fits_view_colors:
            rates["sh_rest"] = 0.0
        if settles:
            rates["means"] *= MapperTuning.settling_means
            rates["log_scales"] *= MapperTuning.settling_scales
        if self.identity is not None:
            rates["features"] = self.identity.settings.rate
        return AdamSettings(
            learning_rates=rates, beta1=r.beta1, beta2=r.beta2, epsilon=r.epsilon, decay=decay, decay_floor=1 / young,
            decayed_groups=_YOUNG, falling_groups=_FALLING, fall_updates=r.fall_updates,
        )  # fmt: skip
