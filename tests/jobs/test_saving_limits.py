# SPDX-License-Identifier: Apache-2.0
"""Where files may only be so large (`ulimit -f`), what is small and precious of a run is kept."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggslam.jobs.run import rescue
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute, resume
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.verification import verify_run

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "identity.final_passes=0",
       "refine_iterations=0"]  # fmt: skip


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Files of this process may have so many bytes. Python ignores the signal, so writing fails with EFBIG."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only other place to save to, where files may be no larger either."""
    (tmp_path / "other").mkdir()
    monkeypatch.setattr(rescue, "places", lambda: [tmp_path / "other"])
    return tmp_path / "other"


def short(room: Path, out: Path, stop: int = 5, overwrite: bool = False, every: int = 2) -> RunRequest:
    return RunRequest(SequenceRequest(room, stop=stop, scale=0.5), out, overrides=FEW, evaluate=False,
                      checkpoint_every=every, overwrite=overwrite)  # fmt: skip


@pytest.fixture(scope="module")
def whole(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """The run that nothing limits."""
    return execute(short(room, tmp_path_factory.mktemp("runs") / "whole")).folder


def limited(room: Path, out: Path, size: int, **more: Any) -> RunOutcome:
    with largest_file(size):
        return execute(short(room, out, **more))


@pytest.mark.parametrize("size", [12_000, 100_000])
def test_the_trajectory_is_kept(room: Path, whole: RunFolder, tmp_path: Path, nowhere: Path, size: int) -> None:
    outcome = limited(room, tmp_path / "run", size)
    assert outcome.failure is not None and outcome.failure.exit_code == 1
    text = str(outcome.failure)
    assert "map.ply: File too large" in text if size == 100_000 else "File too large" in text
    assert f"kept in {tmp_path / 'run'}, the map was not; `ggslam run --resume {tmp_path / 'run'}`" in text
    assert "Errno" not in text and ".staged" not in text and "\n" not in text
    kept = RunFolder.open(tmp_path / "run")
    assert np.array_equal(kept.trajectory().T_world_camera, whole.trajectory().T_world_camera)
    assert not kept.mark().complete and "map.ply" in kept.mark().missing and not verify_run(kept.path).problems
    if size == 100_000:
        poses, expected = kept.keyframes().poses(), whole.keyframes().poses()
        assert all(np.array_equal(poses[frame], pose) for frame, pose in expected.items())
        assert kept.config() == whole.config() and kept.timing() is not None and kept.loops() is not None
    assert not list(nowhere.iterdir()) and not list(kept.path.glob(".staged-*"))
    assert resume(kept.path).error is None  # without the limit
    assert (kept.path / "map.ply").read_bytes() == (whole.path / "map.ply").read_bytes()
    assert verify_run(kept.path).problems == [] and not (kept.path / "checkpoints").exists()


def test_where_records_are_too_large_the_trajectory_alone_is_kept(
    room: Path, whole: RunFolder, tmp_path: Path, nowhere: Path
) -> None:
    outcome = limited(room, tmp_path / "run", 3_000, every=0)
    assert f"the trajectory alone was kept in {tmp_path / 'run'}, the map was not" in str(outcome.failure)
    assert "--resume" not in str(outcome.failure) and outcome.folder.path == tmp_path / "run"
    kept = RunFolder.open(tmp_path / "run")
    assert np.array_equal(kept.trajectory().T_world_camera, whole.trajectory().T_world_camera)


def test_a_good_run_is_not_mixed_with_poses_of_another(room: Path, tmp_path: Path, nowhere: Path) -> None:
    out = tmp_path / "run"
    execute(short(room, out, stop=4))
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    outcome = limited(room, out, 100_000, overwrite=True)
    assert outcome.failure is not None and outcome.folder.path.parent == tmp_path
    assert outcome.folder.path.name.startswith("run-poses-") and str(outcome.folder.path) in str(outcome.failure)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    assert verify_run(out).problems == [] and len(RunFolder.open(out).trajectory()) == 4
    assert len(RunFolder.open(outcome.folder.path).trajectory()) == 5
