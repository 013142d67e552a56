# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a recording's frames show something that moves, as a run found them: frames that are read again later
come without it.

In a file: NumPy's npz with `frames` int32 [n], `size` int32 [2] (rows, columns), `data` uint8 and `offsets` int64
[n + 1]: bytes offsets[i] to offsets[i + 1] are zlib's of the mask of frame i, a bit for each pixel row by row, in a
byte the highest first.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

import cv2
import numpy as np

from ggslam.errors import FormatError
from ggslam.scene.frame import Frame
from ggslam.system.array_forms import Form
from ggslam.system.images import PictureLimits
from ggslam.system.savable import savable

MOVERS_FILE = "movers.npz"
"""Of runs in which something was found to move."""


@savable(fixed="masks")
@dataclass
class MovingPixels:
    """Masks by frame, a bit for each pixel.

    Attributes:
        frames: their indices (`Frame.index`), in the order in which they came.
        masks: uint8 [], of each: zlib's of a bit for each pixel.
        size: (H, W).
    """

    frames: list[int] = field(default_factory=list)
    masks: list[Annotated[np.ndarray, Form("u1", None)]] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)

    def __len__(self) -> int:
        return len(self.frames)

    def add(self, frame: int, mask: np.ndarray) -> None:
        """Takes note of a frame's mask, bool [H, W]; all are of one size."""
        self.size = (mask.shape[0], mask.shape[1])
        self.frames.append(frame)
        self.masks.append(np.frombuffer(zlib.compress(np.packbits(mask).tobytes()), np.uint8))

    def mask(self, frame: int, shape: tuple[int, int]) -> np.ndarray | None:
        """The mask of a frame for images of a size, bool [H, W]; None: nothing moves."""
        if frame not in self.frames:
            return None
        height, width = self.size
        packed = np.frombuffer(_unpack(self.masks[self.frames.index(frame)], (height * width + 7) // 8), np.uint8)
        found = np.unpackbits(packed, count=height * width).reshape(height, width)
        if shape == self.size:
            return found > 0
        return np.asarray(cv2.resize(found, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST) > 0)

    def without(self, frame: Frame) -> Frame:
        """A frame without depth and ids where something moves, which `Frame.moving` tells."""
        moving = self.mask(frame.index, (frame.depth.shape[0], frame.depth.shape[1]))
        if moving is None:
            return frame
        load, ids = frame.mask_loader, frame.mask
        return replace(
            frame, depth=np.where(moving, np.float32(0), frame.depth), moving=moving,
            no_return=None if frame.no_return is None else frame.no_return & ~moving,
            mask=None if ids is None else _unlabel(ids, moving),
            mask_loader=None if load is None else partial(_load_unlabelled, load, moving),
        )  # fmt: skip

    @staticmethod
    def concatenate(parts: Iterable[tuple[int, MovingPixels | None]]) -> MovingPixels:
        """Of several runs as one, each with the number that its first frame has there. Masks of another size than the
        first ones are left out."""
        found = MovingPixels()
        for begin, part in parts:
            if part is not None and len(part) and found.size in ((0, 0), part.size):
                found.frames += [begin + frame for frame in part.frames]
                found.masks, found.size = found.masks + part.masks, part.size
        return found

    def select(self, selection: range) -> MovingPixels:
        """Of some of the frames, which are counted from 0 again."""
        kept = [(selection.index(frame), mask) for frame, mask in zip(self.frames, self.masks, strict=True)
                if frame in selection]  # fmt: skip
        return MovingPixels([frame for frame, _ in kept], [mask for _, mask in kept], self.size)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """For a file."""
        offsets = np.cumsum([0, *map(len, self.masks)]).astype(np.int64)
        data = np.concatenate([np.zeros(0, np.uint8), *self.masks])
        size = np.array(self.size, np.int32)
        return {"frames": np.array(self.frames, np.int32), "size": size, "offsets": offsets, "data": data}

    @staticmethod
    def from_arrays(arrays: Mapping[str, np.ndarray]) -> MovingPixels:
        """What `to_arrays` gave.

        Raises:
            FormatError: it is not that.
        """
        names = ("frames", "size", "offsets", "data")
        frames, size, offsets, data = (np.asarray(arrays.get(name)) for name in names)
        typed = [array.dtype for array in (frames, size, offsets, data)] == [np.int32, np.int32, np.int64, np.uint8]
        shaped = typed and size.shape == (2,) and data.ndim == frames.ndim == 1 and offsets.shape == (len(frames) + 1,)
        if not shaped or not (size >= 1).all() or int(size[0]) * int(size[1]) > PictureLimits.max_pixels:
            raise FormatError("no masks of frames")
        if offsets[0] != 0 or offsets[-1] != len(data) or (np.diff(offsets) < 0).any():
            raise FormatError("offsets of masks that do not fit their data")
        found = MovingPixels(frames.tolist(), np.split(data, offsets[1:-1]), (int(size[0]), int(size[1])))
        for mask in found.masks:
            _unpack(mask, (int(size[0]) * int(size[1]) + 7) // 8)
        return found


def _unlabel(ids: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """A mask of objects, uint16 [H, W], without what moves; one of another size is left to those who check it."""
    return np.where(moving, np.uint16(0), ids) if ids.shape == moving.shape else ids


def _load_unlabelled(load: Callable[[], np.ndarray | None], moving: np.ndarray) -> np.ndarray | None:
    ids = load()
    return None if ids is None else _unlabel(ids, moving)


def _unpack(mask: np.ndarray, length: int) -> bytes:
    """So many bytes that were packed.

    Raises:
        FormatError: it is damaged.
    """
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(mask.tobytes(), length)
    except zlib.error as error:
        raise FormatError(f"a mask that is damaged ({error})") from None
    if len(found) != length:
        raise FormatError("a mask of another size")
    return found
