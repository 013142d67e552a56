# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimated trajectory: ATE and RPE.

J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012. Alignment: S. Umeyama,
"Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", PAMI 1991.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from ggslam.errors import InputError
from ggslam.scene.poses import fit_similarity, inverse

FEWEST_POSES: Final = 3
"""Positions that a rigid alignment needs."""


@dataclass(frozen=True)
class TrajectoryScores:
    """Errors over the frames for which both the estimate and the truth are known.

    Attributes:
        ate_rmse_m: root mean square distance of the positions after the best rigid alignment (no scale).
        ate_mean_m, ate_median_m, ate_max_m: of the same distances. (Some papers print the mean under the name RMSE.)
        ate_raw_rmse_m: root mean square distance without alignment, the first common pose alone being put upon the
            truth; for a run that began at the true first pose these are the poses as estimated.
        rpe_trans_m, rpe_rot_deg: root mean square error of the motion over `rpe_delta` frames; NaN if no two known
            frames lie that far apart.
        rpe_delta: frames.
        frames_compared: number of common frames.
    """

    ate_rmse_m: float
    ate_mean_m: float
    ate_median_m: float
    ate_max_m: float
    ate_raw_rmse_m: float
    rpe_trans_m: float
    rpe_rot_deg: float
    rpe_delta: int
    frames_compared: int

    def to_dict(self) -> dict[str, float | int | None]:
        """For JSON: NaN becomes None."""
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(self).items()}


def align_points(source: np.ndarray, target: np.ndarray, with_scale: bool = False) -> tuple[np.ndarray, float]:
    """The similarity that brings `source` nearest to `target` in the least-squares sense (Umeyama).

    Args:
        source, target: [N, 3] corresponding points, N >= 3.
        with_scale: also estimates a scale; else it is 1 (Horn).

    Returns:
        (T_target_source [4, 4] rigid, scale s): target ~ R (s source) + t.
    """
    if source.shape != target.shape or source.ndim != 2 or len(source) < FEWEST_POSES:
        raise InputError(f"expected two sets of at least {FEWEST_POSES} points, found {source.shape}, {target.shape}")
    T, scale = fit_similarity(source, target, with_scale)
    return T, float(scale)


def score_trajectory(
    estimated: np.ndarray | Sequence[np.ndarray | None],
    truth: np.ndarray | Sequence[np.ndarray | None],
    rpe_delta: int = 1,
) -> TrajectoryScores | None:
    """Compares two trajectories frame by frame.

    Args:
        estimated, truth: N camera-to-world poses [4, 4] each, None or not finite where unknown; such frames are left
            out.
        rpe_delta: distance of the frames between which motion is compared.

    Returns:
        The scores; None if fewer than 3 frames are known (given and finite) in both, also of empty trajectories.

    Raises:
        InputError: different lengths, poses of another shape, or rpe_delta < 1.
    """
    P, Q = _stack(estimated), _stack(truth)
    if len(P) != len(Q) or rpe_delta < 1:
        raise InputError(f"{len(P)} estimated and {len(Q)} true poses, rpe_delta {rpe_delta}")
    known = np.isfinite(P).all((1, 2)) & np.isfinite(Q).all((1, 2))
    if known.sum() < FEWEST_POSES:
        return None
    T, _ = align_points(P[known, :3, 3], Q[known, :3, 3])
    distance = _distances(T, P[known], Q[known])
    first = int(np.argmax(known))
    raw = _distances(Q[first] @ inverse(P[first]), P[known], Q[known])
    translation, rotation = _relative_errors(P, Q, known, rpe_delta)
    return TrajectoryScores(
        ate_rmse_m=_rms(distance),
        ate_mean_m=float(distance.mean()),
        ate_median_m=float(np.median(distance)),
        ate_max_m=float(distance.max()),
        ate_raw_rmse_m=_rms(raw),
        rpe_trans_m=_rms(translation),
        rpe_rot_deg=float(np.rad2deg(_rms(rotation))),
        rpe_delta=rpe_delta,
        frames_compared=int(known.sum()),
    )


def _stack(poses: np.ndarray | Sequence[np.ndarray | None]) -> np.ndarray:
    """[N, 4, 4] float64 with NaN for None."""
    stacked = np.full((len(poses), 4, 4), np.nan)
    for i, T in enumerate(poses):
        if T is None:
            continue
        if np.shape(T) != (4, 4):
            raise InputError(f"pose {i}: expected a 4x4 matrix, found shape {list(np.shape(T))}")
        stacked[i] = T
    return stacked


def _distances(T: np.ndarray, P: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Distances [N] of the positions of T P and Q."""
    moved = P[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    return np.linalg.norm(moved - Q[:, :3, 3], axis=1)


def _relative_errors(P: np.ndarray, Q: np.ndarray, known: np.ndarray, delta: int) -> tuple[np.ndarray, np.ndarray]:
    """Translation [M] and rotation angle [M] of (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) for j = i + delta, both known."""
    start = np.nonzero(known[:-delta] & known[delta:])[0] if len(known) > delta else np.empty(0, np.int64)
    true_motion = inverse(Q[start]) @ Q[start + delta]
    E = inverse(true_motion) @ (inverse(P[start]) @ P[start + delta])
    R = E[:, :3, :3]
    # atan2 of sine and cosine: unlike the arc cosine of the trace it is exact for small angles.
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
    angle = np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1)
    return np.linalg.norm(E[:, :3, 3], axis=1), angle


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan
