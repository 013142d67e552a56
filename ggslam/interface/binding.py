# SPDX-License-Identifier: Apache-2.0
"""Declares the functions of a compiled library as its headers do, and refuses a library that was compiled from others.

`core/` has the headers of the compiled core, `cuda/` those of the CUDA kernels, each with its Python mirror beside it;
both are written by `scripts/tools/make_native_mirrors.py`.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from types import ModuleType
from typing import Any

from ggslam.errors import CoreInputError, CoreMemoryError, NativeCoreError
from ggslam.interface.core import codec, common, mapping, movers, objects, rendering, tracking, volumes
from ggslam.interface.cuda import common as cuda_common
from ggslam.interface.cuda import mapping as cuda_mapping
from ggslam.interface.cuda import rendering as cuda_rendering
from ggslam.interface.cuda import tracking as cuda_tracking

CORE = (codec, common, mapping, movers, objects, rendering, tracking, volumes)
CUDA = (cuda_common, cuda_mapping, cuda_rendering, cuda_tracking)
_FAULTS = {common.CoreFault.BAD_INPUT: CoreInputError, common.CoreFault.MEMORY_RAN_OUT: CoreMemoryError}
_LONGEST_MESSAGE = 512
_PREFIXES = {"core": "ggslam", "cuda": "ggslam_cuda"}


def core_hash() -> str:
    """The version of the core's interface: SHA-256 of its headers, as CMakeLists.txt computes it."""
    return _hash_of_headers(CORE)


def cuda_hash() -> str:
    """The version of the kernels' interface, whose headers include some of the core's."""
    return _hash_of_headers((*CORE, *CUDA))


def bind_core(library: ctypes.CDLL) -> None:
    """Declares the functions of the compiled core, which raise from then on what they fail with: a `CoreInputError`, a
    `CoreMemoryError` or another `NativeCoreError`.

    Raises:
        NativeCoreError: it was compiled from other headers, or lays structures out in another way.
    """
    remedy = "run `bash scripts/build_native.sh` in a checkout, else `pip install` ggslam anew"
    _bind(library, "ggslam_interface_hash", core_hash(), CORE, remedy)
    check = _make_check(library)
    for part in CORE:
        for name in part.FUNCTIONS:
            getattr(library, name).errcheck = check
    del library.ggslam_last_error.errcheck


def bind_cuda(library: ctypes.CDLL) -> None:
    """Declares the functions of the compiled kernels.

    Raises:
        NativeCoreError: they were compiled from other headers, or lay structures out in another way.
    """
    _bind(library, "ggslam_cuda_interface_hash", cuda_hash(), CUDA, "remove the file, it will be compiled anew")


def _make_check(library: ctypes.CDLL) -> Callable[[Any, Any, tuple[Any, ...]], Any]:
    """What is called with the result of each function: raises if the function failed.

    A result that stands for a failure may also be one of several others that a function documents: whether the
    function failed is then what `ggslam_last_error` says, of the same thread.
    """
    unsigned = {c_type: 2 ** (8 * ctypes.sizeof(c_type)) - 1 for c_type in (ctypes.c_uint32, ctypes.c_uint64)}
    signs = dict.fromkeys((ctypes.c_int32, ctypes.c_int64), -1)
    failures: dict[Any, int | None] = {**unsigned, **signs, ctypes.c_void_p: None, ctypes.c_char_p: None}

    def check(result: Any, function: Any, _arguments: tuple[Any, ...]) -> Any:
        is_number = function.restype is ctypes.c_double
        if not (math.isnan(result) if is_number else result == failures[function.restype]):
            return result
        message = ctypes.create_string_buffer(_LONGEST_MESSAGE)
        fault = library.ggslam_last_error(message, _LONGEST_MESSAGE)
        if fault == common.CoreFault.NO_FAULT:
            return result
        raise _FAULTS.get(fault, NativeCoreError)(f"{function.__name__}: {message.value.decode(errors='replace')}")

    return check


def check_layout(name: str, mirrors: Sequence[type[ctypes.Structure]], found: Sequence[int]) -> None:
    """Compares mirrors with the compiler's structures.

    Args:
        name: of the library, for the message.
        mirrors: in the order of the header.
        found: for each the size and the offsets of all fields, bytes.

    Raises:
        NativeCoreError: they differ.
    """
    numbers = iter(found)
    for mirror in mirrors:
        expected = {"size": ctypes.sizeof(mirror)}
        expected |= {f"offset of {field[0]}": getattr(mirror, field[0]).offset for field in mirror._fields_}
        for what, value in expected.items():
            actual = next(numbers, None)
            if actual != value:
                raise NativeCoreError(f"{name}: {mirror.__name__}: {what} is {actual}, expected {value} bytes")
    if next(numbers, None) is not None:
        raise NativeCoreError(f"{name}: more structures than the {len(mirrors)} expected ones")


def _hash_of_headers(parts: Iterable[ModuleType]) -> str:
    lines = sorted(f"{part.HEADER} {part.HEADER_SHA256}\n" for part in parts)
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _bind(library: ctypes.CDLL, hash_name: str, expected: str, parts: Sequence[ModuleType], remedy: str) -> None:
    tell = getattr(library, hash_name, None)
    if tell is not None:
        tell.restype, tell.argtypes = ctypes.c_char_p, []
    found = "no version" if tell is None else f"version {tell().decode()}"
    if found != f"version {expected}":
        raise NativeCoreError(
            f"{library._name}: the compiled library's interface has {found[:20]}, expected {expected[:12]}: {remedy}"
        )
    for part in parts:
        for name, (result, arguments) in part.FUNCTIONS.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        if part.STRUCTURES:
            check_layout(library._name, part.STRUCTURES, _read_layout(library, part.HEADER))


def _read_layout(library: ctypes.CDLL, header: str) -> list[int]:
    side, part = header.removesuffix(".hpp").split("/")
    function = getattr(library, f"{_PREFIXES[side]}_{part}_layout")
    function.restype, function.argtypes = ctypes.POINTER(ctypes.c_size_t), [ctypes.c_void_p]
    count = ctypes.c_int()
    return function(ctypes.byref(count))[: count.value]
