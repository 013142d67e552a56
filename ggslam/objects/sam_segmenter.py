# SPDX-License-Identifier: Apache-2.0
"""Segments of all that is in an image by a SAM encoder and decoder: masks of a grid of points, the good ones kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ggslam.errors import ConfigError
from ggslam.objects.onnx_outputs import Letterbox, MaskCandidates
from ggslam.objects.onnx_segmenter import OnnxSegmenterSettings
from ggslam.objects.onnx_sessions import IMAGE_TYPES, OnnxSession, Pixels, image_values
from ggslam.objects.sam_decoder import SamDecoder
from ggslam.system.tuning import Tuning

_INPUT_SIZE: Final = 1024
"""Width and height of SAM's input, px."""


class SamTuning(Tuning):
    """How an image is asked for all that is in it."""

    points_per_side = 16
    """Points of the grid along each side of the image; each is asked for its masks."""
    points_at_once = 16
    """Points that a decoder is given at once, if it takes several."""
    stability_offset = 1.0
    """Logits by which a mask's border is shifted to see whether it is a border."""
    min_stability = 0.95
    """Least intersection over union of a mask with its border shifted out, and in."""
    grid_side = 256
    """Masks are kept at no more than about so many pixels a side."""


class SamSegmenter:
    """Class-agnostic segments of single images, as SAM's automatic mask generator makes them. Ids mean nothing from one
    image to the next."""

    def __init__(self, encoder: Path, decoder: Path, settings: OnnxSegmenterSettings | None = None) -> None:
        """Loads both.

        Raises:
            MissingDependency: onnxruntime is not installed.
            ConfigError: no such file, no ONNX model, or inputs and outputs that are not understood.
        """
        self.settings = settings or OnnxSegmenterSettings()
        self._encoder = OnnxSession(encoder, self.settings.threads)
        self._input, self._channels_last = self._find_input()
        self._decoder = SamDecoder(OnnxSession(decoder, self.settings.threads), self._encoder)
        shape = self._input.shape
        height, width = shape[-3:-1] if self._channels_last else shape[2:]
        self._is_open = not (isinstance(height, int) and isinstance(width, int))
        self._size = (_INPUT_SIZE, _INPUT_SIZE) if self._is_open else (width, height)

    def segment(self, color: np.ndarray) -> np.ndarray:
        """Segments uint16 [H, W] of an image uint8 [H, W, 3] RGB: 1, 2, ... by falling area, 0 where there is none.

        Where masks overlap the smaller one is on top.

        Raises:
            ConfigError: a model fails, or its outputs are not what their names and ranks say.
        """
        height, width = color.shape[:2]
        stretches = self._decoder.stretches
        letterbox = Letterbox.stretch(self._size) if stretches else Letterbox.fit(width, height, self._size, False)
        names = self._decoder.embeddings
        given = self._encoder.run(names, {self._input.name: self._feed(letterbox, color)})
        candidates = self._candidates(dict(zip(names, given, strict=True)), letterbox)
        settings = self.settings
        return candidates.segments(letterbox, width, height, settings.overlap, settings.min_area, settings.max_masks)

    def _find_input(self) -> tuple[Any, bool]:
        """The encoder's image, and whether its channels are last."""
        inputs = self._encoder.inputs
        if len(inputs) == 1 and inputs[0].type in IMAGE_TYPES and len(inputs[0].shape) in (3, 4):
            shape = inputs[0].shape
            if shape[-1] == 3:
                return inputs[0], True
            if len(shape) == 4 and (shape[1] == 3 or isinstance(shape[1], str)):
                return inputs[0], False
        raise ConfigError(
            f"{self._encoder.path}: not a SAM encoder that is understood. Expected one image [1, 3, H, W] or [H, W, 3] "
            f"as input; found {self._encoder}"
        )

    def _pixels(self) -> Pixels:
        """Values of pixels. SAM's are normalised, except where an export does it itself: those with channels last take
        bytes, and EfficientSAM 0 to 1."""
        if self.settings.pixels != "auto":
            return self.settings.pixels
        if self._channels_last:
            return "bytes"
        return "unit" if self._input.name == "batched_images" else "imagenet"

    def _feed(self, letterbox: Letterbox, color: np.ndarray) -> np.ndarray:
        """The encoder's input of an image uint8 [H, W, 3]."""
        width, height = letterbox.inner
        placed = image_values(letterbox.place(color, 0), IMAGE_TYPES[self._input.type], self._pixels())
        if self._channels_last:  # those that take any size fill up the border themselves
            values = placed[:height, :width] if self._is_open else placed
            return np.ascontiguousarray(values[None] if len(self._input.shape) == 4 else values)
        placed[height:], placed[:, width:] = 0, 0  # after normalising, as SAM was trained
        return np.ascontiguousarray(placed.transpose(2, 0, 1)[None])

    def _candidates(self, embeddings: dict[str, np.ndarray], letterbox: Letterbox) -> MaskCandidates:
        """Good masks of a grid of points in the image, best first."""
        side, size = SamTuning.points_per_side, letterbox.size
        share = (np.arange(side) + 0.5) / side
        x, y = np.meshgrid(share * letterbox.inner[0], share * letterbox.inner[1])
        points = np.stack([x.ravel(), y.ravel()], 1).astype(np.float32)
        at_once = self._decoder.at_once or SamTuning.points_at_once
        grids, scores = [], []
        for first in range(0, len(points), at_once):
            some = points[first : first + at_once]
            if len(some) < at_once and self._decoder.at_once:
                some = np.concatenate([some, np.repeat(some[-1:], at_once - len(some), 0)])
            masks, quality = self._decoder.decode(embeddings, some, size)
            good = quality >= self.settings.mask_quality
            for logits, score in zip(masks[good], quality[good], strict=True):
                grid = _as_grid(logits)
                if _is_stable(grid, letterbox):
                    grids.append(grid)
                    scores.append(score)
        order = np.argsort(-np.array(scores, np.float32), kind="stable")
        boxes = np.tile(np.array([0, 0, *letterbox.inner], np.float32), (len(order), 1))
        stack = np.stack([grids[i] for i in order]) if grids else np.zeros((0, 1, 1), np.float32)
        return MaskCandidates(np.array(scores, np.float32)[order], stack, boxes)


def _as_grid(mask: np.ndarray) -> np.ndarray:
    """Logits float32 [h, w] of a mask: logits, probabilities, or 0 and 1; no larger than is kept."""
    grid: np.ndarray = mask.astype(np.float32)
    if grid.min() >= 0 and grid.max() <= 1:
        inside = np.clip(grid, 1e-6, 1 - 1e-6)
        grid = np.log(inside / (1 - inside))
    step = -(-max(grid.shape) // SamTuning.grid_side)
    if step > 1:
        grid = cv2.resize(grid, (grid.shape[1] // step, grid.shape[0] // step), interpolation=cv2.INTER_AREA)
    return grid


def _is_stable(grid: np.ndarray, letterbox: Letterbox) -> bool:
    """Whether a mask hardly depends on the logit that it is cut at."""
    width = -(-letterbox.inner[0] * grid.shape[1] // letterbox.size[0])
    height = -(-letterbox.inner[1] * grid.shape[0] // letterbox.size[1])
    inner = grid[:height, :width]
    small = np.count_nonzero(inner > SamTuning.stability_offset)
    large = np.count_nonzero(inner > -SamTuning.stability_offset)
    return bool(small > 0 and small >= SamTuning.min_stability * large)
