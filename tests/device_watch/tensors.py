# SPDX-License-Identifier: Apache-2.0
"""Tensors that say they are on a CUDA device while their data are in host memory."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

import torch

if TYPE_CHECKING:
    from device_watch import DeviceWatch

DEVICE = torch.device("cuda", 0)


class DeviceTensor(torch.Tensor):
    """A tensor whose device is `DEVICE`. Usable only while a `DeviceWatch` is active; `host` is the tensor on the CPU
    that holds its values and shares its memory."""

    host: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, host: torch.Tensor) -> DeviceTensor:
        tensor = torch.Tensor._make_subclass(cls, host, False, dispatch_device=True, device_for_backend_keys=DEVICE)
        tensor.host = host
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """For threads in which the watch's own mode is not active."""
        if func is torch.ops.prim.device.default:
            return DEVICE
        return active_watch().dispatch(func, args, kwargs or {})

    def __repr__(self, **_: Any) -> str:
        return f"DeviceTensor({self.host!r})"

    def tolist(self) -> Any:
        active_watch().record_wait("tolist")
        return self.host.tolist()

    def numpy(self, **_: Any) -> NoReturn:
        raise TypeError(f"can't convert {DEVICE} device type tensor to numpy")

    def __array__(self, *_: Any, **__: Any) -> NoReturn:
        self.numpy()

    def record_stream(self, stream: object) -> None:
        """Only noted: memory of the host is never used too early."""
        active_watch().note_kept()


_watches: list[weakref.ref[DeviceWatch]] = []


def active_watch() -> DeviceWatch:
    """The innermost `DeviceWatch`."""
    watch = _watches[-1]() if _watches else None
    if watch is None:
        raise RuntimeError("a DeviceTensor is used outside of its DeviceWatch")
    return watch


class DeviceMemory:
    """Where tensors of the device lie.

    Args:
        released: is told of memory that no tensor has any more, by its address.
    """

    def __init__(self, released: Callable[[int], None]) -> None:
        self._storages: dict[int, list[int]] = {}  # address: bytes, tensors alive
        self._released = released

    def wrap(self, host: torch.Tensor) -> DeviceTensor:
        """The tensor as one of the device."""
        tensor, storage = DeviceTensor(host), host.untyped_storage()
        place = self._storages.setdefault(storage.data_ptr(), [0, 0])
        place[0] = max(place[0], storage.nbytes())
        place[1] += 1
        weakref.finalize(tensor, self._release, storage.data_ptr())
        return tensor

    def _release(self, address: int) -> None:
        place = self._storages[address]
        place[1] -= 1
        if place[1] == 0:
            del self._storages[address]
            self._released(address)

    def place_of(self, address: int) -> int | None:
        """Where the memory of a tensor that is alive begins that has this address; None: there is none."""
        found = (start for start, (size, _) in list(self._storages.items()) if start <= address < start + size)
        return next(found, None)
