# SPDX-License-Identifier: Apache-2.0
"""The selected part of a recording, delivered frame by frame."""

from __future__ import annotations

import logging
import math
import operator
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, SupportsIndex, overload

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.depth_kind import PLAIN, DepthKind
from ggslam.sequences.images import metric_depth, no_returns, read_color, read_confidence, read_stored_depth
from ggslam.sequences.mask_images import most_pixels
from ggslam.sequences.masks import MaskReader
from ggslam.sequences.moving_pixels import MovingPixels
from ggslam.sequences.pixel_grid import ImageGeometry, image_size, rays_of_depth
from ggslam.sequences.recording import FrameFiles, Recording
from ggslam.sequences.stream import ReadAhead
from ggslam.sequences.valid_pixels import common_fill, fill_of
from ggslam.system.opencv import opencv_errors
from ggslam.system.plurals import quantity, word_for
from ggslam.system.tuning import Tuning

OnBadFrame = Literal["error", "skip"]
ReadMasks = bool | Literal["lazy", "unshared"]
"""True: masks are read with the frame; "unshared": so, too, but pixels of a smaller image that several things have like
shares of get id 0; "lazy": when `Frame.load_mask` is called; False: never."""


class SequenceTuning(Tuning):
    """How images are judged when a recording is opened."""

    fill_frames = 4
    """Images that are compared with the first one if that has a corner of one colour."""
    min_side = 8
    """Fewest rows and columns that `scale` may leave: trackers and filters have windows."""


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SkippedFrame:
    """A damaged frame that `stream` skipped: its numbers (as in `Frame`) and what is wrong with it."""

    index: int
    source_index: int
    reason: str


class Sequence:
    """A recording read as a stream. Made by `open_sequence`; holds no images.

    It is indexed like a list: `sequence[0]` and `sequence[-1]` read a frame, `sequence[10:20]` is a sequence of these
    frames with the same camera, `for frame in sequence` streams. It can be pickled and sent to other processes, which
    open the recording for themselves; so `torch.utils.data.DataLoader(sequence, collate_fn=collate_frames)` works with
    any number of workers.

    Attributes:
        name: name of the folder, or of the file without suffix.
        format: name of the format.
        path: folder or file of the recording.
        camera: intrinsics of the delivered images.
        native_camera: of images as stored.
        scale: of the delivered images to those that come by default, see `default_camera`.
        finer: whether colour is much finer than depth, which is brought to colour.
        valid: bool [H, W], where delivered images show something; None: everywhere.
        depth_scale: units per metre of the stored depth images.
        depth_kind: what the numbers of depth images mean.
        upright: whether colour images are turned as their orientation tag says.
        void_id: id of stored masks that means "unlabelled" besides 0, or None.
        color_size, depth_size: (width, height) of the stored images.
        stated_size: (width, height) of the colour images that the recording's intrinsics say they are for, or None.
        lens: distortion that is undone and intrinsics that change, in words; "" for a pinhole camera that stays one.
        min_confidence: depth less sure than this is dropped; None: the recording has no confidence images.
        registered: whether depth images of another camera are registered to the colour images.
        timestamps: float64 [n], seconds.
        ground_truth: float64 [n, 4, 4] T_world_camera, rows of NaN where the recording has none; None when it
            has none at all.
        has_masks: whether any selected frame has a mask.
        mask_problems: damaged masks met so far (only with on_bad_frame="skip": their frames are delivered without):
            index of the frame -> reason.
        instance_names: mask id -> name, as far as known.
        pose_source, time_source, camera_source: where poses, timestamps and intrinsics come from, for reports.
        pose_problem: why the true poses that the recording should have cannot be used; "" where they can.
        options: arguments of `open_sequence` besides the selection; None if it was made otherwise.
        warnings: what a user should know about this recording.
        skipped_frames: damaged frames skipped so far (only with on_bad_frame="skip").
    """

    pose_problem: str = ""

    def __init__(
        self, recording: Recording, selection: range, *, scale: float | None = None,
        on_bad_frame: OnBadFrame = "error", reopen: Callable[[], Recording] | None = None,
    ) -> None:  # fmt: skip
        """Prepares the frames `selection` of a recording; `reopen` reads its description again, in another process.

        Raises:
            SequenceError: the first frame is damaged (with on_bad_frame="skip": every frame is), files are missing, or
                `scale` leaves hardly an image, or more than is stored.
        """
        if on_bad_frame not in ("error", "skip"):
            raise SequenceError(f"`on_bad_frame`: expected 'error' or 'skip', found '{on_bad_frame}'")
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise SequenceError(f"`scale`: expected a number above 0 and at most 1, found {scale}")
        self.min_confidence: int | None = None
        if any(entry.confidence is not None for entry in recording.files):
            self.min_confidence = recording.min_confidence
        self.lens: str = _lens(recording)
        self.registered: bool = recording.depth_camera is not None
        self._recording, self._on_bad_frame = recording, on_bad_frame
        self._reopen, self._process = reopen, os.getpid()
        self.options: dict[str, Any] | None = None
        self.path: Path = recording.path
        self.name: str = recording.path.stem if recording.path.is_file() else recording.path.name
        self.format: str = recording.format
        self.depth_scale: float = recording.depth_scale
        self.depth_kind: DepthKind = recording.depth_kind
        self.upright: bool = recording.upright
        self.void_id: int | None = recording.void_id
        self.instance_names: dict[int, str] = dict(recording.instance_names)
        self.pose_source: str = recording.pose_source
        self.pose_problem = recording.pose_problem
        self.time_source: str = recording.time_source
        self.camera_source: str = recording.camera_source
        self.warnings: list[str] = list(recording.warnings)
        masked = self._select(selection)
        if masked < len(self) and any(entry.mask is not None for entry in recording.files):
            without = len(self) - masked
            self.warnings.append(f"{without} of {len(self)} frames {word_for(without, 'has', 'have')} no mask")
        known = [i for i in selection if i in recording.problems]
        if on_bad_frame == "error" and known:
            more = f" (and {quantity(len(known) - 1, 'more damaged frame')})" if len(known) > 1 else ""
            raise SequenceError(recording.problems[known[0]] + more)
        self._geometry = self._measure(scale)
        self._masks = self._mask_reader()
        self.color_size: tuple[int, int] = self._geometry.color_size
        self.depth_size: tuple[int, int] = self._geometry.depth_size
        self.stated_size: tuple[int, int] | None = None
        if recording.camera is not None:
            self.stated_size = (recording.camera.width, recording.camera.height)
        if self.camera_source and recording.camera is not None:
            self.camera_source += _scale_note(recording.camera, self.color_size)
        self.camera: Camera = self._geometry.camera
        self.scale: float = self._geometry.scale
        if self.scale < 1 and min(self.camera.width, self.camera.height) < SequenceTuning.min_side:
            size = f"{self.camera.width}x{self.camera.height}"
            needed = f"each side needs at least {SequenceTuning.min_side} pixels"
            raise SequenceError(f"`scale`: {self.scale:g} leaves images of {size}, {needed}")
        self.native_camera: Camera = self._geometry.native_camera
        self.finer: bool = self._geometry.finer
        self.valid: np.ndarray | None = self._geometry.valid
        self.moving: MovingPixels | None = None
        """What a run found to move in the frames: they come without it."""

    def _select(self, selection: range) -> int:
        """Takes these frames of the recording; returns how many of them have masks."""
        recording, chosen = self._recording, np.array(selection, int)
        self._selection = selection
        self.timestamps: np.ndarray = recording.timestamps[chosen].astype(np.float64)
        self.ground_truth: np.ndarray | None = None if recording.poses is None else recording.poses[chosen]
        masked = sum(recording.files[i].mask is not None for i in selection)
        self.has_masks: bool = masked > 0
        self.mask_problems: dict[int, str] = {}
        self._skipped: dict[int, SkippedFrame] = {}
        return masked

    # --- as a list ---------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._selection)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Frame | Sequence:
        """Frame `index`, counted from the end if negative; or the sequence of a slice's frames, whose `Frame.index`
        counts from 0 again.

        Raises:
            IndexError: no such frame.
            SequenceError: the frame or its mask is damaged, or the slice goes backwards.
        """
        if isinstance(index, slice):
            if index.step is not None and index.step < 1:
                raise SequenceError(f"{self.path}: the step of a slice must be at least 1, found {index.step}")
            part = object.__new__(Sequence)
            vars(part).update(vars(self), warnings=list(self.warnings))
            part._select(self._selection[index])
            if self.moving is not None:
                part.moving = self.moving.select(range(len(self))[index])
            return part
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"{self.path}: expected a frame from {-len(self)} to {len(self) - 1}, found {number}")
        return self.frame(number % len(self))

    def __iter__(self) -> Iterator[Frame]:
        """All frames in order with their masks, read ahead; see `stream`."""
        return self.stream()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but what other processes open for themselves: archives, videos, bags."""
        state = dict(vars(self))
        if self._reopen is not None:
            del state["_recording"], state["_masks"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open_again()

    def _open_again(self) -> None:
        """Opens archives, videos and bags for this process."""
        self._process = os.getpid()
        if self._reopen is not None:
            self._recording = self._reopen()
            self._masks = self._mask_reader()

    def _mask_reader(self) -> MaskReader:
        most = most_pixels(self._geometry.color_size, self._geometry.depth_size)
        return MaskReader((entry.mask for entry in self._recording.files), self._recording.void_id, most)

    def default_camera(self, scale: float = 1.0) -> Camera:
        """The camera of images that come with `scale`; 1: by default."""
        return self.native_camera.scale(scale * self._geometry.usual)

    @property
    def selection(self) -> range:
        """Numbers of the frames in the whole recording."""
        return self._selection

    # --- frame by frame ----------------------------------------------------------------------------------------------

    @property
    def skipped_frames(self) -> list[SkippedFrame]:
        """Damaged frames that `stream` has skipped so far, in order."""
        return [self._skipped[i] for i in sorted(self._skipped)]

    def go_on_after(self, skipped: Iterable[SkippedFrame], mask_problems: Mapping[int, str]) -> None:
        """What was met before, by another `stream` that came as far as the next one begins."""
        self._skipped.update({frame.index: frame for frame in skipped})
        self.mask_problems.update(mask_problems)

    def files(self, index: int) -> FrameFiles:
        """The files of frame `index` of the selection (0 to len - 1).

        Raises:
            SequenceError: no such frame.
        """
        if not 0 <= index < len(self):
            raise SequenceError(f"{self.path}: expected a frame from 0 to {len(self) - 1}, found {index}")
        return self._recording.files[self._selection[index]]

    def mask_kinds(self) -> Counter[str]:
        """How the masks of the selected frames are stored: "grey", "palette", "RGB-coded", ... -> number of frames.

        Raises:
            SequenceError: they hold more than 65535 ids.
        """
        masks = (self.files(index).mask for index in range(len(self)))
        return self._masks.kinds(mask for mask in masks if mask is not None)

    def frame(self, index: int, masks: ReadMasks = True) -> Frame:
        """Reads frame `index` of the selection (0 to len - 1), its mask as `masks` says.

        Raises:
            SequenceError: no such frame, or it is damaged (whatever `on_bad_frame` says), or, unless
                on_bad_frame="skip", its mask is.
        """
        if self._process != os.getpid():  # a fork shares open files and their positions with its parent
            self._open_again()
        files, source = self.files(index), self._selection[index]
        if source in self._recording.problems:
            raise SequenceError(self._recording.problems[source])
        with opencv_errors(f"{self.path}, frame {source}", SequenceError):
            return self._frame(index, source, files, masks)

    def _frame(self, index: int, source: int, files: FrameFiles, masks: ReadMasks) -> Frame:
        color, depth, no_return = self._read(source)
        self._geometry.check(color, depth, files)
        color = self._geometry.steady(color, files, cv2.INTER_LINEAR)
        stored = depth
        depth = self._geometry.depth(self._geometry.steady(depth, files, cv2.INTER_NEAREST), color)
        pose = None if self.ground_truth is None else self.ground_truth[index]
        found = Frame(
            index=index,
            source_index=source,
            timestamp=float(self.timestamps[index]),
            color=self._geometry.color(color),
            depth=depth,
            camera=self.camera,
            mask=self._mask(index, masks is True) if masks in (True, "unshared") else None,
            T_world_camera=pose.copy() if pose is not None and np.isfinite(pose).all() else None,
            valid=self.valid,
            no_return=None if no_return is None else self._geometry.no_return(no_return, stored, depth, color, files),
            depth_delay=0.0 if self._recording.depth_delays is None else float(self._recording.depth_delays[source]),
            mask_loader=partial(self._mask, index) if masks == "lazy" and files.mask is not None else None,
        )
        return found if self.moving is None else self.moving.without(found)

    def stream(self, prefetch: int = 4, masks: ReadMasks = True, begin: int = 0) -> Iterator[Frame]:
        """All frames in order, at most `prefetch` of them read ahead by one background thread (0: no thread).
        Masks are read as `masks` says; leaving them saves a quarter of the time. The first frame is `begin`.

        The thread ends when the iterator is used up, closed or garbage collected.

        Raises:
            SequenceError: at the place of a damaged frame, unless on_bad_frame="skip".
        """
        numbers = range(begin, len(self))
        if prefetch < 1:
            for index in numbers:
                yield from self._deliver(self._attempt(index, masks))
            return
        with ReadAhead(lambda i: self._attempt(numbers[i], masks), len(numbers), prefetch) as attempts:
            for attempt in attempts:
                yield from self._deliver(attempt)

    def _attempt(self, index: int, masks: ReadMasks) -> Frame | SkippedFrame:
        try:
            return self.frame(index, masks)
        except SequenceError as error:
            if self._on_bad_frame == "error":
                raise
            return SkippedFrame(index, self._selection[index], str(error))

    def _deliver(self, attempt: Frame | SkippedFrame) -> Iterator[Frame]:
        if isinstance(attempt, SkippedFrame):
            self._skipped[attempt.index] = attempt
        else:
            yield attempt

    def _mask(self, index: int, shared: bool = True) -> np.ndarray | None:
        """Mask of a frame, uint16 [H, W]; None when it has none or, with on_bad_frame="skip", a damaged one. `shared`:
        see `resize_mask`."""
        path = self.files(index).mask
        if path is None:
            return None
        self._masks.prepare()  # what is wrong with all masks is not forgiven
        try:
            # Masks drawn on the aligned depth image are as good as masks on the colour image.
            ids = self._masks.read(path, self._geometry.color_size, self._geometry.depth_size)
        except SequenceError as error:
            if self._on_bad_frame == "error":
                raise
            if index not in self.mask_problems:
                _log.warning("frame %d goes without its mask: %s", index, error)
            self.mask_problems[index] = str(error)
            return None
        return self._geometry.mask(self._geometry.steady(ids, self.files(index), cv2.INTER_NEAREST), shared)

    def _read(self, source: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Colour and depth as stored, in metres, and where depth says that the sensor found nothing."""
        files = self._recording.files[source]
        recording = self._recording
        raw, kind = read_stored_depth(files.depth), recording.depth_kind
        depth = metric_depth(raw, recording.depth_scale, kind.none)
        no_return = None if kind.measure == "inverse" else no_returns(raw, kind.none)
        if files.confidence is not None:
            confidence = read_confidence(files.confidence)
            if confidence.shape != depth.shape:
                found, expected = (f"{a.shape[1]}x{a.shape[0]}" for a in (confidence, depth))
                raise SequenceError(f"{files.confidence}: expected confidence of {expected} like depth, found {found}")
            depth = np.where(confidence < recording.min_confidence, np.float32(0), depth)
        color = read_color(files.color, recording.upright)
        if kind != PLAIN:
            rays = rays_of_depth(recording, files, image_size(color), image_size(depth))
            depth = kind.to_z(depth, rays, recording.depth_scale)
            no_return = None if no_return is None else kind.right_way_round(no_return)
        return color, depth, no_return

    def _look_for_fill(self, geometry: ImageGeometry, color: np.ndarray) -> None:
        """Leaves out what is of one colour from a corner on in all images, if it is so in the first one."""
        fill = fill_of(color)
        if fill is None:
            return
        others = []
        for source in self._selection[:: max(1, len(self._selection) // SequenceTuning.fill_frames)][
            1 : SequenceTuning.fill_frames + 1
        ]:
            try:
                others.append(read_color(self._recording.files[source].color, self._recording.upright))
            except SequenceError:
                continue
        found = common_fill(color, fill, others)
        if found is not None:
            geometry.leave_out(found)

    def _measure(self, scale: float | None) -> ImageGeometry:
        """Sizes and cameras from the first readable frame."""
        first_error: SequenceError | None = None
        for source in self._selection:
            if source in self._recording.problems:
                continue
            try:
                color, depth, _ = self._read(source)
            except SequenceError as error:
                if self._on_bad_frame == "error":
                    raise
                first_error = first_error or error
                continue
            files = self._recording.files[source]
            with opencv_errors(f"{self.path}, frame {source}", SequenceError):
                geometry = ImageGeometry(self._recording, files, image_size(color), image_size(depth), scale)
            self._look_for_fill(geometry, color)
            return geometry
        reason = first_error or self._recording.problems[self._selection[0]]
        raise SequenceError(f"{self.path}: none of {len(self)} frames can be read; the first: {reason}")


def _scale_note(stated: Camera, size: tuple[int, int]) -> str:
    """That intrinsics are brought to the size of the images, in words; "" where they are of that size."""
    own = (stated.width, stated.height)
    return "" if own == size else f", scaled from {own[0]}x{own[1]} to images of {size[0]}x{size[1]}"


def _lens(recording: Recording) -> str:
    words = []
    if recording.distortion is not None and np.any(recording.distortion):
        count = len(recording.distortion)
        words.append("fisheye undone" if recording.fisheye else f"{count} distortion coefficients undone")
    if len({entry.camera for entry in recording.files if entry.camera is not None}) > 1:
        words.append("intrinsics of each frame brought to the first one's")
    return ", ".join(words)
