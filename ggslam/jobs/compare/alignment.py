# SPDX-License-Identifier: Apache-2.0
"""Aligns A with the frame of B: not at all, by true poses, by common times, or by ICP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ggslam.errors import ConfigError
from ggslam.evaluation.trajectory import FEWEST_POSES, align_points
from ggslam.formats.trajectory import Trajectory
from ggslam.geometry.clouds import Cloud, overlap
from ggslam.geometry.icp import CloudRegistration
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.verdict import RunVerdict
from ggslam.scene.poses import fit_similarity, inverse
from ggslam.sequences.association import PairingTuning, pair_times
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

Alignment = Literal["auto", "none", "truth", "icp", "trajectory"]


class RunAlignmentTuning(Tuning):
    """When an alignment of two runs is believed."""

    arm_m = 1.0
    """Poses are aligned by points this far along the camera's axes, too, in metres: about the distance of the scene.
    They fix the rotation where the camera hardly moved."""
    max_error = 0.2
    """Largest error of a trajectory, as a share of the true path's extent."""
    min_overlap = 0.3
    """Smallest share of points with a partner after registration, in the cloud that overlaps more."""
    probes = 5000
    """Points that are tried to choose between the true poses and the poses as they are."""
    min_gain = 0.1
    """"auto" chooses the true poses if this much larger a share of points then lies near the other side."""


@dataclass(frozen=True)
class Side:
    """One side of a comparison.

    Attributes:
        path: a run's folder or a file.
        points: float64 [N, 3] metres. Of a run: its map sampled on a grid of 1 cm (points.ply).
        trajectory: of a run.
        metrics: of a run that was scored.
        verdict: of a run, if it has one.
        truth: true poses of a run's frames, by their times, where the run kept them.
    """

    path: Path
    points: np.ndarray
    trajectory: Trajectory | None = None
    metrics: MetricsRecord | None = None
    truth: Trajectory | None = None
    verdict: RunVerdict | None = None


def common_poses(a: Side, b: Side) -> np.ndarray:
    """Rows [M, 2] of poses at the same times."""
    if a.trajectory is None or b.trajectory is None:
        return np.empty((0, 2), np.int64)
    return pair_times(a.trajectory.timestamps, b.trajectory.timestamps, PairingTuning.tolerance_s)


def by_trajectory(a: Side, b: Side, pairs: np.ndarray) -> np.ndarray:
    """T_b_a [4, 4] that lays camera positions at common times upon one another.

    Raises:
        ConfigError: one of the two is a file, or they have too few times in common.
    """
    if a.trajectory is None or b.trajectory is None:
        lacking = a if a.trajectory is None else b
        raise ConfigError(f"`align` trajectory: {lacking.path} is a file and has no trajectory; use icp or none")
    if len(pairs) < FEWEST_POSES:
        raise ConfigError(
            f"`align` trajectory: {a.path} and {b.path} share {quantity(len(pairs), 'time')} of poses, expected at "
            f"least {FEWEST_POSES}"
        )
    source, target = a.trajectory.T_world_camera[pairs[:, 0]], b.trajectory.T_world_camera[pairs[:, 1]]
    return align_points(source[:, :3, 3], target[:, :3, 3])[0]


def by_truth(a: Side, b: Side) -> np.ndarray:
    """T_b_a [4, 4] by way of the world of true poses. A file (a mesh made from true poses) lies in that world.

    Raises:
        ConfigError: neither is a run, a run has no true poses, or they do not fit its trajectory.
    """
    if a.trajectory is None and b.trajectory is None:
        raise ConfigError("`align` truth: expected a run among the two; files have no poses")
    return inverse(_true_world(b)) @ _true_world(a)


def best_of_truth_and_none(
    a: Side, b: Side, cloud_b: Cloud, max_distance: float, seed: int
) -> tuple[Alignment, np.ndarray]:
    """By the truth where a run has one and the clouds then lie upon one another clearly better, else not at all.
    `cloud_b` has the points of B."""
    with_poses = [side for side in (a, b) if side.trajectory is not None]
    if not with_poses or any(side.truth is None for side in with_poses):
        return "none", np.eye(4)
    try:
        T = by_truth(a, b)
    except ConfigError:
        return "none", np.eye(4)
    few = Cloud(a.points[Cloud(a.points).sample(RunAlignmentTuning.probes, seed)])
    plain, moved = (overlap(few, cloud_b, max_distance, start, seed).fitness for start in (np.eye(4), T))
    return ("truth", T) if moved > plain + RunAlignmentTuning.min_gain else ("none", np.eye(4))


def check_registration(a: Side, b: Side, found: CloudRegistration, back: float) -> None:
    """Refuses a registration under which hardly anything lies upon anything.

    Args:
        found: of A upon B.
        back: share of B's points that have a partner in the moved A.

    Raises:
        ConfigError: it is nonsense.
    """
    best = max(found.overlap.fitness, back)
    if best < RunAlignmentTuning.min_overlap:
        raise ConfigError(
            f"`align` icp: {a.path} cannot be registered upon {b.path} by ICP: at the best pose found "
            f"({100 * found.moved_m:.0f} cm, {found.turned_deg:.0f} degrees away) {best:.0%} of the points "
            f"have a partner, {RunAlignmentTuning.min_overlap:.0%} needed; ICP needs a start within about a metre: use "
            "truth or trajectory, or move one of them first"
        )


def _true_world(side: Side) -> np.ndarray:
    """T_truth_side [4, 4]."""
    if side.trajectory is None:
        return np.eye(4)
    if side.truth is None:
        raise ConfigError(f"`align` truth: {side.path} has no ground_truth.txt; `ggslam report` writes it where the "
                          "recording knows true poses")  # fmt: skip
    pairs = pair_times(side.trajectory.timestamps, side.truth.timestamps, 1e-3)
    if len(pairs) < FEWEST_POSES:
        raise ConfigError(
            f"`align` truth: {side.path}: found true poses for {quantity(len(pairs), 'pose')}, {FEWEST_POSES} needed"
        )
    found, true = side.trajectory.T_world_camera[pairs[:, 0]], side.truth.T_world_camera[pairs[:, 1]]
    T = fit_similarity(_arms(found), _arms(true))[0]
    positions = true[:, :3, 3]
    error = float(np.sqrt((((T @ found)[:, :3, 3] - positions) ** 2).sum(1).mean()))
    extent = float(np.linalg.norm(np.ptp(positions, axis=0))) + RunAlignmentTuning.arm_m
    if error > RunAlignmentTuning.max_error * extent:
        raise ConfigError(
            f"`align` truth: the trajectory of {side.path} does not fit its true poses: {100 * error:.0f} cm off "
            f"(RMSE) along a path that spans {extent - RunAlignmentTuning.arm_m:.2f} m"
        )
    return T


def _arms(poses: np.ndarray) -> np.ndarray:
    """Places [4 N, 3]: of each camera [N, 4, 4], and points along its axes."""
    places = poses[:, None, :3, 3]
    return np.concatenate([places, places + RunAlignmentTuning.arm_m * poses[:, :3, :3].transpose(0, 2, 1)], 1).reshape(
        -1, 3
    )
