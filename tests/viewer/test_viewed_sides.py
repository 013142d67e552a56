# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.rendering.types import GaussianTensors
from ggslam.scene.camera import Camera
from ggslam.viewer.viewed_sides import (
    KnownSides,
    ViewedSidesTuning,
    octahedron_to_unit,
    unit_to_octahedron,
    viewed_sides,
)

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)


def pose_along(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """T_world_camera [4, 4] of a camera at `origin` [3] that looks along `direction` [3], rolled in any way."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = origin
    return T


def test_directions_survive_two_bytes() -> None:
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    found = octahedron_to_unit(unit_to_octahedron(directions))
    assert np.degrees(np.arccos(np.clip((found * directions).sum(axis=1), -1, 1))).max() < 1.1


def walls(thickness: float) -> GaussianTensors:
    """Two opaque walls across z, 2 m and 4 m ahead; the second one is hidden."""
    x, y = np.meshgrid(np.arange(-3, 3, 0.1), np.arange(-3, 3, 0.1))
    means = np.concatenate([np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1) for z in (2.0, 4.0)])
    count = len(means)
    scales = np.log(np.tile([0.12, 0.12, thickness], (count, 1)))
    turns = np.tile([1.0, 0, 0, 0], (count, 1))
    values = (means, turns, scales, np.full(count, 5.0), np.ones((count, 1, 3)), np.zeros((count, 0)))
    return GaussianTensors(*(torch.from_numpy(np.asarray(value, np.float32)) for value in values))


@pytest.mark.parametrize("thickness", [0.005, 0.12])
def test_what_is_seen_from_where(thickness: float) -> None:
    gaussians = walls(thickness)
    means = gaussians.means.numpy()
    eyes = [np.array([0.5 * step, 0.0, 0.0]) for step in (-1, 0, 1)]
    poses = [pose_along(eye, np.array([0.0, 0.0, 1.0])) for eye in eyes]
    found = viewed_sides(gaussians, np.arange(len(means)), CAMERA, poses)
    middle = np.flatnonzero((np.abs(means[:, :2]) < 0.3).all(axis=1))
    front, back = middle[means[middle, 2] < 3], middle[means[middle, 2] > 3]
    nearest = np.argmin(np.linalg.norm(np.stack(eyes)[:, None] - means[back], axis=2), axis=0)
    alone = np.stack(eyes)[nearest] - means[back]  # hidden: as if seen from the nearest view
    alone /= np.linalg.norm(alone, axis=1, keepdims=True)
    assert len(back) and found[back, 2].max() <= 1
    assert ((octahedron_to_unit(found[back, :2]) * alone).sum(axis=1) > np.cos(np.radians(1.1))).all()
    towards = np.stack([eye - means[front] for eye in eyes])
    distances = np.linalg.norm(towards, axis=2)
    unit = towards / distances[:, :, None]
    # What is flat faces along its normal, what is not along the mean of the views.
    faces = unit.sum(axis=0) if thickness > 0.05 else np.tile([0.0, 0.0, -1.0], (len(front), 1))
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    assert ((octahedron_to_unit(found[front, :2]) * faces).sum(axis=1) > np.cos(np.radians(1.5))).all()
    cone = np.arccos((unit * faces).sum(axis=2)).max(axis=0)
    assert np.abs(found[front, 2] * np.pi / 255 - cone).max() < np.radians(1.5)
    nearest = ViewedSidesTuning.nearest_m * ViewedSidesTuning.step ** (found[front, 3].astype(float) - 1)
    ratio = distances.min(axis=0) / nearest
    assert (ratio >= 1 - 1e-6).all() and (ratio < 1.03).all()
    assert not viewed_sides(gaussians, np.arange(len(means)), CAMERA, []).any()
    # After an edit that moves some and leaves some out, the others have what they had.
    kept = np.arange(len(means))[::-3].copy()
    known = KnownSides(gaussians, CAMERA, poses)
    gaussians.means[kept[:50]] += 0.5
    left = known.find(gaussians, kept)
    assert np.array_equal(left[50:], found[kept[50:]]) and not left[:50].any()
