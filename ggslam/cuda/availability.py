# SPDX-License-Identifier: Apache-2.0
"""Whether the CUDA kernels can be used here."""

from __future__ import annotations

from functools import lru_cache

import torch

from ggslam.cuda.compiler import find_nvcc, library_path
from ggslam.cuda.library import library_for_device
from ggslam.errors import MissingDependency

_TO_COMPILE = "will be compiled at first use"


def kernels_to_compile() -> bool:
    """Whether the kernels can be used on the current device and have to be compiled first, which takes a minute."""
    usable, state = describe_cuda_backend()
    return usable and _TO_COMPILE in state


@lru_cache(maxsize=1)
def cuda_backend_problem() -> str | None:
    """Why the backend "cuda" cannot be used on the current device; None if it can. Compiles it if that was not done
    yet; the answer is remembered."""
    try:
        library_for_device()
    except MissingDependency as error:
        return str(error)
    return None


def describe_cuda_backend() -> tuple[bool, str]:
    """Whether the backend "cuda" looks usable, and why; compiles nothing."""
    nvcc = find_nvcc()
    if nvcc is None:
        return False, "no nvcc to compile it with"
    if not torch.cuda.is_available():
        return False, f"no GPU in use; {nvcc} could compile it"
    major, minor = torch.cuda.get_device_capability()
    if major < 8:
        return False, f"the GPU's compute capability is {major}.{minor}; 8.0 is needed"
    try:
        path = library_path(nvcc, f"{major}{minor}")
    except MissingDependency as error:
        return False, str(error)
    state = "compiled" if path.exists() else _TO_COMPILE
    return True, f"sm_{major}{minor}, {state}: {path}"
