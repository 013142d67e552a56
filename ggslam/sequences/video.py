# SPDX-License-Identifier: Apache-2.0
"""Frames inside a video file, decoded where they are asked for: the next one is quick, jumps seek."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.edit_list import count_hidden_frames
from ggslam.sequences.recording import NumberedImage
from ggslam.system.images import PictureLimits
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted


class VideoTuning(Tuning):
    """When a video is decoded on instead of being searched."""

    forward = 90
    """Frames that are decoded and dropped at most: seeking starts at a key frame."""


class Video:
    """A video file; frames are read by their number. May be used from several threads.

    Attributes:
        path: the file.
        count: frames that can be played, as the container tells.
        hidden: further frames at the start of the file that nobody can play, see `edit_list`.
        rate: frames per second.
    """

    def __init__(self, path: Path) -> None:
        """Raises SequenceError if the file is missing or is no video that can be decoded."""
        self.path = path
        self._lock = threading.Lock()
        self._capture = self._open()
        self._next = 0
        self.hidden = count_hidden_frames(path)
        self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) - self.hidden
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS)) or 30.0

    def _open(self) -> cv2.VideoCapture:
        open_untrusted(self.path, SequenceError).close()
        # The orientation tag is ignored: depth and calibration refer to the pixels as stored.
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        if not capture.isOpened() or capture.get(cv2.CAP_PROP_FRAME_COUNT) < 1:
            raise SequenceError(f"{self.path}: cannot be opened as a video (truncated, or a codec that is not known)")
        width, height = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > PictureLimits.max_pixels:
            raise SequenceError(
                f"{self.path}: claims {width}x{height} pixels; at most {PictureLimits.max_pixels:,} are read"
            )
        return capture

    def frame(self, index: int) -> np.ndarray:
        """Colour image uint8 [H, W, 3] RGB of frame `index`.

        Raises:
            SequenceError: it cannot be decoded.
        """
        with self._lock:
            if not 0 <= index - self._next <= VideoTuning.forward:
                self._seek(index)
            while self._next < index and self._capture.grab():
                self._next += 1
            read, image = self._capture.read() if self._next == index else (False, None)
            if not read or image is None:
                self._next = -1 - VideoTuning.forward  # nothing is known about the place now: the next one seeks
                raise SequenceError(f"{self.path}: frame {index} cannot be decoded (the video is truncated or damaged)")
            self._next = index + 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _seek(self, index: int) -> None:
        """Puts the capture before frame `index`, or at the start where containers do not seek exactly."""
        if index > VideoTuning.forward and self._capture.set(cv2.CAP_PROP_POS_FRAMES, index):
            at = self._capture.get(cv2.CAP_PROP_POS_FRAMES)
            if round(at) == index:
                self._next = index
                return
        self._capture.release()
        self._capture = self._open()
        self._next = 0


@dataclass(frozen=True)
class VideoFrame(NumberedImage):
    """A frame of a video as the colour image of a recording; see `ImageSource`."""

    video: Video
    index: int

    def __str__(self) -> str:
        return f"{self.video.path}, frame {self.index}"

    def read(self) -> np.ndarray:
        return self.video.frame(self.index)
