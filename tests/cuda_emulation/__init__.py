# SPDX-License-Identifier: Apache-2.0
"""The CUDA sources compiled for the CPU, over an emulation of CUDA: what `cuda_library` gives where there is no GPU."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import pytest
from kept import one_at_a_time

from ggslam.cuda.compiler import common_arguments, source_files, translation_units
from ggslam.cuda.library import CudaLibrary

EMULATION = Path(__file__).parent
CHECKED = "alignment,bounds,float-cast-overflow,integer-divide-by-zero,shift,signed-integer-overflow"
"""What ends the process if a kernel does it: above all vectors at addresses that are no multiple of their size, which
a GPU refuses, and indices beyond an array in shared memory."""
FLAGS = (
    "-std=c++17", "-O2", "-march=native", "-fPIC", "-Wno-unknown-pragmas", "-DGGSLAM_CUDA_EMULATION",
    f"-fsanitize={CHECKED}", "-fno-sanitize-recover=all",
)  # fmt: skip

KEPT = EMULATION.parents[1] / "build" / "cuda_emulation"
"""Compiled libraries of this checkout, by what they were compiled from."""


@lru_cache(maxsize=1)
def emulated_library() -> CudaLibrary:
    """Compiles, if these sources were not yet, and loads; skips the calling test where there is no g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ to compile the emulation of CUDA with")
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for source in [*source_files(), *sorted(EMULATION.glob("*.?pp"))]:
        digest.update(source.read_bytes())
    library = KEPT / f"{digest.hexdigest()[:16]}.so"
    with one_at_a_time(library):
        if not library.exists():
            with tempfile.TemporaryDirectory(dir=KEPT) as folder:
                _compile(compiler, Path(folder)).replace(library)
    return CudaLibrary(library, device_type="cpu")


def _compile(compiler: str, folder: Path) -> Path:
    sources = [path for path in translation_units() if path.name != "sorting.cu"]
    sources += [EMULATION / "fibers.cpp", EMULATION / "sorting_on_cpu.cpp"]
    command = [compiler, *FLAGS, "-I", str(EMULATION), *common_arguments(), "-include", "cuda_on_cpu.hpp"]
    objects = [folder / f"{source.stem}.o" for source in sources]
    running = [
        subprocess.Popen([*command, "-c", "-x", "c++", str(source), "-o", str(made)], stderr=subprocess.PIPE, text=True)
        for source, made in zip(sources, objects, strict=True)
    ]
    for compiling in running:
        errors = compiling.communicate()[1]
        assert compiling.returncode == 0, errors
    library = folder / "emulated.so"
    subprocess.run([compiler, "-shared", f"-fsanitize={CHECKED}", *map(str, objects), "-o", str(library)], check=True)
    return library
