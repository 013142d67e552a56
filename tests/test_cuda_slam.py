# SPDX-License-Identifier: Apache-2.0
"""The loop on a device: emulated on the CPU, or on a GPU where there is one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ggslam.config import Config, load_config
from ggslam.cuda.library import CudaLibrary
from ggslam.errors import ConfigError
from ggslam.realtime import RealtimeSlam
from ggslam.run_folder import RunFolder
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam import Slam
from ggslam.slam_parts import run_library
from ggslam.slam_result import SlamResult

FRAMES = 5


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, scale=0.5, stride=2).stream())[:FRAMES]


def config(*overrides: str) -> Config:
    few = ["mapping.iterations_per_frame=3", "mapping.first_frame_iterations=6", "evaluation.held_out_every=0"]
    few += ["identity.every=3", "identity.pixels=256", "identity.final_passes=1", "identity.neighbours.samples=40"]
    return load_config(None, [*few, *overrides])


def run(frames: list[Frame], settings: Config, library: CudaLibrary | None) -> tuple[Slam, SlamResult]:
    slam = Slam(frames[0].camera, settings, has_masks=True, library=library)
    for frame in frames:
        slam.step(frame)
    return slam, slam.finish()


def test_same_run_as_on_the_cpu(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    """Without identity nothing is drawn at random: map and trajectory are the CPU's up to rounding."""
    settings = config("identity.enabled=false", "keyframes.max_gap=2")
    slam, found = run(frames, settings, cuda_library)
    expected_slam, expected = run(frames, settings, None)
    assert len(found.keyframes) == len(expected.keyframes) > 1
    assert np.abs(found.trajectory() - expected.trajectory()).max() < 1e-3
    assert abs(len(found.gaussians) / len(expected.gaussians) - 1) < 0.01
    assert slam.mapper.last_psnr == pytest.approx(expected_slam.mapper.last_psnr, abs=0.2)
    assert slam.mapper.losses.total == pytest.approx(expected_slam.mapper.losses.total, rel=0.02)
    assert found.gaussians.means.device.type == "cpu"


def test_objects_are_learned(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    _, found = run(frames, config(), cuda_library)
    _, expected = run(frames, config(), None)
    assert found.objects is not None and expected.objects is not None
    assert sorted(found.objects.observations) == sorted(expected.objects.observations)
    shares = [np.mean(result.gaussians.object_id.numpy() > 0) for result in (found, expected)]
    assert shares[0] == pytest.approx(shares[1], abs=0.02)


def test_refinement_and_real_time(frames: list[Frame], cuda_library: CudaLibrary) -> None:
    settings = config("refine_iterations=4", "identity.enabled=false")
    slam = Slam(frames[0].camera, settings, has_masks=True, library=cuda_library)
    RealtimeSlam(slam, 1.0).run(frames[:3], lambda frame, report: None)
    done = slam.mapper.times.iterations
    result = slam.finish()
    assert slam.mapper.times.iterations == done + 4 and result.refine_iterations == 4
    assert len(result.gaussians) > 1000 and np.isfinite(result.gaussians.means.numpy()).all()


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
    moved = slam.map.means.cpu().numpy() - means
    assert np.allclose(moved[birth == len(before) - 1], (0.5, 0, 0), atol=1e-5) and not moved[birth == 0].any()
    count = slam.map.count
    slam.mapper.mend([0], [len(before) - 1], 2)
    assert slam.map.count <= count


def test_devices_that_cannot_be_had_are_said_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match="device: cuda: .*NVIDIA GPU"):
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
    RunFolder.create(tmp_path / "run").save(settings, {}, result)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["environment"]["device"] == "cpu"
