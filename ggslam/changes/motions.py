# SPDX-License-Identifier: Apache-2.0
"""Finds the likeliest motions of a candidate by positions and colours, from starts all around."""

from __future__ import annotations

from functools import cache
from itertools import permutations, product

import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.shape import Shape, ShapeTuning
from ggslam.scene.poses import fit_similarity, rotation_about, turning_angle
from ggslam.system.tuning import Tuning


class CandidateMotionTuning(Tuning):
    """How the likeliest motions are searched."""

    coarse_points = 150
    """Points in the first stage."""
    coarse_steps = 10
    """Steps of the first stage."""
    coarse_kept = 16
    """Motions kept after the first stage."""
    fine_points = 400
    """Points in the second stage."""
    fine_steps = 15
    """Steps of the second stage."""
    fine_kept = 8
    """Motions kept after the second stage."""
    same_rotation_rad = np.radians(12)
    """Motions whose rotations differ by less are one, in radians."""
    kept_pairs = 0.8
    """Share of the pairs of points, the nearest, that a step uses: the visits saw different sides."""


def likeliest_motions(old: Shape, new: Shape, up: np.ndarray) -> list[np.ndarray]:
    """The likeliest motions by points and colours together, from starts all around."""
    rng = np.random.default_rng(0)
    upright = np.array([rotation_about(up, angle) for angle in range(0, 360, 15)])
    rotations = np.concatenate([upright, _rotations()])
    motions = np.tile(np.eye(4), (len(rotations), 1, 1))
    motions[:, :3, :3] = rotations
    motions[:, :3, 3] = new.points.mean(0) - motions[:, :3, :3] @ old.points.mean(0)
    # Most things stay at their height, where the middle of what a visit saw of them may be anywhere.
    level = motions[: len(upright)].copy()
    level[:, :3, 3] -= float(up @ (new.points.mean(0) - old.points.mean(0))) * up
    motions = np.concatenate([motions, level])
    for count, kept, steps in (
        (CandidateMotionTuning.coarse_points, CandidateMotionTuning.coarse_kept, CandidateMotionTuning.coarse_steps),
        (CandidateMotionTuning.fine_points, CandidateMotionTuning.fine_kept, CandidateMotionTuning.fine_steps),
    ):
        one, other = (shape.sample(count, rng) for shape in (old, new))
        tree = cKDTree(other.joint())
        for _ in range(steps):
            motions, apart = _step(one, other, tree, motions)
        motions = np.array(_unlike([motions[k] for k in np.argsort(apart)], kept))
    return list(motions)


def _unlike(motions: list[np.ndarray], most: int) -> list[np.ndarray]:
    """The first ones that turn otherwise than those before them."""
    chosen: list[np.ndarray] = []
    for T in motions:
        if len(chosen) < most and all(
            turning_angle(T, other) > CandidateMotionTuning.same_rotation_rad for other in chosen
        ):
            chosen.append(T)
    return chosen


def _step(a: Shape, b: Shape, tree: cKDTree, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One step of point-to-point ICP in places and colours from each motion [m, 4, 4]; the new motions, and the mean
    distances [m] before."""
    moved = a.points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
    shades = np.broadcast_to(ShapeTuning.color_scale_m * a.colors, moved.shape)
    apart, nearest = tree.query(np.concatenate([moved, shades], 2), workers=-1)
    kept = np.argsort(apart, 1)[:, : max(3, round(CandidateMotionTuning.kept_pairs * len(a.points)))]
    partners = np.take_along_axis(nearest, kept, 1)
    found, _ = fit_similarity(a.points[kept], b.points[partners])
    return found, np.take_along_axis(apart, kept, 1).mean(1)


@cache
def _rotations() -> np.ndarray:
    """The identity, the other 23 rotations of a cube, and those halfway to its corners' turns."""
    cube = []
    for order in permutations(range(3)):
        for signs in product((-1, 1), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                cube.append(R)
    cube.sort(key=lambda R: -np.trace(R))
    half = [rotation_about(axis, angle) for axis in np.eye(3) for angle in (45, -45)]
    half += [rotation_about(np.array(axis) / np.sqrt(3), 60) for axis in product((-1, 1), repeat=3)]
    return np.array([*cube, *(R @ H for H in half for R in cube[::2])])
