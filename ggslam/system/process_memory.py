# SPDX-License-Identifier: Apache-2.0
"""Measures the memory of this process and gives back what it does not use."""

from __future__ import annotations

import ctypes
import os
import resource
import sys
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final

from ggslam.system.tuning import Tuning

_TRIM_THRESHOLD: Final = -1
"""M_TRIM_THRESHOLD of glibc's `mallopt`."""
_MMAP_THRESHOLD: Final = -3
"""M_MMAP_THRESHOLD of glibc's `mallopt`."""


class MemoryTuning(Tuning):
    """Which memory is given back early."""

    large_bytes = 1 << 18
    """Bytes from which an array's memory goes back to the system at once."""


_CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")
_OWN_MEMORY = b"/proc/self/statm"
_Text = ctypes.c_char * 256


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far."""
    try:  # the system's accounts begin with the memory of the process that started this one
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:", 1)[1].split(maxsplit=1)[0])
    except (OSError, ValueError, IndexError):
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def peak_memory_mb() -> float:
    """The same in MB (10^6 bytes)."""
    return peak_memory_bytes() / 1e6


def resident_bytes() -> int:
    """Resident memory of this process now; where the system does not tell, the largest so far."""
    # Every frame asks. These calls keep Python's lock: they take microseconds, and whoever lets go of it may wait a
    # hundred times as long until another thread does the same.
    system, text = _system(), _Text()
    file = system.open(_OWN_MEMORY, os.O_RDONLY)
    if file >= 0:
        system.read(file, text, len(text) - 1)
        system.close(file)
    try:
        return int(text.value.split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, IndexError):
        return peak_memory_bytes()


def most_memory_bytes() -> int:
    """Memory that this process can have at most, however much of it is in use: the machine's, or its container's."""
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError, ValueError):  # no container, or "max"
        limits.append(int(_CONTAINER_LIMIT.read_text()))
    return min(limits)


def trim() -> None:
    """Hands freed memory back to the system, where the C library can (glibc keeps much of it for itself)."""
    release = getattr(_c_library(), "malloc_trim", None)
    if release is not None:
        release(0)


def release_early() -> None:
    """From now on memory of large arrays goes back to the system as soon as they are freed, where the C library can be
    told so (glibc otherwise keeps more and more of them for itself). Costs some time, but not what is computed."""
    adjust = getattr(_c_library(), "mallopt", None)
    if adjust is not None:
        adjust(_MMAP_THRESHOLD, MemoryTuning.large_bytes)
        adjust(_TRIM_THRESHOLD, MemoryTuning.large_bytes)


@lru_cache(maxsize=1)
def _system() -> ctypes.PyDLL:
    """Functions of the C library, called without letting go of Python's lock."""
    return ctypes.PyDLL(None)


def _c_library() -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(None)
    except (OSError, TypeError):
        return None
