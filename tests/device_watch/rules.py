# SPDX-License-Identifier: Apache-2.0
"""Which operations of torch wait for a CUDA device, and which take tensors of both sides, by torch's sources."""

from __future__ import annotations

from typing import Any

import torch

from device_watch.records import DeviceMixing
from device_watch.tensors import DeviceTensor

WAITING = {
    "_linalg_check_errors", "_linalg_eigh", "_linalg_svd", "_local_scalar_dense", "_unique", "_unique2", "bincount",
    "equal", "histc", "linalg_eig", "linalg_lstsq", "masked_select", "nonzero", "unique_consecutive", "unique_dim",
    "unique_dim_consecutive",
}  # fmt: skip
"""Operations whose result, its size or whose errors the host has to know."""

TAKE_NUMBERS = {"fill", "fill_", "masked_fill", "masked_fill_"}
"""Operations, besides pointwise ones, that take a number of the host (a tensor of no dimensions) beside tensors of the
device."""

FEW_OPERATIONS = (torch.uint16, torch.uint32, torch.uint64)
OF_ALL_TYPES = {
    "_local_scalar_dense",
    "_to_copy",
    "clone",
    "copy_",
    "empty",
    "empty_like",
    "empty_strided",
    "new_empty",
}
"""Operations, besides views, that torch surely has for `FEW_OPERATIONS` on CUDA devices."""

NO_WORK = {"detach", "device", "empty", "empty_like", "empty_strided", "new_empty", "record_stream", "set_"}
"""Operations, besides views, that look at no values."""

INDEXING = {"index", "_unsafe_index", "index_put", "index_put_", "_index_put_impl_"}
MASKS = (torch.bool, torch.uint8)


def waits(func: Any, args: tuple[Any, ...]) -> bool:
    """Whether the host waits for the result of an operation on tensors of the device."""
    name = func.overloadpacket.__name__
    if not any(isinstance(value, DeviceTensor) for value in args[:2]):
        return False
    if name in INDEXING:
        return any(index is not None and index.dtype in MASKS for index in args[1]) and not _fills_mask(name, args)
    if name == "repeat_interleave":  # how many there will be, unless that is said
        return len(args) < 2 or args[1] is None
    if name == "isin":  # of many elements, by torch.unique
        sizes = [value.numel() if isinstance(value, torch.Tensor) else 1 for value in args[:2]]
        return sizes[1] >= 10 * sizes[0] ** 0.145
    return name in WAITING


def _fills_mask(name: str, args: tuple[Any, ...]) -> bool:
    """x[mask] = number."""
    if not name.startswith(("index_put", "_index_put")):
        return False
    indices, value = [index for index in args[1] if index is not None], args[2]
    number = value.numel() == 1 and not isinstance(value, DeviceTensor)
    return number and len(indices) == 1 and not (len(args) > 3 and args[3])


def host_indices(name: str, args: tuple[Any, ...]) -> list[torch.Tensor]:
    """Indices, and values put, that torch brings to the device of what they index."""
    if name not in INDEXING or not isinstance(args[0], DeviceTensor):
        return []
    moved = [index for index in args[1] if index is not None and not isinstance(index, DeviceTensor)]
    if len(args) > 2 and not isinstance(args[2], DeviceTensor) and not _fills_mask(name, args):
        moved.append(args[2])
    return moved


def check_type(func: Any, tensors: list[torch.Tensor], device: torch.device | None, dtype: torch.dtype | None) -> None:
    """Raises NotImplementedError for an operation on unsigned numbers that a CUDA device may not have."""
    types = {tensor.dtype for tensor in tensors if isinstance(tensor, DeviceTensor)}
    if device is not None and device.type == "cuda":
        types.add(dtype)  # type: ignore[arg-type]
    name, results = func.overloadpacket.__name__, func._schema.returns
    view = any(result.alias_info is not None and not result.alias_info.is_write for result in results)
    if types.intersection(FEW_OPERATIONS) and not view and name not in OF_ALL_TYPES:
        raise NotImplementedError(f"{func}: torch may not have it for {types} on a CUDA device; take a view of int16")


def check_mixing(func: Any, tensors: list[torch.Tensor], args: tuple[Any, ...]) -> None:
    """Raises DeviceMixing if torch refuses these tensors together."""
    name = func.overloadpacket.__name__
    if not any(isinstance(tensor, DeviceTensor) for tensor in tensors):
        return
    if torch.Tag.inplace_view in func.tags or name in {"resize_", "set_"}:
        raise NotImplementedError(f"{name} of a DeviceTensor")
    host = [tensor for tensor in tensors if not isinstance(tensor, DeviceTensor)]
    if name in INDEXING and isinstance(args[0], DeviceTensor):
        host = [tensor for tensor in host if tensor.dim() > 0 and len(args) > 2 and tensor is args[2]]
    elif torch.Tag.pointwise in func.tags or name in TAKE_NUMBERS:
        written = isinstance(args[0], DeviceTensor) or not name.endswith("_")
        host = [tensor for tensor in host if tensor.dim() > 0 or not written]
    if host:
        shapes = ", ".join(f"{tensor.dtype} {list(tensor.shape)}" for tensor in host)
        raise DeviceMixing(f"{func}: beside tensors of the device, tensors of the host: {shapes}")
