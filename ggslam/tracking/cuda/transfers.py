# SPDX-License-Identifier: Apache-2.0
"""Copies between host and device that the host does not wait for, through page-locked memory."""

from __future__ import annotations

import numpy as np
import torch


class _Marker:
    """A point in the work of torch's current stream."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._event = torch.cuda.Event() if device.type == "cuda" else None

    def set(self) -> None:
        """Here."""
        if self._event is not None:
            self._event.record(torch.cuda.current_stream(self._device))

    def wait(self) -> None:
        """Until the device has come here; at once if the marker was never set."""
        if self._event is not None:
            self._event.synchronize()

    def wait_if_ahead(self) -> None:
        """As `wait`, for a place that the device has mostly passed long ago."""
        if self._event is not None and not self._event.query():
            self._event.synchronize()


def _page_locked(size: int, device: torch.device) -> torch.Tensor:
    return torch.empty(size, dtype=torch.uint8, pin_memory=device.type == "cuda")


class Upload:
    """Sends bytes to the device, again and again. The host waits only if the last ones are still on their way.

    Args:
        device: where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._buffer = _page_locked(1, device)
        self._sent = _Marker(device)

    def begin(self, size: int) -> np.ndarray:
        """uint8 [size] to be filled."""
        self._sent.wait_if_ahead()
        if self._buffer.numel() < size:
            self._buffer = _page_locked(size + size // 4, self._device)
        return self._buffer.numpy()[:size]

    def send(self, out: torch.Tensor) -> None:
        """Starts the copy of what was filled in to the beginning of it, as long as `out`, uint8 [n]."""
        out.copy_(self._buffer[: out.numel()], non_blocking=True)
        self._sent.set()


class Download:
    """Fetches float64 [count] from the device.

    Args:
        count: numbers.
        device: where from.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.source = torch.zeros(count, dtype=torch.float64, device=device)
        """On the device."""
        self._copy = _page_locked(8 * count, device).view(torch.float64)
        self._done = _Marker(device)

    def wait(self) -> np.ndarray:
        """What `source` is when everything started before is done: the host's one wait."""
        self._copy.copy_(self.source, non_blocking=True)
        self._done.set()
        self._done.wait()
        return self._copy.numpy().copy()
