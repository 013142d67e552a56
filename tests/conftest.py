# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest

if TYPE_CHECKING:
    from ggslam.cuda.library import CudaLibrary


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared recordings: `GGSLAM_DATA`, else `../shared/data` beside the checkout. Skips if absent."""
    folder = Path(os.environ.get("GGSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no shared recordings at {folder} (set GGSLAM_DATA)")
    return folder


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated recording: 24 frames of a furnished room, 160x120, with depth noise, exact poses and masks."""
    from ggslam.synthetic import write_synthetic_sequence

    folder = tmp_path_factory.mktemp("recordings") / "room"
    write_synthetic_sequence(folder, frames=24, width=160, height=120, seed=0, noise=True)
    return folder


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def cuda_library(request: pytest.FixtureRequest) -> CudaLibrary:
    """The CUDA kernels: compiled for the CPU over an emulation, and, where there is a GPU, for that.
    `cuda_library.whole_device(None)` is where their tensors belong."""
    if request.param == "emulated":
        from cuda_emulation import emulated_library

        return emulated_library()
    from ggslam.cuda.availability import cuda_backend_problem
    from ggslam.cuda.library import library_for_device

    problem = cuda_backend_problem()
    if problem is not None:
        pytest.skip(problem)
    return library_for_device()


@pytest.fixture(params=[1, 2], ids=["downwards", "jumping"])
def other_order(request: pytest.FixtureRequest) -> Iterator[None]:
    """Emulated threads of a block run in another order than upwards."""
    from cuda_emulation import emulated_library

    functions = emulated_library().functions
    functions.ggslam_emulation_order(request.param)
    yield
    functions.ggslam_emulation_order(0)
