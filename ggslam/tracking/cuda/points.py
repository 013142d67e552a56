# SPDX-License-Identifier: Apache-2.0
"""Points of a frame that stay on the device until the host reads them."""

from __future__ import annotations

from ctypes import sizeof
from itertools import accumulate
from typing import Final

import numpy as np
import torch

from ggslam.abi.cuda import PointArrays, PointsHeader
from ggslam.tracking.points import FramePoints

_ROWS = {"points": 3, "normals": 3, "covariances": 6, "pixels": 2, "weights": 1}
_BEGIN: Final = 64
"""Words before the arrays of the block. Its header takes the first two."""


class CudaPoints:
    """`FramePoints` on a device. They come to the host with the frame's alignment; before it their number and median
    depth, or all of them, are fetched when they are first asked for.

    Args:
        room: points at most; their number is known to the device alone.
        device: where they are.
    """

    def __init__(self, room: int, device: torch.device) -> None:
        self.room = room
        self._block = torch.empty(_BEGIN + room * sum(_ROWS.values()), dtype=torch.float32, device=device)
        sizes = (room * width for width in _ROWS.values())
        self._begins = dict(zip(_ROWS, accumulate(sizes, initial=_BEGIN), strict=False))
        self._header: tuple[int, float] | None = None
        self._copy: torch.Tensor | None = None  # on the host; filled when the device has come to it
        self._points: FramePoints | None = None

    def arrays(self) -> PointArrays:
        """Addresses on the device; this object must stay alive."""
        begin = self._block.data_ptr()
        return PointArrays(begin, *(begin + 4 * offset for offset in self._begins.values()))

    def send(self) -> None:
        """Starts to copy the arrays to the host."""
        if self._copy is None and self._block.device.type == "cuda":
            copy = torch.empty(self._block.shape, dtype=self._block.dtype, pin_memory=True)
            self._copy = copy.copy_(self._block, non_blocking=True)

    def set_header(self, count: int, median_depth: float) -> None:
        """Takes what the device says of the points, once it is known; what was sent has arrived then."""
        self._header = count, median_depth

    def __len__(self) -> int:
        """Waits for the device if the points were not aligned yet."""
        return self._known_header()[0]

    @property
    def median_depth(self) -> float:
        """Median depth in metres, 0 without points. Waits for the device if the points were not aligned yet."""
        return self._known_header()[1]

    def median_depth_if_known(self) -> float | None:
        """Median depth in metres; None before the points were aligned."""
        return None if self._header is None else self._header[1]

    def read(self) -> FramePoints:
        """The points on the host. Waits for the device unless what was sent has arrived."""
        if self._points is None:
            arrived = self._copy is not None and self._header is not None
            words = (self._copy if self._copy is not None and arrived else self._block.cpu()).numpy()
            count, _ = self._header_of(words)
            rows = {name: words[begin : begin + _ROWS[name] * count] for name, begin in self._begins.items()}
            self._points = FramePoints(
                rows["points"].reshape(-1, 3), rows["normals"].reshape(-1, 3), rows["covariances"].reshape(-1, 6),
                rows["pixels"].view(np.int32).reshape(-1, 2), rows["weights"],
            )  # fmt: skip
        return self._points

    def _known_header(self) -> tuple[int, float]:
        if self._header is None:
            self.set_header(*self._header_of(self._block[: sizeof(PointsHeader) // 4].cpu().numpy()))
        assert self._header is not None
        return self._header

    @staticmethod
    def _header_of(words: np.ndarray) -> tuple[int, float]:
        return int(words[:1].view(np.int32)[0]), float(words[1])
