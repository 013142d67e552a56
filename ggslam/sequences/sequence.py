# SPDX-License-Identifier: Apache-2.0
"""The selected part of a recording, delivered frame by frame."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.images import read_color, read_confidence, read_depth
from ggslam.sequences.masks import MaskReader
from ggslam.sequences.pixel_grid import ImageGeometry, image_size
from ggslam.sequences.recording import FrameFiles, Recording
from ggslam.sequences.stream import ReadAhead

OnBadFrame = Literal["error", "skip"]
ReadMasks = bool | Literal["lazy"]
"""True: masks are read with the frame; "lazy": when `Frame.load_mask` is called; False: never."""

SMALLEST_SIDE = 8
"""Pixels that `scale` has to leave of both sides of an image: windows of trackers and filters need so many."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SkippedFrame:
    """A damaged frame that `stream` passed over: its numbers (as in `Frame`) and what is wrong with it."""

    index: int
    source_index: int
    reason: str


class Sequence:
    """A recording read as a stream. Made by `open_sequence`; holds no images.

    Attributes:
        name: name of the folder, or of the file without suffix.
        format: name of the format.
        path: folder or file of the recording.
        camera: intrinsics of the delivered images.
        native_camera: the same before `scale`.
        depth_scale: units per metre of the stored depth images.
        color_size, depth_size: (width, height) of the stored images.
        lens: distortion that is undone and intrinsics that change, for people; "" for a pinhole camera that stays one.
        min_confidence: depth less sure than this is dropped; None: the recording has no confidence images.
        registered: whether depth images of another camera are registered to the colour images.
        timestamps: float64 [n], seconds.
        ground_truth: float64 [n, 4, 4] T_world_camera, rows of NaN where the recording tells none; None when it
            never does.
        has_masks: whether any selected frame has a mask.
        mask_problems: damaged masks met so far (only with on_bad_frame="skip": their frames are delivered without):
            index of the frame -> reason.
        instance_names: mask id -> name, as far as known.
        pose_source, time_source: what told poses and times, for reports.
        warnings: what a user should know about this recording.
        skipped: damaged frames passed over so far (only with on_bad_frame="skip").
    """

    def __init__(
        self, recording: Recording, selection: range, *, scale: float = 1.0, on_bad_frame: OnBadFrame = "error"
    ) -> None:
        """Prepares the frames `selection` of a recording.

        Raises:
            SequenceError: the first frame is damaged (with on_bad_frame="skip": every frame is), files are missing, or
                `scale` is not in (0, 1] or leaves hardly an image.
        """
        if on_bad_frame not in ("error", "skip"):
            raise SequenceError(f"on_bad_frame: expected 'error' or 'skip', found '{on_bad_frame}'")
        if not (math.isfinite(scale) and 0 < scale <= 1):
            raise SequenceError(f"scale: expected a number above 0 and at most 1, found {scale}")
        self.min_confidence: int | None = None
        if any(entry.confidence is not None for entry in recording.files):
            self.min_confidence = recording.min_confidence
        self.lens: str = _lens(recording)
        self.registered: bool = recording.depth_camera is not None
        self._recording, self._selection, self._on_bad_frame = recording, selection, on_bad_frame
        self.path: Path = recording.path
        self.name: str = recording.path.stem if recording.path.is_file() else recording.path.name
        self.format: str = recording.format
        self.depth_scale: float = recording.depth_scale
        self.instance_names: dict[int, str] = dict(recording.instance_names)
        self.pose_source: str = recording.pose_source
        self.time_source: str = recording.time_source
        self.warnings: list[str] = list(recording.warnings)
        chosen = np.arange(len(recording.files))[selection.start : selection.stop : selection.step]
        self.timestamps: np.ndarray = recording.timestamps[chosen].astype(np.float64)
        self.ground_truth: np.ndarray | None = None if recording.poses is None else recording.poses[chosen]
        masked = sum(recording.files[i].mask is not None for i in selection)
        self.has_masks: bool = masked > 0
        self.mask_problems: dict[int, str] = {}
        self._masks = MaskReader(entry.mask for entry in recording.files)
        if masked < len(self) and any(entry.mask is not None for entry in recording.files):
            self.warnings.append(f"{len(self) - masked} of {len(self)} frames have no mask")
        self._skipped: dict[int, SkippedFrame] = {}
        known = [i for i in selection if i in recording.problems]
        if on_bad_frame == "error" and known:
            more = f" (and {len(known) - 1} more damaged frames)" if len(known) > 1 else ""
            raise SequenceError(recording.problems[known[0]] + more)
        self._geometry = self._measure(scale)
        self.color_size: tuple[int, int] = self._geometry.color_size
        self.depth_size: tuple[int, int] = self._geometry.depth_size
        self.camera: Camera = self._geometry.camera
        if scale < 1 and min(self.camera.width, self.camera.height) < SMALLEST_SIDE:
            size = f"{self.camera.width}x{self.camera.height}"
            raise SequenceError(f"scale: {scale:g} leaves images of {size}, needed are {SMALLEST_SIDE} pixels a side")
        self.native_camera: Camera = self._geometry.native_camera

    def __len__(self) -> int:
        return len(self._selection)

    @property
    def skipped(self) -> list[SkippedFrame]:
        """Damaged frames passed over by `stream` so far, in order."""
        return [self._skipped[i] for i in sorted(self._skipped)]

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
        files = self.files(index)
        source = self._selection[index]
        if source in self._recording.problems:
            raise SequenceError(self._recording.problems[source])
        color, depth = self._read(source)
        self._geometry.check(color, depth, files)
        pose = None if self.ground_truth is None else self.ground_truth[index]
        return Frame(
            index=index,
            source_index=source,
            timestamp=float(self.timestamps[index]),
            color=self._geometry.color(self._geometry.steady(color, files, cv2.INTER_LINEAR)),
            depth=self._geometry.depth(self._geometry.steady(depth, files, cv2.INTER_NEAREST)),
            camera=self.camera,
            mask=self._mask(index) if masks is True else None,
            T_world_camera=pose.copy() if pose is not None and np.isfinite(pose).all() else None,
            mask_loader=partial(self._mask, index) if masks == "lazy" and files.mask is not None else None,
        )

    def stream(self, prefetch: int = 4, masks: ReadMasks = True) -> Iterator[Frame]:
        """All frames in order, at most `prefetch` of them read ahead by one background thread (0: no thread).
        Masks are read as `masks` says; leaving them saves a quarter of the time.

        The thread ends when the iterator is used up, closed or garbage collected.

        Raises:
            SequenceError: at the place of a damaged frame, unless on_bad_frame="skip".
        """
        if prefetch < 1:
            for index in range(len(self)):
                yield from self._passed(self._attempt(index, masks))
            return
        with ReadAhead(partial(self._attempt, masks=masks), len(self), prefetch) as attempts:
            for attempt in attempts:
                yield from self._passed(attempt)

    def _attempt(self, index: int, masks: ReadMasks) -> Frame | SkippedFrame:
        try:
            return self.frame(index, masks)
        except SequenceError as error:
            if self._on_bad_frame == "error":
                raise
            return SkippedFrame(index, self._selection[index], str(error))

    def _passed(self, attempt: Frame | SkippedFrame) -> Iterator[Frame]:
        if isinstance(attempt, SkippedFrame):
            self._skipped[attempt.index] = attempt
        else:
            yield attempt

    def _mask(self, index: int) -> np.ndarray | None:
        """Mask of a frame, uint16 [H, W]; None when it has none or, with on_bad_frame="skip", a damaged one."""
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
        return self._geometry.mask(self._geometry.steady(ids, self.files(index), cv2.INTER_NEAREST))

    def _read(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        files = self._recording.files[source]
        depth = read_depth(files.depth, self._recording.depth_scale, self._recording.invalid_depth)
        if files.confidence is not None:
            confidence = read_confidence(files.confidence)
            if confidence.shape != depth.shape:
                found, expected = (f"{a.shape[1]}x{a.shape[0]}" for a in (confidence, depth))
                raise SequenceError(f"{files.confidence}: expected confidence of {expected} like depth, found {found}")
            depth[confidence < self._recording.min_confidence] = 0
        return read_color(files.color), depth

    def _measure(self, scale: float) -> ImageGeometry:
        """Sizes and cameras from the first readable frame."""
        first_error: SequenceError | None = None
        for source in self._selection:
            if source in self._recording.problems:
                continue
            try:
                color, depth = self._read(source)
            except SequenceError as error:
                if self._on_bad_frame == "error":
                    raise
                first_error = first_error or error
                continue
            files = self._recording.files[source]
            return ImageGeometry(self._recording, files, image_size(color), image_size(depth), scale)
        reason = first_error or self._recording.problems[self._selection[0]]
        raise SequenceError(f"{self.path}: none of {len(self)} frames can be read; the first: {reason}")


def _lens(recording: Recording) -> str:
    words = []
    if recording.distortion is not None and np.any(recording.distortion):
        count = len(recording.distortion)
        words.append("fisheye undone" if recording.fisheye else f"{count} distortion coefficients undone")
    if len({entry.camera for entry in recording.files if entry.camera is not None}) > 1:
        words.append("intrinsics of each frame brought to the first one's")
    return ", ".join(words)
