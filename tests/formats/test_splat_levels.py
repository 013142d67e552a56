# SPDX-License-Identifier: Apache-2.0
"""Coarser levels of a Gaussian map keep what can be known of a merge: mean, covariance, colour, what is hidden."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_levels import coarser, merge
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import quaternion_to_matrix


def columns_of(means: np.ndarray, log_scales: np.ndarray | float = -3.0, **others: np.ndarray) -> SplatColumns:
    count = len(means)
    turned = others.get("quaternions", np.tile([1.0, 0, 0, 0], (count, 1)))
    return SplatColumns(
        means.astype(np.float32), np.broadcast_to(log_scales, (count, 3)).astype(np.float32), turned.astype(np.float32),
        others.get("logits", np.zeros(count)).astype(np.float32),
        others.get("sh", np.zeros((count, 1, 3))).astype(np.float32),
        others.get("object_id", np.zeros(count)).astype(np.int32),
    )  # fmt: skip


def covariances(columns: SplatColumns) -> np.ndarray:
    R = quaternion_to_matrix(columns.quaternions.astype(float))
    return (R * np.exp(2 * columns.log_scales.astype(float))[:, None, :]) @ R.transpose(0, 2, 1)


def random_columns(count: int) -> SplatColumns:
    random = np.random.default_rng(5)
    q = random.normal(size=(count, 4))
    return columns_of(
        random.normal(size=(count, 3)), random.normal(-3, 0.5, (count, 3)), logits=random.normal(size=count),
        quaternions=q / np.linalg.norm(q, axis=1, keepdims=True), sh=random.normal(size=(count, 4, 3)),
        object_id=random.integers(0, 5, count),
    )  # fmt: skip


def test_moments_of_a_merge() -> None:
    """Against samples: as many of each Gaussian as its weight says, moved apart so that variances are 1.6 times."""
    columns = random_columns(3)
    s = np.exp(columns.log_scales.astype(float))
    weight = np.logaddexp(0, columns.logits) * (s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0])
    random, samples, share = np.random.default_rng(6), [], weight / weight.sum()
    middle = share @ columns.means
    apart = middle + np.sqrt(1.6) * (columns.means - middle)
    for mean, covariance, part in zip(apart, covariances(columns), share, strict=True):
        samples.append(random.multivariate_normal(mean, covariance, round(300_000 * part)))
    cloud = np.concatenate(samples)
    merged = merge(columns, np.zeros(3, np.int64))
    np.testing.assert_allclose(merged.means[0], cloud.mean(0), atol=0.01)
    np.testing.assert_allclose(covariances(merged)[0], np.cov(cloud.T), atol=0.02)
    np.testing.assert_allclose(merged.sh[0], np.einsum("n,nkc->kc", share, columns.sh), rtol=1e-5)
    assert merged.object_id[0] == columns.object_id[weight.argmax()]


def test_like_ones_at_one_place_are_one_that_is_more_opaque() -> None:
    """Two layers of opacity 0.5 hide three quarters."""
    merged = merge(columns_of(np.zeros((2, 3))), np.zeros(2, np.int64))
    np.testing.assert_allclose(merged.log_scales, -3.0, atol=1e-5)
    assert 1 / (1 + np.exp(-merged.logits[0])) == pytest.approx(0.75)


def test_groups_do_not_touch_each_other() -> None:
    columns, groups = random_columns(40), np.random.default_rng(1).permutation(np.arange(40) % 7)
    merged = merge(columns, groups)
    for group in range(7):
        alone = merge(columns.take(np.flatnonzero(groups == group)), np.zeros((groups == group).sum(), np.int64))
        np.testing.assert_allclose(merged.means[group], alone.means[0], rtol=1e-6)
        np.testing.assert_allclose(merged.sh[group], alone.sh[0], rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 250, 499, 500, 900])
def test_there_are_as_many_as_asked_for(count: int) -> None:
    columns = random_columns(500)
    columns.means[:50] = columns.means[0]  # more at one place than have a neighbour elsewhere
    found = coarser(columns, count)
    assert len(found) == min(count, 500)
    for values in (found.means, found.log_scales, found.quaternions, found.logits, found.sh):
        assert np.isfinite(values).all()
    again = coarser(columns, count)
    np.testing.assert_array_equal(found.means, again.means)


def test_what_is_alike_is_merged_first() -> None:
    """Pairs side by side, one of each colour: red with red, blue with blue."""
    x = np.repeat(np.arange(20.0), 2) + np.tile([0, 0.02], 20)
    means = np.stack([np.concatenate([x, x]), np.repeat([0.0, 0.03], 40), np.zeros(80)], 1)
    sh = np.zeros((80, 1, 3))
    sh[:40, 0, 0] = sh[40:, 0, 2] = 2.0
    found = coarser(columns_of(means, sh=sh), 40)
    assert (np.sort(found.sh[:, 0, [0, 2]], 1) == [0, 2]).all()


def test_from_far_away_it_looks_the_same() -> None:
    """A bright wall with a pattern, of which an eighth of the Gaussians is left: gaps that are seen from near, not from
    far away, but never much of it. (From further still each splat of the wall is smaller than what the low-pass adds,
    and it is the wall itself that looks wrong.)"""
    grid = (np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1).reshape(-1, 2) - 31.5) * 0.03
    means = np.column_stack([grid, np.full(len(grid), 2.0)])
    sh = np.sin(3 * means[:, :1] + means[:, 1:2] * [[1, 2, 3]])[:, None]
    wall = columns_of(means, np.log([0.02, 0.02, 0.002]), logits=np.full(len(grid), 2.0), sh=sh)
    errors, brightness = [], []
    for size in (96, 24):
        camera = Camera(size, size, size, size, size / 2 - 0.5, size / 2 - 0.5)
        images = []
        for columns in (wall, coarser(wall, 512)):
            gaussians = GaussianMap(0, with_moments=False)
            rows = gaussians.insert(
                *map(torch.from_numpy, (columns.means, columns.quaternions, columns.log_scales, columns.logits)),
                torch.zeros(len(columns), 3),
            )  # fmt: skip
            gaussians.sh[rows] = torch.from_numpy(columns.sh)
            images.append(CpuRasterizer().forward(gaussians, camera, np.eye(4)).image.numpy())
        errors.append(float(np.sqrt(np.square(images[0] - images[1]).mean())))
        brightness.append(float(images[1].mean() / images[0].mean()))
    assert errors[1] < 0.06 < errors[0] < 0.12
    assert 0.8 < brightness[0] < brightness[1] < 1.01 and brightness[1] > 0.97
