# SPDX-License-Identifier: Apache-2.0
"""What segmentation models take and give: images on a fixed grid, and masks as each family of models encodes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ggslam.errors import ConfigError
from ggslam.objects.mask_painting import distinct_masks, paint_segments

PROTOTYPE_GREY: Final = 114
"""Grey of the border that the YOLO family is trained with."""


@dataclass(frozen=True)
class Letterbox:
    """An image made as large as fits a model's input, its aspect kept, and a border around it.

    Attributes:
        size: (width, height) of the input.
        inner: (width, height) of the image in it.
        corner: (x, y) of the image's upper left pixel in it.
    """

    size: tuple[int, int]
    inner: tuple[int, int]
    corner: tuple[int, int]

    @staticmethod
    def fit(width: int, height: int, size: tuple[int, int], centred: bool) -> Letterbox:
        """For an image of `width` x `height`: in the middle of the input, or in its upper left corner."""
        scale = min(size[0] / width, size[1] / height)
        inner = max(1, round(width * scale)), max(1, round(height * scale))
        corner = ((size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2) if centred else (0, 0)
        return Letterbox(size, inner, corner)

    @staticmethod
    def stretch(size: tuple[int, int]) -> Letterbox:
        """The image fills the input, whatever its aspect."""
        return Letterbox(size, size, (0, 0))

    def place(self, color: np.ndarray, border: int) -> np.ndarray:
        """uint8 [h, w, 3] of the input's size with the image uint8 [H, W, 3] in it."""
        shrinks = self.inner[0] < color.shape[1]
        inner = cv2.resize(color, self.inner, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        result = np.full((self.size[1], self.size[0], 3), border, np.uint8)
        x, y = self.corner
        result[y : y + self.inner[1], x : x + self.inner[0]] = inner
        return result

    def to_image(self, grid: np.ndarray, width: int, height: int) -> np.ndarray:
        """Values float32 [height, width] at the pixels of the image, of a grid [h, w] laid over the whole input."""
        per_x, per_y = grid.shape[1] / self.size[0], grid.shape[0] / self.size[1]
        scale_x, scale_y = self.inner[0] / width, self.inner[1] / height
        # Pixel u of the image is centred at scale (u + 1/2) + corner - 1/2 of the input; likewise on the grid.
        map_to_grid = np.array([
            [scale_x * per_x, 0, (0.5 * scale_x + self.corner[0]) * per_x - 0.5],
            [0, scale_y * per_y, (0.5 * scale_y + self.corner[1]) * per_y - 0.5],
        ])  # fmt: skip
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(grid, map_to_grid, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class MaskCandidates:
    """Masks a model proposes.

    Attributes:
        scores: float32 [n], best first.
        grids: float32 [n, h, w] over the whole input, positive inside the mask.
        boxes: float32 [n, 4] (left, top, right, bottom) in pixels of the input, outside of which there is no mask.
    """

    scores: np.ndarray
    grids: np.ndarray
    boxes: np.ndarray

    def coarse(self, size: tuple[int, int], longest: int = 160) -> np.ndarray:
        """bool [n, h', w']: the masks, cut to their boxes, at no more than about `longest` pixels a side."""
        height, width = self.grids.shape[1:]
        step = -(-max(height, width) // longest)
        x = (np.arange(0, width, step) + 0.5) * (size[0] / width)
        y = (np.arange(0, height, step) + 0.5) * (size[1] / height)
        left, top, right, bottom = self.boxes.T[..., None]
        columns, rows = (x >= left) & (x < right), (y >= top) & (y < bottom)
        return (self.grids[:, ::step, ::step] > 0) & rows[:, :, None] & columns[:, None, :]

    def mask(self, index: int, letterbox: Letterbox, width: int, height: int) -> np.ndarray:
        """bool [height, width] of the image, of one candidate."""
        inside = letterbox.to_image(self.grids[index], width, height) > 0
        x = (np.arange(width) + 0.5) * (letterbox.inner[0] / width) + letterbox.corner[0]
        y = (np.arange(height) + 0.5) * (letterbox.inner[1] / height) + letterbox.corner[1]
        left, top, right, bottom = self.boxes[index]
        return inside & ((y >= top) & (y < bottom))[:, None] & ((x >= left) & (x < right))[None, :]

    def segments(
        self, letterbox: Letterbox, width: int, height: int, overlap: float, min_area: float, count: int
    ) -> np.ndarray:
        """Segments uint16 [height, width] of the image: 1, 2, ... by falling area, smaller ones on top; 0: none.

        Args:
            letterbox: how the image lies in the model's input.
            width, height: of the image.
            overlap: of masks with a larger intersection over union only the one of the best score is used.
            min_area: least share of the image that a segment has.
            count: of masks, at most.
        """
        kept = distinct_masks(self.coarse(letterbox.size), self.scores, overlap)[:count]
        if len(kept) == 0:
            return np.zeros((height, width), np.uint16)
        masks = [self.mask(index, letterbox, width, height) for index in kept]
        return paint_segments(masks, min_area * height * width)


def best(scores: np.ndarray, threshold: float, count: int) -> np.ndarray:
    """Indices int64 of at most `count` scores not below a threshold, best first (NaN is below)."""
    found = np.flatnonzero(scores >= threshold)
    return found[np.argsort(-scores[found], kind="stable")][:count]


def yolo_candidates(detections: np.ndarray, prototypes: np.ndarray, threshold: float, count: int) -> MaskCandidates:
    """Of a YOLO-seg model: a mask is the sum of prototypes weighted by the detection's coefficients, cut to its box.

    Args:
        detections: as one of

            - [1, 4 + classes + m, n] (v8, v11): centre x, y, width, height, class scores, coefficients;
            - [1, n, 5 + classes + m] (v5): centre x, y, width, height, objectness, class scores, which it multiplies,
              coefficients;
            - [1, n, 6 + m], from a model that ends with non-maximum suppression: corners, score, class, coefficients.
              v5 with one class has the same shape; see `_are_corners`.
        prototypes: [1, m, h, w].
        threshold: lowest score.
        count: of candidates, at most.

    Raises:
        ConfigError: other shapes.
    """
    channels = prototypes.shape[1]
    rows, columns = detections.shape[1:]
    is_raw_row = 4 + channels < columns <= rows
    if columns == 6 + channels and _are_corners(detections[0]):
        table = detections[0].astype(np.float32)
        boxes, scores, weights = table[:, :4], table[:, 4], table[:, 6:]
    elif is_raw_row and columns > 5 + channels:
        table = detections[0].astype(np.float32)
        boxes, weights = _corners(table), table[:, columns - channels :]
        scores = table[:, 4] * table[:, 5 : columns - channels].max(1)
    elif 4 + channels < rows <= columns:
        table = detections[0].T.astype(np.float32)
        boxes = _corners(table)
        scores, weights = table[:, 4 : rows - channels].max(1), table[:, rows - channels :]
    else:
        raise ConfigError(
            f"expected detections [1, 4 + classes + {channels}, n], [1, n, 5 + classes + {channels}] or "
            f"[1, n, {6 + channels}] beside {channels} prototypes, found {list(detections.shape)}"
        )
    chosen = best(scores, threshold, count)
    grids = np.tensordot(weights[chosen], prototypes[0].astype(np.float32), axes=1)
    return MaskCandidates(scores[chosen], grids, boxes[chosen])


def _corners(table: np.ndarray) -> np.ndarray:
    """Corners [n, 4] of boxes of which the first columns are centre x, y, width and height."""
    centre, half = table[:, :2], table[:, 2:4] / 2
    return np.concatenate([centre - half, centre + half], axis=1)


def _are_corners(table: np.ndarray) -> bool:
    """Whether rows [n, 6 + m] are of non-maximum suppression: corners in order, and whole numbers of classes. Of a raw
    table of v5 the sixth column is a score between 0 and 1, and hardly ever 0 or 1 in all of its thousands of rows."""
    whole = table[:, 5] == np.round(table[:, 5])
    return bool((whole & (table[:, 2:4] >= table[:, :2]).all(1)).all())


def mask_candidates(
    masks: np.ndarray, scores: np.ndarray, size: tuple[int, int], threshold: float, count: int
) -> MaskCandidates:
    """Of a model that gives whole masks, as exports of the SAM family with a built-in grid of points do.

    Args:
        masks: [1, n, h, w], [n, 1, h, w] or [n, h, w] over the whole input: logits, probabilities, or 0 and 1.
        scores: n of them.
        size: (width, height) of the input.
        threshold: lowest score.
        count: of candidates, at most.

    Raises:
        ConfigError: there are not as many scores as masks.
    """
    stack, flat = masks.reshape(-1, *masks.shape[-2:]), scores.reshape(-1).astype(np.float32)
    if len(stack) != len(flat):
        raise ConfigError(f"expected a score for each mask, found scores {scores.shape} and masks {masks.shape}")
    chosen = best(flat, threshold, count)
    grids = stack[chosen].astype(np.float32)
    if grids.size and grids.min() >= 0 and grids.max() <= 1:  # no logits
        grids -= 0.5
    boxes = np.tile(np.array([0, 0, *size], np.float32), (len(chosen), 1))
    return MaskCandidates(flat[chosen], grids, boxes)
