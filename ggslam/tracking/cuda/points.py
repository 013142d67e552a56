# SPDX-License-Identifier: Apache-2.0
"""Points of a frame that stay on the device until someone on the host looks at them."""

from __future__ import annotations

from ctypes import sizeof
from itertools import accumulate
from typing import Any

import numpy as np
import torch

from ggslam.interface.cuda.tracking import PointArrays, PointsHeader
from ggslam.tracking.points import FramePoints

_ROWS = {"points": 3, "normals": 3, "covariances": 6, "pixels": 2, "weights": 1}
_BEGIN = 64
"""Words before the arrays, of which the header takes the first two."""


class DevicePoints(FramePoints):
    """`FramePoints` on a device. The arrays, which keyframes and loops need, come to the host with the frame's
    alignment; before it they are fetched, all at once, when any of them is first asked for. So are their number and
    median depth.

    Args:
        room: points at most; their number is known to the device alone.
        device: where they are.
    """

    room: int
    _block: torch.Tensor
    _begins: dict[str, int]
    _header: tuple[int, float] | None
    _copy: torch.Tensor | None
    """On the host; filled when the device has come to it."""

    def __init__(self, room: int, device: torch.device) -> None:
        words = torch.empty(_BEGIN + room * sum(_ROWS.values()), dtype=torch.float32, device=device)
        begins = dict(zip(_ROWS, accumulate((room * width for width in _ROWS.values()), initial=_BEGIN), strict=False))
        for name, value in (
            ("room", room), ("_block", words), ("_begins", begins), ("_header", None), ("_copy", None)
        ):  # fmt: skip
            object.__setattr__(self, name, value)

    def arrays(self) -> PointArrays:
        """Addresses on the device; this object must stay alive."""
        begin = self._block.data_ptr()
        return PointArrays(begin, *(begin + 4 * offset for offset in self._begins.values()))

    def send(self) -> None:
        """Starts to copy the arrays to the host."""
        if self._copy is None and self._block.device.type == "cuda":
            copy = torch.empty(self._block.shape, dtype=self._block.dtype, pin_memory=True)
            object.__setattr__(self, "_copy", copy.copy_(self._block, non_blocking=True))

    def settle(self, count: int, median_depth: float) -> None:
        """Takes what the device says of the points, once it is known; what was sent has arrived then."""
        object.__setattr__(self, "_header", (count, median_depth))

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

    def __getattr__(self, name: str) -> Any:
        """The arrays, at the first look at any of them."""
        if name not in _ROWS:
            raise AttributeError(name)
        arrived = self._copy is not None and self._header is not None
        words = (self._copy if self._copy is not None and arrived else self._block.cpu()).numpy()
        count, _ = self._header_of(words)
        for field, offset in self._begins.items():
            width = _ROWS[field]
            rows = words[offset : offset + width * count]
            rows = rows.view(np.int32) if field == "pixels" else rows
            object.__setattr__(self, field, rows.reshape(count, width) if width > 1 else rows)
        return object.__getattribute__(self, name)

    def _known_header(self) -> tuple[int, float]:
        if self._header is None:
            self.settle(*self._header_of(self._block[: sizeof(PointsHeader) // 4].cpu().numpy()))
        assert self._header is not None
        return self._header

    @staticmethod
    def _header_of(words: np.ndarray) -> tuple[int, float]:
        return int(words[:1].view(np.int32)[0]), float(words[1])
