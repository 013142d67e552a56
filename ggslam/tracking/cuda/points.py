# SPDX-License-Identifier: Apache-2.0
"""Points of a frame that stay on the device until the host reads them."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import sizeof
from typing import Final

import numpy as np

from ggslam.abi.cuda import PointArrays, PointsHeader
from ggslam.tracking.cuda.blocks import Block
from ggslam.tracking.cuda.fetches import Fetch, FetchRing
from ggslam.tracking.points import FramePoints

_WORDS: Final = {"points": 3, "normals": 3, "covariances": 6, "pixels": 2, "weights": 1}
_BEGIN: Final = 64
"""Words before the arrays of the block. Its header takes the first two."""
_BEFORE: Final = (0, 3, 6, 12, 14)
"""Words of a point before each of the arrays."""


def words_for(room: int) -> int:
    """Words of a block with room for so many points."""
    return _BEGIN + room * sum(_WORDS.values())


class CudaPoints:
    """`FramePoints` on a device, extracted when they are aligned or asked for. They come to the host when they are
    first read, their number and median depth with the frame's alignment.

    Args:
        room: points at most; their number is known to the device alone.
        block: see `words_for`.
        extract: has the points extracted.
        ring: for copies to the host.
    """

    def __init__(self, room: int, block: Block, extract: Callable[[CudaPoints], None], ring: FetchRing) -> None:
        self.room, self.block = room, block
        header, words = block.address, 4 * room
        first = header + 4 * _BEGIN
        self.arrays = PointArrays(
            header, first, first + 3 * words, first + 6 * words, first + 12 * words, first + 14 * words
        )
        """Addresses on the device, while this object is alive."""
        self.looks = False
        """Whether an alignment tells the medians of what was matched, see `expect_look`."""
        self.is_extracted = False
        """Whether the device was told to extract them."""
        self._extract = extract
        self._ring = ring
        self._header: tuple[int, float] | None = None
        self._fetch: Fetch | None = None
        self._points: FramePoints | None = None

    def expect_look(self) -> None:
        """See `PointSource`."""
        self.looks = True

    def send(self) -> None:
        """See `PointSource`."""
        self._ensure()
        if self._fetch is None and self._points is None and self.block.memory.device.type == "cuda":
            self._fetch = self._ring.start(self.block.memory[: words_for(self.room)])

    def set_header(self, count: int, median_depth: float) -> None:
        """Takes what the device says of the points, once it is known."""
        self._header = count, median_depth

    def note_aligned(self, count: int, median_depth: float) -> None:
        """The device has extracted and aligned them, and said this of them."""
        self.is_extracted, self._header = True, (count, median_depth)

    def __len__(self) -> int:
        """Waits for the device if the points were not aligned yet."""
        return self._known_header()[0]

    @property
    def median_depth(self) -> float:
        """Median depth in metres, 0 without points. Waits for the device if the points were not aligned yet."""
        header = self._header
        return self._known_header()[1] if header is None else header[1]

    def median_depth_if_known(self) -> float | None:
        """Median depth in metres; None before the points were aligned."""
        return None if self._header is None else self._header[1]

    def read(self) -> FramePoints:
        """The points on the host. Waits for the device unless what was sent has arrived."""
        if self._points is None:
            self._ensure()
            words = self._words()
            count, begins = self._header_of(words)[0], [_BEGIN + self.room * before for before in _BEFORE]
            rows = {
                name: words[begin : begin + width * count].copy()
                for begin, (name, width) in zip(begins, _WORDS.items(), strict=True)
            }
            self._points = FramePoints(
                rows["points"].reshape(-1, 3), rows["normals"].reshape(-1, 3), rows["covariances"].reshape(-1, 6),
                rows["pixels"].view(np.int32).reshape(-1, 2), rows["weights"],
            )  # fmt: skip
            self._fetch = None
        return self._points

    def _words(self) -> np.ndarray:
        """The block on the host."""
        fetch = self._fetch
        if fetch is not None:
            words = fetch.wait().numpy()
            if fetch.valid:
                return words
        return self.block.memory[: words_for(self.room)].cpu().numpy()

    def _ensure(self) -> None:
        if not self.is_extracted:
            self._extract(self)

    def _known_header(self) -> tuple[int, float]:
        if self._header is None:
            self._ensure()
            self.set_header(*self._header_of(self.block.memory[: sizeof(PointsHeader) // 4].cpu().numpy()))
        assert self._header is not None
        return self._header

    @staticmethod
    def _header_of(words: np.ndarray) -> tuple[int, float]:
        return int(words[:1].view(np.int32)[0]), float(words[1])
