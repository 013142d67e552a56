# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("COLUMNS", "300")  # folders of tests have long names: no line breaks where a test looks
os.environ.setdefault("NUMBA_DISABLE_JIT", "1")  # a reader of splats that tests ask would compile for 13 s
if "PYTEST_XDIST_WORKER" in os.environ:  # processes that share the tests share the processors
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from kept import build_once, generated_recording, light_maps_kept, points_in_voxels_of, session_folder

if TYPE_CHECKING:
    from ggslam.cuda.library import CudaLibrary
    from ggslam.runs.folder import RunFolder

pytest_plugins = ["long_tests"]


def pytest_collection_finish() -> None:
    """What the modules of all tests hold stays: the garbage collector need not look at it again and again."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def fair_share() -> Iterator[None]:
    """A process that shares the tests with others computes with one thread, unless a test asks for more."""
    with pytest.MonkeyPatch.context() as patch:
        if "PYTEST_XDIST_WORKER" in os.environ:
            patch.setattr("ggslam.native.loader.available_processors", lambda: 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> None:
    """What a shell starts in the background ignores Ctrl-C; tests that send one to themselves wait for it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def coarse_points() -> Iterator[None]:
    """Runs sample their clouds in voxels of 4 cm: those of 1 cm would be half of what a short run takes, and few tests
    look at them. `with points_in_voxels_of(0.01)` is what users have."""
    with points_in_voxels_of(0.04):
        yield


@pytest.fixture(scope="session", autouse=True)
def one_command_line() -> Iterator[None]:
    """Options are read from the functions of the commands once, not for every command line that a test gives."""
    import typer.main
    import typer.testing

    once = lru_cache(typer.main.get_command)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", once)
        patch.setattr(typer.testing, "_get_command", once)
        yield


@pytest.fixture(scope="session", autouse=True)
def kept_light_maps() -> Iterator[None]:
    with light_maps_kept():
        yield


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
    return generated_recording(tmp_path_factory, "room", frames=24, width=160, height=120, seed=0, noise=True)


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated recording by two cameras back to back, 24 frames of 128x96 each, the second 10 ms later."""
    from ggslam.synthetic import write_synthetic_rig

    return generated_recording(
        tmp_path_factory, "rig", write_synthetic_rig, frames=24, width=128, height=96, delay=0.01
    )


@pytest.fixture(scope="session")
def room_run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run of the first ten frames of the room, with objects, not scored. Who changes it works on a copy."""
    from ggslam.jobs.run.pipeline import RunRequest, execute
    from ggslam.runs.folder import RunFolder
    from ggslam.runs.recordings import SequenceRequest

    def build(out: Path) -> None:
        few = ["mapping.iterations_per_frame=2", "refine_iterations=20"]
        execute(RunRequest(SequenceRequest(room, stop=10), out=out, overrides=few, evaluate=False))

    return RunFolder.open(build_once(session_folder(tmp_path_factory) / "runs" / "room", build))


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
