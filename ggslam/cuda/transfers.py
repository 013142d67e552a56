# SPDX-License-Identifier: Apache-2.0
"""Copies between host and device by way of page-locked memory, for which the host waits as little as can be: once
(`upload`, `download`), or again and again through the same memory (`Upload`, `Staging`, `Download`, `HostMirror`)."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
import torch


class Marker:
    """A point in the work of torch's current stream."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._event = torch.cuda.Event() if device.type == "cuda" else None

    def set(self) -> None:
        """Here."""
        if self._event is not None:
            self._event.record(torch.cuda.current_stream(self._device))

    def is_passed(self) -> bool:
        """Whether the device has come here; true if the marker was never set."""
        return self._event is None or self._event.query()

    def wait(self) -> None:
        """Until the device has come here; at once if the marker was never set."""
        if self._event is not None:
            self._event.synchronize()

    def wait_if_ahead(self) -> None:
        """As `wait`, for a place that the device has mostly passed long ago."""
        event = self._event
        if event is not None and not event.query():
            event.synchronize()


def _allocate_page_locked(size: int, device: torch.device) -> torch.Tensor:
    return torch.empty(size, dtype=torch.uint8, pin_memory=device.type == "cuda")


class Upload:
    """Sends bytes to the device, again and again. The host waits only if the last ones are still on their way.

    Args:
        device: where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._buffer = _allocate_page_locked(1, device)
        self._sent = Marker(device)

    def begin(self, size: int) -> np.ndarray:
        """uint8 [size] to be filled."""
        self._sent.wait_if_ahead()
        if self._buffer.numel() < size:
            self._buffer = _allocate_page_locked(size + size // 4, self._device)
        return self._buffer.numpy()[:size]

    def filled_part(self, size: int) -> torch.Tensor:
        """What was filled in, or its beginning, uint8 [size]; to be sent before the next `begin`."""
        return self._buffer[:size]

    def send(self, out: torch.Tensor) -> None:
        """Starts the copy of the beginning of what was filled in to `out`, uint8 [n], all of it."""
        self.send_part(self._buffer[: out.numel()], out)

    def send_part(self, filled: torch.Tensor, out: torch.Tensor) -> None:
        """The same for a `filled_part`, which another thread may have made, and `out` of its size."""
        out.copy_(filled, non_blocking=True)
        self._sent.set()


class Staging:
    """Sends arrays of one shape to the device, again and again, by turns through a few places. The host waits only if
    the one that went through the same place is still on its way.

    Args:
        shape: of an array.
        dtype: of its numbers.
        device: where to.
        places: how many may be on their way.
    """

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device, places: int = 2) -> None:
        made = [torch.empty(shape, dtype=dtype, pin_memory=device.type == "cuda") for _ in range(places)]
        self._places = deque((place, place.numpy(), Marker(device)) for place in made)

    def send(self, array: np.ndarray, out: torch.Tensor) -> None:
        """Starts a copy of an array to `out`, both of the shape; the array may be changed afterwards."""
        place, on_host, sent = self._places[0]
        self._places.rotate(-1)
        sent.wait_if_ahead()
        np.copyto(on_host, array)
        out.copy_(place, non_blocking=True)
        sent.set()


class Download:
    """Fetches numbers from the device, again and again.

    Args:
        count: of them.
        device: where from.
        dtype: of them.
    """

    def __init__(self, count: int, device: torch.device, dtype: torch.dtype = torch.float64) -> None:
        self.source = torch.zeros(count, dtype=dtype, device=device)
        """On the device, [count]."""
        self._copy = torch.zeros(count, dtype=dtype, pin_memory=device.type == "cuda")
        self.newest = self._copy.numpy()
        """On the host, as of the last `fetch`, which changes it in place."""
        self._done = Marker(device)

    def fetch(self) -> np.ndarray:
        """What `source` is when everything started before is done, in `newest`: the host's one wait."""
        self._copy.copy_(self.source, non_blocking=True)
        self._done.set()
        self._done.wait()
        return self.newest

    def wait(self) -> np.ndarray:
        """As `fetch`; the numbers stay as they are."""
        return self.fetch().copy()


def upload(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """A copy of an array on the device, for which the host does not wait: it goes by way of page-locked memory, which
    torch keeps for the next one."""
    tensor = torch.from_numpy(np.require(array, requirements=["C", "W"]))  # torch warns of arrays that are read-only
    if device.type != "cuda":
        return tensor.clone()
    return tensor.pin_memory().to(device, non_blocking=True)


def download(*tensors: torch.Tensor) -> list[np.ndarray]:
    """Copies of device tensors on the host, for which it waits once."""
    if tensors[0].device.type != "cuda":
        return [tensor.numpy().copy() for tensor in tensors]
    copies = [torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True) for tensor in tensors]
    for copy, tensor in zip(copies, tensors, strict=True):
        copy.copy_(tensor, non_blocking=True)
    done = Marker(tensors[0].device)
    done.set()
    done.wait()
    return [copy.numpy() for copy in copies]


class HostMirror:
    """Numbers of a device tensor as they were some moments ago, at hand without waiting; also in other threads than the
    one that sends them.

    Args:
        source: the tensor.
    """

    def __init__(self, source: torch.Tensor) -> None:
        self._source = source
        self._arriving = torch.zeros(source.shape, dtype=source.dtype, pin_memory=source.device.type == "cuda")
        self._arriving_numbers = self._arriving.numpy()
        self._sent = Marker(source.device)
        self._under_way = False
        self._lock = threading.Lock()
        self._newest = self._arriving_numbers.copy()

    def send(self) -> None:
        """Starts a copy on the current stream, unless one is still under way."""
        with self._lock:
            if self._under_way:
                self._take()
            if self._under_way:
                return
            self._arriving.copy_(self._source, non_blocking=True)
            self._sent.set()
            self._under_way = True

    def newest(self) -> np.ndarray:
        """The numbers of the last copy that has arrived; zeros before the first."""
        with self._lock:
            if self._under_way:
                self._take()
            return self._newest

    def _take(self) -> None:
        if self._sent.is_passed():
            self._newest = self._arriving_numbers.copy()
            self._under_way = False
