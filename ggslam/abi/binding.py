# SPDX-License-Identifier: Apache-2.0
"""Declares the functions of a compiled library as its headers do, and refuses a library that was compiled from others.

`core/` has the headers of the compiled core, `cuda/` those of the CUDA kernels.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from ggslam.abi import core, cuda
from ggslam.abi.headers import Declarations
from ggslam.errors import CoreInputError, CoreMemoryError, NativeCoreError

_FAULTS = {core.CoreFault.BAD_INPUT: CoreInputError, core.CoreFault.MEMORY_RAN_OUT: CoreMemoryError}
_LONGEST_MESSAGE: Final = 512


def core_hash() -> str:
    """The version of the core's interface: SHA-256 of its headers, as CMakeLists.txt computes it."""
    return _hash_of_headers(core.DECLARED)


def cuda_hash() -> str:
    """The version of the kernels' interface, whose headers include some of the core's."""
    return _hash_of_headers(core.DECLARED, cuda.DECLARED)


def bind_core(library: ctypes.CDLL) -> None:
    """Declares the functions of the compiled core, which raise from then on what they fail with: a `CoreInputError`, a
    `CoreMemoryError` or another `NativeCoreError`.

    Raises:
        NativeCoreError: it was compiled from other headers, or lays structures out in another way.
    """
    remedy = "run `bash scripts/build_native.sh` in a checkout, else `pip install` ggslam anew"
    _bind(library, "ggslam", core_hash(), core.DECLARED, remedy)
    check = _make_check(library)
    for name in core.DECLARED.functions:
        getattr(library, name).errcheck = check
    del library.ggslam_last_error.errcheck


def bind_cuda(library: ctypes.CDLL) -> None:
    """Declares the functions of the compiled kernels.

    Raises:
        NativeCoreError: they were compiled from other headers, or lay structures out in another way.
    """
    _bind(library, "ggslam_cuda", cuda_hash(), cuda.DECLARED, "remove the file, it will be compiled anew")


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
        if fault == core.CoreFault.NO_FAULT:
            return result
        raise _FAULTS.get(fault, NativeCoreError)(f"{function.__name__}: {message.value.decode(errors='replace')}")

    return check


def check_sizes(name: str, structures: Mapping[str, type[ctypes.Structure]], found: Sequence[int]) -> None:
    """Compares structures with those of the compiler.

    Args:
        name: of the library, for the message.
        structures: by name, in the order of the headers.
        found: size of each, bytes.

    Raises:
        NativeCoreError: they differ.
    """
    if len(found) != len(structures):
        raise NativeCoreError(f"{name}: expected {len(structures)} structures, found {len(found)}")
    for (structure, mirror), size in zip(structures.items(), found, strict=True):
        if size != ctypes.sizeof(mirror):
            raise NativeCoreError(f"{name}: {structure}: expected {ctypes.sizeof(mirror)} bytes, found {size}")


def _hash_of_headers(*sides: Declarations) -> str:
    return hashlib.sha256("".join(line for side in sides for line in side.lines).encode()).hexdigest()


def _bind(library: ctypes.CDLL, prefix: str, expected: str, declared: Declarations, remedy: str) -> None:
    tell = getattr(library, f"{prefix}_abi_hash", None)
    if tell is not None:
        tell.restype, tell.argtypes = ctypes.c_char_p, []
    found = "no version" if tell is None else f"version {tell().decode()}"
    if found != f"version {expected}":
        raise NativeCoreError(
            f"{library._name}: the compiled library's interface has {found[:20]}, expected {expected[:12]}: {remedy}"
        )
    for name, (result, arguments) in declared.functions.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    sizes = getattr(library, f"{prefix}_structure_sizes")
    sizes.restype = ctypes.POINTER(ctypes.c_size_t)
    count = ctypes.c_int()
    check_sizes(library._name, declared.structures, sizes(ctypes.byref(count))[: count.value])
