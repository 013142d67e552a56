# SPDX-License-Identifier: Apache-2.0
"""Spherical harmonics turn with what they colour."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.harmonics import harmonic_rotations, spherical_harmonics

COUNTS = [1, 4, 9, 16]


def directions(count: int = 100) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.from_numpy(np.random.default_rng(1).normal(size=(count, 3))), dim=1)


@pytest.mark.parametrize("count", COUNTS)
def test_what_is_turned_has_the_old_colours_along_turned_directions(count: int) -> None:
    turns = Rotation.random(5, random_state=2).as_matrix()
    old = np.random.default_rng(3).normal(size=count)
    for R, M in zip(turns, harmonic_rotations(turns, count), strict=True):
        seen = spherical_harmonics(directions() @ torch.from_numpy(R).T, count).numpy() @ (M @ old)
        np.testing.assert_allclose(seen, spherical_harmonics(directions(), count).numpy() @ old, atol=1e-12)


@pytest.mark.parametrize("count", COUNTS)
def test_turns_follow_one_another_and_keep_lengths(count: int) -> None:
    one, other = Rotation.random(2, random_state=4).as_matrix()
    both = harmonic_rotations(other @ one, count)
    np.testing.assert_allclose(harmonic_rotations(other, count) @ harmonic_rotations(one, count), both, atol=1e-12)
    np.testing.assert_allclose(both @ both.T, np.eye(count), atol=1e-12)


def test_half_a_turn_changes_signs_and_nothing_else() -> None:
    """Those that are odd in y and z, of a turn about x: worked out from the polynomials by hand."""
    signs = harmonic_rotations(np.diag([1.0, -1.0, -1.0]), 16)
    odd = [1, 2, 4, 7, 9, 11, 12, 14]
    assert np.array_equal(signs, np.diag([-1.0 if k in odd else 1.0 for k in range(16)]))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_moved_gaussian_keeps_its_colours(degree: int) -> None:
    """Half of the Gaussians are moved; the others stay as they are, bit for bit."""
    gaussians, count = GaussianMap(degree), (degree + 1) ** 2
    gaussians.insert(torch.zeros(6, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(6, 1), torch.zeros(6, 3), 0.0,
                     torch.rand((6, 3), generator=torch.Generator().manual_seed(0)))  # fmt: skip
    gaussians.sh[:] = 0.3 * torch.randn(gaussians.sh.shape, generator=torch.Generator().manual_seed(1))
    before, T = gaussians.sh.clone(), torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [20, 90, -35], degrees=True).as_matrix())
    gaussians.move(torch.arange(6) < 3, T)
    assert torch.equal(gaussians.sh[3:], before[3:])
    seen = torch.einsum("dk,nkc->dnc", spherical_harmonics(directions() @ T[:3, :3].T, count), gaussians.sh.double())
    expected = torch.einsum("dk,nkc->dnc", spherical_harmonics(directions(), count), before.double())
    assert float((seen - expected)[:, :3].abs().max()) < 1e-6
