# SPDX-License-Identifier: Apache-2.0
"""Compiles and loads no_op_guard.cpp where torch was built without CUDA."""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from kept import one_at_a_time

SOURCE = Path(__file__).with_name("no_op_guard.cpp")
KEPT = SOURCE.parents[2] / "build" / "device_watch"


@lru_cache(maxsize=1)
def register_guard() -> None:
    """Lets torch index tensors that say they are on a CUDA device; skips the calling test where there is no g++."""
    if torch.version.cuda is not None:
        torch._C._ensureCUDADeviceGuardSet()  # nothing where there is a GPU
        return
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ to compile a device guard with")
    digest = hashlib.sha256(SOURCE.read_bytes() + torch.__version__.encode()).hexdigest()[:16]
    library = KEPT / f"{digest}.so"
    with one_at_a_time(library):
        if not library.exists():
            with tempfile.TemporaryDirectory(dir=KEPT) as folder:
                _compile(compiler, Path(folder) / "guard.so").replace(library)
    ctypes.CDLL(str(library)).ggslam_register_guard()


def _compile(compiler: str, output: Path) -> Path:
    home, abi = Path(torch.__file__).parent, int(torch.compiled_with_cxx11_abi())
    command = [
        compiler, "-std=c++20", "-O1", "-fPIC", "-shared", f"-D_GLIBCXX_USE_CXX11_ABI={abi}",
        "-I", str(home / "include"), str(SOURCE), "-L", str(home / "lib"), "-lc10", "-o", str(output),
    ]  # fmt: skip
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return output
