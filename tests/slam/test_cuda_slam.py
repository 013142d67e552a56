# SPDX-License-Identifier: Apache-2.0
"""The loop on a device: emulated on the CPU, or on a GPU where there is one."""

from __future__ import annotations

import json
import threading
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import ConfigError, DeviceError
from ggslam.formats.trajectory import read_tum
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.pixel_grid import ALL_PIXELS
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.sequence import OpenRecord, SequenceRecord
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.parts import run_library
from ggslam.slam.realtime import RealtimeSlam
from ggslam.slam.result import SlamResult
from ggslam.slam.slam import Slam
from ggslam.tracking.edges_planes.tracker import FeatureTracker

FRAMES = 3


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.4, stride=2).stream())[:FRAMES]


def config(*overrides: str) -> Config:
    few = ["mapping.iterations_per_frame=3", "mapping.first_frame_iterations=6", "evaluation.held_out_every=0"]
    few += ["identity.every=3", "identity.pixels=256", "identity.final_passes=1", "identity.neighbours.samples=40"]
    return load_config(None, [*few, *overrides])


def run(frames: list[Frame], settings: Config, library: CudaLibrary | None) -> tuple[Slam, SlamResult]:
    slam = Slam(frames[0].camera, settings, has_masks=True, library=library)
    for frame in frames:
        slam.step(frame)
    return slam, slam.finish()


@pytest.mark.long("the whole loop under emulation")
def test_same_run_as_on_the_cpu(
    frames: list[Frame], cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without identity nothing is drawn at random: map and trajectory are the CPU's up to rounding, if its steps draw
    all pixels, too."""
    monkeypatch.setattr(CpuMapper, "_choose_grid", lambda mapper, keyframe: ALL_PIXELS)
    monkeypatch.setattr(CpuMapper, "_steps_wholly", True)
    settings = config("identity.enabled=false", "keyframes.max_gap=2", "refine_iterations=10")
    slam, found = run(frames, settings, cuda_library)
    expected_slam, expected = run(frames, settings, None)
    assert len(found.keyframes) == len(expected.keyframes) > 1
    assert np.abs(found.trajectory() - expected.trajectory()).max() < 1e-3
    assert abs(len(found.gaussians) / len(expected.gaussians) - 1) < 0.01
    assert slam.mapper.last_psnr == pytest.approx(expected_slam.mapper.last_psnr, abs=0.2)
    assert slam.mapper.losses.total == pytest.approx(expected_slam.mapper.losses.total, rel=0.03)
    assert found.gaussians.means.device.type == "cpu"


@pytest.mark.long("the whole loop under emulation")
def test_edges_and_planes_are_tracked_as_on_the_cpu(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    settings = config(
        "identity.enabled=false", "keyframes.max_gap=2", "tracker=edges_planes", "edges_planes.align.budget_ms=0"
    )
    slam, found = run(frames, settings, cuda_library)
    _, expected = run(frames, settings, None)
    assert isinstance(slam.tracker, FeatureTracker) and slam.tracker.device_engine is not None
    assert len(found.keyframes) == len(expected.keyframes) > 1
    assert np.abs(found.trajectory() - expected.trajectory()).max() < 1e-3


@pytest.mark.long("the whole loop under emulation")
def test_objects_are_learned(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    _, found = run(frames, config(), cuda_library)
    _, expected = run(frames, config(), None)
    assert found.objects is not None and expected.objects is not None
    assert sorted(found.objects.observations) == sorted(expected.objects.observations)
    shares = [np.mean(result.gaussians.object_id.numpy() > 0) for result in (found, expected)]
    assert shares[0] == pytest.approx(shares[1], abs=0.02)


@pytest.mark.long("the whole loop under emulation")
def test_refinement_and_real_time(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    settings = config("refine_iterations=4", "identity.enabled=false")
    slam = Slam(frames[0].camera, settings, has_masks=True, library=cuda_library)
    RealtimeSlam(slam, 1.0).run(frames, lambda frame, report: None)
    done = slam.mapper.times.iterations
    result = slam.finish()
    assert slam.mapper.times.iterations == done + 4 and result.refine_iterations == 4
    assert len(result.gaussians) > 1000 and np.isfinite(result.gaussians.means.numpy()).all()


def test_in_real_time_the_tracker_is_beside_the_mapper(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    """Not the other way round: the mapper's tensors were made on the stream that the caller's thread began with. What
    looks on from the caller's thread is on that as well."""
    slam = Slam(frames[0].camera, config("identity.enabled=false"), has_masks=True, library=cuda_library)
    within: list[str] = []

    class Beside(AbstractContextManager[None]):
        def __enter__(self) -> None:
            within.append(threading.current_thread().name)

        def __exit__(self, *_: object) -> None:
            within.clear()

    seen: list[list[str]] = []
    track = slam.tracker.track
    slam.mapper.beside_others = Beside  # type: ignore[method-assign]
    slam.tracker.track = lambda frame: (seen.append(list(within)), track(frame))[1]  # type: ignore[method-assign]
    RealtimeSlam(slam, 1.0).run(frames[:2], lambda frame, report: seen.append(list(within)))
    assert seen == [[threading.current_thread().name], []] * 2


def test_iterations_without_room_are_made_again(
    frames: list[Frame], cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = Slam(frames[0].camera, config("identity.enabled=false"), has_masks=True, library=cuda_library)
    slam.step(frames[0])
    mapper = slam.mapper
    overflows = mapper._rasterizer.overflows  # type: ignore[attr-defined]
    overflows += 2
    mapper.run(0)
    overflows.cpu()  # what was sent has arrived
    done = mapper.times.iterations
    mapper.run(1)
    assert mapper.times.iterations == done + 3
    count = mapper._count_iteration

    def without_room() -> None:
        count()
        if mapper.times.iterations == done + 4:
            overflows.add_(1)

    monkeypatch.setattr(mapper, "_count_iteration", without_room)
    mapper.refine(3)
    assert mapper.times.iterations == done + 7


@pytest.mark.long("the whole loop under emulation")
def test_a_keyframe_looks_again_if_its_rendering_found_no_room(
    frames: list[Frame], cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[bool] = []

    few = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2"]

    def run_two(short: bool) -> Slam:
        slam = Slam(frames[0].camera, config("keyframes.max_gap=1", *few), has_masks=True, library=cuda_library)
        mapper: Any = slam.mapper
        rendered = mapper.render_keyframe

        def rendered_short(keyframe: Keyframe, with_room: bool) -> Any:
            view = rendered(keyframe, with_room)
            mapper._rasterizer.last_overflowed.fill_(0 if with_room else 1)
            looks.append(with_room)
            return view

        if short:
            monkeypatch.setattr(mapper, "render_keyframe", rendered_short)
        for frame in frames[:2]:
            slam.step(frame)
        return slam

    found, expected = run_two(True).map, run_two(False).map
    assert looks == [False, True]
    assert found.count == expected.count
    # A GPU adds in changing order, and the first step of a mean is 1.8 mm whichever way a gradient of nearly 0 points.
    off = np.abs(found.means.cpu().numpy() - expected.means.cpu().numpy()).max(1)
    assert (off < 1e-3).mean() > 0.99 and off.max() < 0.02


def test_a_closed_loop_moves_map_and_keyframes(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    settings = config("keyframes.max_gap=1", "identity.enabled=false")
    slam = Slam(frames[0].camera, settings, has_masks=True, library=cuda_library)
    for frame in frames[:3]:
        slam.step(frame)
    before = np.stack([k.T_world_camera for k in slam.mapper.keyframes])
    birth, means = slam.map.birth_keyframe.cpu().numpy().copy(), slam.map.means.cpu().numpy().copy()
    T = np.tile(np.eye(4), (len(before), 1, 1))
    T[-1, :3, 3] = (0.5, 0, 0)
    slam.mapper.move_keyframes(T)
    after = np.stack([k.T_world_camera for k in slam.mapper.keyframes])
    assert np.allclose(after, T @ before)
    assert np.array_equal(slam.mapper.latest_poses(2), after[-2:])
    assert np.array_equal(slam.mapper.latest_poses(9), after)
    moved = slam.map.means.cpu().numpy() - means
    assert np.allclose(moved[birth == len(before) - 1], (0.5, 0, 0), atol=1e-5) and not moved[birth == 0].any()
    count = slam.map.count
    slam.mapper.retrain_loop_ends([0], [len(before) - 1], 2)
    assert slam.map.count <= count


def test_a_correction_without_memory_moves_nothing(
    frames: list[Frame], cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "identity.enabled=false"]
    slam = Slam(frames[0].camera, config("keyframes.max_gap=1", *few), has_masks=True, library=cuda_library)
    for frame in frames[:3]:
        slam.step(frame)
    slam.end_joining()
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = 0.5

    def fail(*_: object) -> None:
        raise MemoryError("no memory")

    before, means = slam.mapper.latest_poses(3), slam.map.means.cpu().numpy().copy()
    with monkeypatch.context() as patch:
        patch.setattr("ggslam.mapping.mapper.move_with_keyframes", fail)
        with pytest.raises(MemoryError):
            slam.mapper.move_keyframes(T)
    with pytest.raises(ValueError, match="T_new_old"):
        slam.mapper.move_keyframes(T[:2])
    assert np.array_equal(slam.mapper.latest_poses(3), before)
    assert np.array_equal(slam.map.means.cpu().numpy(), means)


@pytest.fixture
def short_run(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunRequest:
    """Of three frames; it stops at the second call of the mapper."""
    runs: list[int] = []
    real = Mapper.run

    def run(mapper: Mapper, iterations: int) -> None:
        runs.append(iterations)
        if len(runs) == 2:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB. GPU 0 has no more.")
        real(mapper, iterations)

    monkeypatch.setattr(Mapper, "run", run)
    few = ["mapping.first_frame_iterations=1", "identity.final_passes=1", "keyframes.max_gap=1"]
    return RunRequest(SequenceRequest(room, stop=3), tmp_path / "run", overrides=few, evaluate=False)


def test_what_was_done_is_saved_when_memory_is_full(short_run: RunRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if none is left for the last identity steps."""
    monkeypatch.setattr(Mapper, "finish_identity", full_memory)
    outcome = execute(short_run)
    assert isinstance(outcome.error, DeviceError) and outcome.error.exit_code == 1
    assert str(outcome.error) == "the GPU's memory is full: CUDA out of memory. Tried to allocate 2.00 MiB"
    assert len(outcome.folder.gaussians()) == outcome.result.gaussian_count > 1000 and outcome.result.objects is None


def test_the_trajectory_outlives_a_gpu_that_failed(short_run: RunRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    def to(*_: object) -> None:
        monkeypatch.setattr(Keyframe, "T_world_camera", property(full_memory))
        full_memory()

    monkeypatch.setattr(GaussianMap, "to", to)
    with pytest.raises(torch.cuda.OutOfMemoryError):
        execute(short_run)
    assert short_run.out is not None and len(read_tum(short_run.out / "trajectory.txt")) == 2


def full_memory(*_: object) -> None:
    raise torch.cuda.OutOfMemoryError("CUDA out of memory.")


def test_devices_that_cannot_be_had_are_said_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match="device: cuda"):
        run_library(Config(device="cuda"))
    assert run_library(Config()) == (None, None)
    library, reason = run_library(Config(device="auto"))
    assert library is None and reason is not None and "on the CPU" in reason and "NVIDIA GPU" in reason
    with pytest.raises(ConfigError, match="memory_limit_mb"):
        run_library(Config(device="cuda", memory_limit_mb=1000))
    library, reason = run_library(Config(device="auto", memory_limit_mb=1000))
    assert library is None and reason is not None and "memory_limit_mb" in reason


def test_a_run_that_may_choose_tells_where_it_was(
    frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    settings = config("device=auto", "identity.enabled=false")
    _, result = run(frames[:1], settings, None)
    assert len(result.notes) == 1 and "NVIDIA GPU" in result.notes[0]
    record = SequenceRecord(open=OpenRecord(path="room"), camera=frames[0].camera)
    RunFolder.create(tmp_path / "run").save(settings, record, result)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["environment"]["device"] == "cpu"
