# SPDX-License-Identifier: Apache-2.0
"""Gaussians follow the keyframes that inserted them; what a loop left double goes."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.duplicates import remove_duplicates
from ggslam.mapping.pruning import prune
from ggslam.mapping.settings import PruningSettings
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.harmonics import spherical_harmonics
from ggslam.scene.poses import left_multiplication, matrix_to_quaternion, quaternion_to_matrix, se3_exp


def sheet(z: float, birth: int, gaussians: GaussianMap, spacing: float = 0.05, opacity: float = 2.0) -> None:
    """A flat square metre of discs at depth z."""
    x, y = torch.meshgrid(torch.arange(0, 1, spacing), torch.arange(0, 1, spacing), indexing="ij")
    means = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((x.numel(),), z)], 1)
    n = len(means)
    scales = torch.log(torch.tensor([0.6 * spacing, 0.6 * spacing, 0.002])).repeat(n, 1)
    quaternions = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    gaussians.insert(means, quaternions, scales, torch.full((n,), opacity), torch.rand(n, 3), birth_keyframe=birth)


def test_each_gaussian_moves_with_its_birth() -> None:
    gaussians = GaussianMap()
    for birth in (-1, 0, 1):
        sheet(1.0 + birth, birth, gaussians)
    first, second = gaussians.moments["means"]
    first[:], second[:] = torch.tensor([1.0, 0, 0]), torch.tensor([4.0, 0, 0])
    T = np.stack([np.eye(4), se3_exp(np.array([0.1, 0.2, 0.3, 0.0, 0.0, np.pi / 2]))])
    before, turns = gaussians.means.clone(), gaussians.quaternions.clone()
    move_with_keyframes(gaussians, T)
    third = gaussians.birth_keyframe == 1
    assert torch.equal(gaussians.means[~third], before[~third])
    assert torch.equal(gaussians.quaternions[~third], turns[~third])
    expected = before[third].numpy() @ T[1, :3, :3].T + T[1, :3, 3]
    np.testing.assert_allclose(gaussians.means[third].numpy(), expected, atol=1e-6)
    found = quaternion_to_matrix(gaussians.quaternions[third].double().numpy())
    np.testing.assert_allclose(found, np.broadcast_to(T[1, :3, :3], found.shape), atol=1e-6)
    first, second = (m[third] for m in gaussians.moments["means"])
    np.testing.assert_allclose(first[0].numpy(), [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(second[0].numpy(), [0, 4, 0], atol=1e-6)


def test_colours_turn_with_the_keyframe_of_each_gaussian() -> None:
    """Every Gaussian by its own rotation: seen along the turned direction, each looks as before; moments likewise."""
    gaussians = GaussianMap(sh_degree=3)
    for birth in (-1, 0, 1):
        sheet(1.0 + birth, birth, gaussians, spacing=0.2)
    gaussians.sh[:] = 0.3 * torch.randn(gaussians.sh.shape, generator=torch.Generator().manual_seed(0))
    gaussians.moments["sh"][0][:] = gaussians.sh
    before = gaussians.sh.clone()
    T = np.stack([se3_exp(np.array([0.1, 0, 0, 0.4, -0.2, 0.9])), se3_exp(np.array([0, 0, 0.2, -1.5, 0.3, 0.2]))])
    move_with_keyframes(gaussians, T)
    directions = torch.nn.functional.normalize(torch.randn((50, 3), generator=torch.Generator().manual_seed(1)), dim=1)
    basis = spherical_harmonics(directions, 16)
    for birth, R in ((-1, np.eye(3)), (0, T[0, :3, :3]), (1, T[1, :3, :3])):
        own = gaussians.birth_keyframe == birth
        turned = spherical_harmonics(directions @ torch.from_numpy(R).float().T, 16)
        expected = torch.einsum("dk,nkc->dnc", basis, before[own])
        for found in (gaussians.sh[own], gaussians.moments["sh"][0][own]):
            assert float((torch.einsum("dk,nkc->dnc", turned, found) - expected).abs().max()) < 2e-6


def test_the_gradient_of_a_rotation_turns_along() -> None:
    """d/dq of f(q) at q, carried to dq q, is d/dq' of the same function seen in the new frame."""
    rng = np.random.default_rng(0)
    dq, q, g = (rng.normal(size=4) for _ in range(3))
    dq /= np.linalg.norm(dq)
    L = left_multiplication(dq)
    np.testing.assert_allclose(L @ L.T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose((L @ g) @ (L @ q), g @ q, atol=1e-6)
    R = quaternion_to_matrix(dq[None])[0] @ quaternion_to_matrix((q / np.linalg.norm(q))[None])[0]
    found = matrix_to_quaternion(R)
    expected = L @ q / np.linalg.norm(q)
    np.testing.assert_allclose(found * np.sign(found @ expected), expected, atol=1e-6)


def test_doubled_surface_goes_and_what_fills_a_hole_stays() -> None:
    gaussians = GaussianMap()
    sheet(1.0, 0, gaussians)
    hole = (gaussians.means[:, 0] > 0.35) & (gaussians.means[:, 0] < 0.65) & (gaussians.means[:, 1] > 0.35)
    gaussians.keep(~(hole & (gaussians.means[:, 1] < 0.65)))
    kept = len(gaussians)
    sheet(1.004, 7, gaussians)
    sheet(1.5, 7, gaussians)
    doubled = len(gaussians) - kept - 400
    removed = remove_duplicates(gaussians, np.array([0]), np.array([7]), 0.01)
    assert len(gaussians) == kept + 400 + doubled - removed
    births = gaussians.birth_keyframe.numpy()
    assert (births == 0).sum() == kept
    left = gaussians.means.numpy()[(births == 7) & (gaussians.means[:, 2].numpy() < 1.2)]
    assert 9 <= len(left) <= 36 and left[:, :2].min() > 0.3 and left[:, :2].max() < 0.7
    assert (gaussians.means[:, 2] > 1.4).sum() == 400


def test_nothing_is_double_with_transparent_gaussians() -> None:
    gaussians = GaussianMap()
    sheet(1.0, 0, gaussians, opacity=-3.0)
    sheet(1.0, 7, gaussians)
    assert remove_duplicates(gaussians, np.array([0]), np.array([7]), 0.01) == 0


def test_a_map_on_a_device_is_moved_and_cleaned_as_on_the_host(cuda_library: CudaLibrary) -> None:
    here = GaussianMap()
    for z, birth in ((1.0, 0), (1.004, 1), (1.5, 1)):
        sheet(z, birth, here)
    here.log_scales[3, 0], here.means[5, 1], here.opacity_logits[7] = 3.0, torch.nan, -9.0
    here.moments["quaternions"][0][:] = torch.rand(len(here), 4)
    there = here.copy(cuda_library.whole_device(None))
    T = np.stack([np.eye(4), se3_exp(np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 1e-3]))])
    for gaussians in (here, there):
        assert prune(gaussians, PruningSettings()) == 3
        move_with_keyframes(gaussians, T)
        assert 0 < remove_duplicates(gaussians, np.array([0]), np.array([1]), 0.01) < 800
    assert len(there) == len(here)
    rows = torch.arange(len(here))
    found, expected = there.to("cpu").take(rows), here.take(rows)
    for name, array in expected.items():
        torch.testing.assert_close(found[name], array, atol=1e-6, rtol=1e-5)
