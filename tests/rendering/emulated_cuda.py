# SPDX-License-Identifier: Apache-2.0
"""The CUDA rasterizer's own sources compiled for the CPU, over the emulation in cuda_emulation/."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import pytest

from ggslam.rendering.cuda.compiler import KERNELS
from ggslam.rendering.cuda.library import CudaLibrary
from ggslam.rendering.cuda.rasterizer import CudaRasterizer

EMULATION = Path(__file__).parent / "cuda_emulation"
FLAGS = ("-std=c++17", "-O2", "-march=native", "-fPIC", "-Wno-unknown-pragmas", "-DGGSLAM_CUDA_EMULATION")


@lru_cache(maxsize=1)
def emulated_library() -> CudaLibrary:
    """Compiles and loads; skips the calling test where there is no g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ to compile the emulation of CUDA with")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "emulated.so"
        sources = [path for path in sorted(KERNELS.glob("*.cu")) if path.name != "sorting.cu"]
        sources += [EMULATION / "fibers.cpp", EMULATION / "sorting_on_cpu.cpp"]
        command = [compiler, *FLAGS, "-I", str(EMULATION), "-I", str(KERNELS), "-include", "cuda_on_cpu.hpp"]
        command += ["-shared", "-x", "c++", *map(str, sources), "-o", str(library)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        return CudaLibrary(library, device_type="cpu")  # stays loaded after the file is gone


def emulated_rasterizer(**options: float) -> CudaRasterizer:
    return CudaRasterizer("cpu", library=emulated_library(), **options)
