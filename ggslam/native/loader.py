# SPDX-License-Identifier: Apache-2.0
"""Finds and loads the compiled core, and hands out the context (threads, instruction set) its functions run in."""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from functools import lru_cache
from pathlib import Path

from ggslam.abi.binding import bind_core
from ggslam.errors import NativeCoreError
from ggslam.system.forks import refuse_lost_threads

INSTRUCTION_SETS = ("baseline", "avx2", "avx512")
_LIBRARY_NAMES = ("libggslam_core.so", "libggslam_core.dylib")
_HERE = Path(__file__).parent


@lru_cache(maxsize=1)
def load_library() -> ctypes.CDLL:
    """The compiled core, its functions declared. `GGSLAM_CORE` in the environment names another file than the installed
    one.

    Raises:
        NativeCoreError: no library, or one of another interface.
    """
    candidates = [Path(os.environ["GGSLAM_CORE"])] if "GGSLAM_CORE" in os.environ else []
    candidates += [_HERE / "_lib" / name for name in _LIBRARY_NAMES]
    found = next((path for path in candidates if path.exists()), None)
    library = _installed_library() if found is None else ctypes.CDLL(str(found))
    if library is None:
        raise NativeCoreError(
            f"the compiled core is missing (looked for {', '.join(map(str, candidates))}, and for an installed package "
            "of these sources): run `pip install .` or, in a checkout, `bash scripts/build_native.sh`"
        )
    bind_core(library)
    return library


def _installed_library() -> ctypes.CDLL | None:
    """The core of an installed ggslam, for a checkout that has none of its own, if it was compiled from the checkout's
    sources."""
    for folder in map(Path, sys.path):
        for name in _LIBRARY_NAMES:
            path = folder / "ggslam" / "native" / "_lib" / name
            if path.is_file():
                library = ctypes.CDLL(str(path))
                tell = getattr(library, "ggslam_source_hash", None)
                if tell is not None:
                    tell.restype = ctypes.c_char_p
                    return library if tell().decode() == source_hash(_HERE.parent) else None
    return None


def source_hash(package: Path) -> str:
    """SHA-256 of the C++ sources in a package's native/src, native/formulas and abi, as CMakeLists.txt computes it: of
    lines of path and SHA-256, sorted by path."""
    files = [p for folder in ("native/src", "native/formulas", "abi") for p in (package / folder).rglob("*.?pp")]
    paths = {p.relative_to(package).as_posix(): p for p in files}
    lines = [f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n" for name, path in sorted(paths.items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def available_instruction_sets() -> list[str]:
    """Names of the instruction sets that this processor and this build offer, narrowest first."""
    library = load_library()
    return [name for number, name in enumerate(INSTRUCTION_SETS) if library.ggslam_isa_available(number)]


class NativeContext:
    """Threads and instruction set for the kernels. One context serves one caller at a time; make one per thread.

    Args:
        threads: number of threads; None: the processors this process may use.
        instruction_set: one of `INSTRUCTION_SETS`; None: `GGSLAM_ISA` in the environment, else the widest available.
    """

    def __init__(self, threads: int | None = None, instruction_set: str | None = None) -> None:
        self._handle: int | None = None
        refuse_lost_threads()
        self._library = load_library()
        self.threads = threads if threads is not None else available_processors()
        if self.threads < 1:
            raise NativeCoreError(f"threads must be at least 1, found {self.threads}")
        name = instruction_set or os.environ.get("GGSLAM_ISA") or INSTRUCTION_SETS[self._library.ggslam_best_isa()]
        if name not in available_instruction_sets():
            raise NativeCoreError(
                f"instruction set {name!r} is not available here; available: {', '.join(available_instruction_sets())}"
            )
        self.instruction_set = name
        self._begin()

    def _begin(self) -> None:
        self._process = os.getpid()
        self._handle = self._library.ggslam_context_create(self.threads, INSTRUCTION_SETS.index(self.instruction_set))

    @property
    def handle(self) -> ctypes.c_void_p:
        """Pointer that the C functions take as their first argument."""
        if self._process != os.getpid():  # forked: the threads stayed in the parent
            refuse_lost_threads()
            self._begin()
        return ctypes.c_void_p(self._handle)

    def __del__(self) -> None:
        if self._handle is not None and self._process == os.getpid():  # a fork would wait for the parent's threads
            self._library.ggslam_context_destroy(self._handle)


def available_processors() -> int:
    """Number of processors this process may run on."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        return os.cpu_count() or 1
