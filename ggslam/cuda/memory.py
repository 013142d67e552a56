# SPDX-License-Identifier: Apache-2.0
"""Device memory for the kernels. All of it is torch's own."""

from __future__ import annotations

import threading

import numpy as np
import torch


def address(tensor: torch.Tensor | None) -> int | None:
    """Of a tensor's first element; null for None."""
    return None if tensor is None else tensor.data_ptr()


class GrowingMemory:
    """Bytes on a device that are kept from one rendering to the next and grow by a quarter more than is asked for.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._blocks: dict[str, torch.Tensor] = {}

    def block(self, name: str, size: int) -> torch.Tensor:
        """uint8 [at least `size`] of that name; its content is undefined."""
        block = self._blocks.get(name)
        if block is None or block.numel() < size:
            self._blocks.pop(name, None)  # free before asking for more
            block = self._blocks[name] = torch.empty(size + size // 4, dtype=torch.uint8, device=self._device)
        return block


def upload(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """A copy of an array on the device, for which the host does not wait: it goes by way of page-locked memory, which
    torch keeps for the next one."""
    tensor = torch.from_numpy(np.ascontiguousarray(array))
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
    done = torch.cuda.Event()
    done.record()
    done.synchronize()
    return [copy.numpy() for copy in copies]


class HostMirror:
    """Numbers of a device tensor as they were some moments ago, at hand without waiting; also in other threads than the
    one that sends them.

    Args:
        source: the tensor.
    """

    def __init__(self, source: torch.Tensor) -> None:
        self._source = source
        on_gpu = source.device.type == "cuda"
        self._arriving = torch.zeros(source.shape, dtype=source.dtype, pin_memory=on_gpu)
        self._event = torch.cuda.Event() if on_gpu else None
        self._under_way = False
        self._lock = threading.Lock()
        self._newest = self._arriving.numpy().copy()

    def send(self) -> None:
        """Starts a copy on the current stream, unless one is still under way."""
        with self._lock:
            self._take()
            if self._under_way:
                return
            self._arriving.copy_(self._source, non_blocking=True)
            if self._event is not None:
                self._event.record()
            self._under_way = True

    def newest(self) -> np.ndarray:
        """The numbers of the last copy that has arrived; zeros before the first."""
        with self._lock:
            self._take()
            return self._newest

    def _take(self) -> None:
        if self._under_way and (self._event is None or self._event.query()):
            self._newest = self._arriving.numpy().copy()
            self._under_way = False
