# SPDX-License-Identifier: Apache-2.0
"""Poses and exposures that are optimised on the device, against the CPU's optimizers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.cuda.keyframe_states import KeyframeStates
from ggslam.mapping.exposure import ExposureAdam, identity_exposure
from ggslam.mapping.keyframe import PoseAdam
from ggslam.mapping.settings import ExposureSettings
from ggslam.scene.poses import se3_exp

RATE = 5e-4
SETTINGS = ExposureSettings(enabled=True, rate=2e-3, regularization=1e-2)
TOTAL, COLOR, SSIM, DEPTH, PSNR = 0, 1, 3, 4, 7
"""Places of terms among the results of the loss."""


def make_pose(seed: int) -> np.ndarray:
    return se3_exp(np.random.default_rng(seed).normal(size=6))


def make_exposure(seed: int) -> np.ndarray:
    return identity_exposure() + 0.1 * np.random.default_rng(seed).normal(size=(3, 2))


def make_states(library: CudaLibrary, count: int) -> KeyframeStates:
    states = KeyframeStates(library=library)
    for i in range(count):
        assert states.append(make_pose(i), make_exposure(i)) == i
    return states


def results_of(values: np.ndarray, exposure_gradient: np.ndarray) -> np.ndarray:
    return np.concatenate([values, exposure_gradient.ravel()])


def on_device(array: np.ndarray, states: KeyframeStates) -> torch.Tensor:
    return torch.from_numpy(array).to(states.device)


def make_step(random: np.random.Generator, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of pose and exposure with a direction to them, and terms of the loss."""
    twist = size * (random.normal(size=6) + [0.5, -0.5, 0.2, 0.0, 1.0, -1.0])
    return twist, size * (random.normal(size=(3, 2)) + 0.3), random.random(9)


@pytest.mark.parametrize(("size", "rate"), [(1.0, RATE), (1e-6, RATE), (1e3, 0.05), (1.0, 1e-7)])
def test_steps_are_those_of_the_cpu(cuda_library: CudaLibrary, size: float, rate: float) -> None:
    states = make_states(cuda_library, 2)
    poses, exposures = [make_pose(0), make_pose(1)], [make_exposure(0), make_exposure(1)]
    pose_adams, exposure_adams = [PoseAdam(), PoseAdam()], [ExposureAdam(SETTINGS), ExposureAdam(SETTINGS)]
    random = np.random.default_rng(0)
    for step in range(200):
        i = step % 3 % 2
        twist, exposure_gradient, values = make_step(random, size)
        poses[i] = pose_adams[i].step(poses[i], twist, rate)
        exposures[i] = exposure_adams[i].step(exposures[i], exposure_gradient)
        results = on_device(results_of(values, exposure_gradient), states)
        states.step(i, on_device(twist, states), results, None, rate, SETTINGS)
    assert np.abs(poses[0] - make_pose(0)).max() > 20 * rate and np.abs(exposures[0] - make_exposure(0)).max() > 0.02
    np.testing.assert_allclose(states.read_poses(), poses, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(states.read_exposures(), exposures, rtol=1e-12, atol=1e-12)
    for i in range(2):
        read_pose, read_exposure = states.read_poses()[i], states.read_exposures()[i]
        assert np.array_equal(states.pose(i).cpu().numpy(), read_pose[:3].astype(np.float32).ravel())
        assert np.array_equal(states.exposure(i).cpu().numpy(), read_exposure.astype(np.float32))


def test_sums_are_those_of_all_iterations(cuda_library: CudaLibrary) -> None:
    states, random = make_states(cuda_library, 3), np.random.default_rng(1)
    assert np.isnan(states.read_sums().last_psnr) and states.read_sums().iterations == 0
    expected = np.zeros(9)
    for step in range(20):
        values = random.random(9)
        expected += values
        results = on_device(results_of(values, np.zeros((3, 2))), states)
        states.step(step % 3, torch.zeros(6, dtype=torch.float64, device=states.device), results)
    sums = states.read_sums()
    found = (sums.total, sums.color, sums.ssim, sums.depth)
    np.testing.assert_allclose(found, expected[[TOTAL, COLOR, SSIM, DEPTH]], rtol=1e-14)
    assert sums.last_psnr == values[PSNR] and sums.iterations == 20
    values[[SSIM, PSNR]] = np.nan, np.inf
    results = on_device(results_of(values, np.zeros((3, 2))), states)
    states.step(0, torch.zeros(6, dtype=torch.float64, device=states.device), results)
    sums = states.read_sums()
    assert np.isnan(sums.ssim) and sums.last_psnr == np.inf and np.isfinite(sums.total)


def test_without_rates_nothing_moves(cuda_library: CudaLibrary) -> None:
    states = make_states(cuda_library, 1)
    ones = torch.ones(15, dtype=torch.float64, device=states.device)
    states.step(0, ones[:6], ones)
    assert np.array_equal(states.read_poses()[0], make_pose(0))
    assert np.array_equal(states.read_exposures()[0], make_exposure(0))


@pytest.mark.parametrize("broken", ["pose", "exposure"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_broken_gradient_is_passed_over(cuda_library: CudaLibrary, broken: str, value: float) -> None:
    """The other one makes its step, and the next good gradient finds the moments as they were."""
    states, random = make_states(cuda_library, 1), np.random.default_rng(2)
    pose, exposure, pose_adam, exposure_adam = make_pose(0), make_exposure(0), PoseAdam(), ExposureAdam(SETTINGS)
    for step in range(6):
        twist, exposure_gradient, values = make_step(random, 1.0)
        if step == 3:
            (twist if broken == "pose" else exposure_gradient.reshape(-1))[5] = value
        pose = pose_adam.step(pose, twist, RATE)
        exposure = exposure_adam.step(exposure, exposure_gradient)
        results = on_device(results_of(values, exposure_gradient), states)
        states.step(0, on_device(twist, states), results, None, RATE, SETTINGS)
    assert {pose_adam.steps, exposure_adam.steps} == {5, 6}
    np.testing.assert_allclose(states.read_poses()[0], pose, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(states.read_exposures()[0], exposure, rtol=1e-12, atol=1e-13)
    assert states.read_sums().iterations == 6


def test_a_skipped_step_changes_nothing(cuda_library: CudaLibrary) -> None:
    states, random = make_states(cuda_library, 1), np.random.default_rng(3)
    flag = torch.ones(1, dtype=torch.int32, device=states.device)
    pose, adam = make_pose(0), PoseAdam()
    for step in range(4):
        twist, exposure_gradient, values = make_step(random, 1.0)
        flag.fill_(step % 2)
        results = on_device(results_of(values, exposure_gradient), states)
        states.step(0, on_device(twist, states), results, flag, RATE)
        if step % 2 == 0:
            pose, last_psnr = adam.step(pose, twist, RATE), values[PSNR]
    np.testing.assert_allclose(states.read_poses()[0], pose, rtol=1e-12, atol=1e-13)
    assert states.read_sums().iterations == 2 and states.read_sums().last_psnr == last_psnr


def test_growth_keeps_states_and_moments(cuda_library: CudaLibrary) -> None:
    states, random = make_states(cuda_library, 64), np.random.default_rng(4)
    pose, adam = make_pose(63), PoseAdam()
    for step in range(6):
        twist, exposure_gradient, values = make_step(random, 1.0)
        if step == 3:
            for i in range(64, 200):
                states.append(make_pose(i), make_exposure(i))
        pose = adam.step(pose, twist, RATE)
        results = on_device(results_of(values, exposure_gradient), states)
        states.step(63, on_device(twist, states), results, None, RATE)
    expected = np.array([make_pose(i) for i in range(200)])
    expected[63] = pose
    assert len(states) == 200
    np.testing.assert_allclose(states.read_poses(), expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(states.read_exposures(), [make_exposure(i) for i in range(200)])


def test_views_follow_the_steps(cuda_library: CudaLibrary) -> None:
    states = make_states(cuda_library, 1)
    pose, exposure = states.pose(0), states.exposure(0)
    ones = torch.ones(15, dtype=torch.float64, device=states.device)
    before = pose.cpu().clone()
    states.step(0, ones[:6], ones, None, 0.01, SETTINGS)
    assert not torch.equal(pose.cpu(), before)
    assert np.array_equal(pose.cpu().numpy(), states.read_poses()[0, :3].astype(np.float32).ravel())
    assert np.array_equal(exposure.cpu().numpy(), states.read_exposures()[0].astype(np.float32))


def test_written_poses_keep_their_moments(cuda_library: CudaLibrary) -> None:
    states, random = make_states(cuda_library, 2), np.random.default_rng(5)
    pose, adam = make_pose(1), PoseAdam()
    for step in range(6):
        twist, exposure_gradient, values = make_step(random, 1.0)
        if step == 3:
            pose = make_pose(7)
            states.write_pose(1, pose)
            assert np.array_equal(states.read_poses()[1], pose)
        pose = adam.step(pose, twist, RATE)
        results = on_device(results_of(values, exposure_gradient), states)
        states.step(1, on_device(twist, states), results, None, RATE)
    np.testing.assert_allclose(states.read_poses()[1], pose, rtol=1e-12, atol=1e-13)
    both = np.array([make_pose(8), make_pose(9)])
    states.write_poses(both)
    assert np.array_equal(states.read_poses(), both)
    assert np.array_equal(states.pose(1).cpu().numpy(), both[1, :3].astype(np.float32).ravel())
    assert np.array_equal(states.read_exposures()[1], make_exposure(1))


def test_what_did_not_change_is_read_once(cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    states = make_states(cuda_library, 1)
    poses, sums = states.read_poses(), states.read_sums()
    with monkeypatch.context() as forbidden:
        for name in ("cpu", "tolist", "item"):
            forbidden.setattr(torch.Tensor, name, None)
        assert np.array_equal(states.read_poses(), poses) and states.read_exposures().shape == (1, 3, 2)
        assert states.read_sums() is sums
    poses[:] = 0  # the caller's own
    assert np.array_equal(states.read_poses(), [make_pose(0)])
    states.write_pose(0, make_pose(5))
    assert np.array_equal(states.read_poses(), [make_pose(5)])


def test_an_empty_table(cuda_library: CudaLibrary) -> None:
    states = KeyframeStates(library=cuda_library)
    assert len(states) == 0 and states.read_poses().shape == (0, 4, 4) and states.read_exposures().shape == (0, 3, 2)


def test_wrong_calls_are_refused(cuda_library: CudaLibrary) -> None:
    states = make_states(cuda_library, 1)
    ones = torch.ones(15, dtype=torch.float64, device=states.device)
    for number in (-1, 1):
        for call in (states.pose, states.exposure, lambda i: states.step(i, ones[:6], ones)):
            with pytest.raises(IndexError, match=rf"{number}\b.*\b1\b"):
                call(number)
        with pytest.raises(IndexError):
            states.write_pose(number, np.eye(4))
    with pytest.raises(RenderError, match=r"pose.*\[4, 4\]"):
        states.append(np.eye(3), identity_exposure())
    with pytest.raises(RenderError, match=r"exposure.*\[3, 2\]"):
        states.append(np.eye(4), np.ones((2, 3)))
    with pytest.raises(RenderError, match=r"\b1 pose\b.*\b2\b"):
        states.write_poses(np.zeros((2, 4, 4)))
    for arguments, message in (
        ((ones[:6].float(), ones), "twist: .*torch.float64"), ((ones[:5], ones), r"twist: .*\[5\]"),
        ((ones[:6], ones[:14]), "loss_results"), ((ones[:12:2], ones), "twist: .*contiguous"),
        ((ones[:6], ones, ones[:1]), "skipped: .*torch.int32"),
    ):  # fmt: skip
        with pytest.raises(RenderError, match=message):
            states.step(0, *arguments)
    assert len(states) == 1 and states.read_sums().iterations == 0


def test_what_changes_while_poses_are_read_is_read_the_next_time(
    cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when the tracker's thread asks for poses while the mapper's thread goes on."""
    states = KeyframeStates(library=cuda_library)
    states.append(make_pose(0), np.tile([1.0, 0.0], (3, 1)))

    @contextmanager
    def meanwhile() -> Iterator[None]:
        yield
        monkeypatch.undo()
        states.append(make_pose(1), np.tile([1.0, 0.0], (3, 1)))

    monkeypatch.setattr(states, "in_turn", meanwhile)
    assert np.array_equal(states.read_poses(), [make_pose(0)])
    assert np.array_equal(states.read_poses(), [make_pose(0), make_pose(1)])
