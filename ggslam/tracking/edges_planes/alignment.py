# SPDX-License-Identifier: Apache-2.0
"""Aligns a scan's edges and planes to the local map: point-to-line and point-to-plane distances (equation 3),
Levenberg-Marquardt, Huber norm, wall-clock budget.

Matching works on the map's device. The least squares, a few thousand rows, are done with numpy: on a processor that is
several times as fast as tensors of this size, and for an accelerator one transfer per matching is cheaper than one
round trip per step.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ggslam.scene.poses import turning_angle
from ggslam.system.tuning import Tuning
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.settings import FeatureAlignSettings
from ggslam.tracking.edges_planes.voxels import FeatureMap
from ggslam.tracking.observability import about_point


class StepTimeTuning(Tuning):
    """Estimate of how long the next step takes."""

    margin = 1.3
    """Expected time of a step, in multiples of its usual time."""
    renewal = 0.1
    """Weight of the newest time in the running mean."""


LAST_STEP = "result"
"""What is left to do when the pose is found."""


class FrameClock:
    """Holds a frame to its budget of wall-clock time.

    It remembers how long each step usually takes, and lets one begin only if it is likely to end in time.

    Args:
        budget_ms: for a frame; 0: no limit.
    """

    def __init__(self, budget_ms: float) -> None:
        self._budget = budget_ms / 1e3 or float("inf")
        self._usual: dict[str, float] = {}
        self._began: dict[str, float] = {}
        self._lifted = False
        self._start = time.perf_counter()

    def start(self) -> None:
        """A frame begins."""
        self._start = time.perf_counter()
        self._lifted = False

    def lift(self) -> None:
        """The rest of this frame may take as long as it needs."""
        self._lifted = True

    def allows(self, step: str) -> bool:
        """Whether the step, and the last one of every frame after it, are likely to end in time; if so it begins."""
        self.begins(step)
        expected = StepTimeTuning.margin * (self._usual.get(step, 0.0) + self._usual.get(LAST_STEP, 0.0))
        return self._lifted or self._began[step] - self._start + expected <= self._budget

    def begins(self, step: str) -> None:
        """The step is timed from now until `ended`."""
        self._began[step] = time.perf_counter()

    def end_step(self, step: str) -> None:
        """The step has ended."""
        took = time.perf_counter() - self._began[step]
        usual = self._usual.get(step, took)
        # An interruption by other programs says little about the next time.
        self._usual[step] = usual + StepTimeTuning.renewal * (min(took, 2 * usual) - usual)


@dataclass(frozen=True)
class FeatureAlignment:
    """Where a scan's features fit.

    Attributes:
        T_map_sensor: float64 [4, 4].
        usable: whether enough features found a match.
        converged: whether the last matching hardly moved the pose.
        outer_iterations, inner_iterations: matchings and steps made.
        overlap: share of the plane features that lie on a plane of the map.
        rmse: root mean square point-to-plane distance of those, metres.
        information: float64 [6, 6], of the twist (v, w) from the left about the sensor's centre, in map axes, from all
            residuals, each with its noise and its voxel's, taken as independent (an optimist's view: neighbouring
            points share errors).
        visibility: float64 [6], ascending, the share of the features that see each direction of motion.
        weak_directions: float64 [k, 6], the directions seen by too few (see `gicp.AlignmentResult`).
    """

    T_map_sensor: np.ndarray
    usable: bool
    converged: bool
    outer_iterations: int
    inner_iterations: int
    overlap: float
    rmse: float
    information: np.ndarray
    visibility: np.ndarray
    weak_directions: np.ndarray


class _Scan:
    """Features as numpy arrays: points [n, 3], planes first, and standard deviations [n]."""

    def __init__(self, scan: ScanFeatures) -> None:
        self.features, self.planes = scan, len(scan.planes)
        self.points = scan.points.cpu().numpy()
        self.sigmas = scan.all_sigmas.cpu().numpy()


@dataclass(frozen=True)
class _Matched:
    """Map surfaces of a scan's points: found bool [n], and `Matches.surfaces` [n, 8]."""

    found: np.ndarray
    surfaces: np.ndarray

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Of the first [m, 3] points to the planes they are matched to, [m], metres."""
        m = len(points)
        return np.abs(np.einsum("ij,ij->i", points - self.surfaces[:m, :3], self.surfaces[:m, 3:6]))


@dataclass(frozen=True)
class _Residuals:
    """Distances to minimise, all of one form: axis . (R q + t) - offset, over their standard deviation. A line has two
    axes across it. Being linear in R and t, all of them and their derivatives are one product with a matrix of the
    pose (`_pose_matrix`).

    Attributes:
        rows: float32 [m, 13], axis_x q, axis_y q, axis_z q, axis, offset, all over the standard deviation.
        points: q, float32 [m, 3], in the sensor's frame.
        weights: float32 [m], inverse variances.
        lines: number of lines; their rows come last, first axes before second ones.
    """

    rows: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    lines: int


@dataclass(frozen=True)
class _Fit:
    """Normal equations H [6, 6], g [6] and the Huber cost at a pose T [4, 4]."""

    T: np.ndarray
    H: np.ndarray
    g: np.ndarray
    cost: float


class FeatureAligner:
    """Fits scans to the map.

    Args:
        features: the map.
        settings: see `FeatureAlignSettings`.
        clock: holds a frame to its budget.
    """

    def __init__(self, features: FeatureMap, settings: FeatureAlignSettings, clock: FrameClock) -> None:
        self._features, self._settings, self._clock = features, settings, clock

    def align(self, scan: ScanFeatures, T_map_sensor_guess: np.ndarray) -> FeatureAlignment:
        """The pose [4, 4] at which the scan fits the map best, near the guess. Begins the clock's last step."""
        s, T = self._settings, np.array(T_map_sensor_guess, float)
        outer, steps, settled, points = 0, 0, False, _Scan(scan)
        self._clock.begins("matching")
        while outer == 0 or (outer < s.outer_iterations and not settled and self._clock.allows("matching")):
            matched = self._match(points, T)
            residuals = self._residuals(points, matched, T, outer + 1 == s.outer_iterations)
            outer += 1
            fit = _Fit(T, np.zeros((6, 6)), np.zeros(6), 0.0)
            if len(residuals.rows) < s.min_matches:
                break
            fit, made = self._minimise(residuals, T)
            steps += made
            self._clock.end_step("matching")
            settled = self._is_settled(T, fit.T, scan)
            T = fit.T
        self._clock.begins(LAST_STEP)
        return self._result(points, matched, residuals, fit, settled, outer, steps)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _is_settled(self, T: np.ndarray, T_next: np.ndarray, scan: ScanFeatures) -> bool:
        """Whether a motion is so small that matching anew would change little."""
        moved = float(np.linalg.norm(T_next[:3, 3] - T[:3, 3])) + turning_angle(T, T_next) * scan.median_distance
        return moved < self._settings.rematch_share * self._features.settings.plane_voxel

    @torch.inference_mode()
    def _match(self, scan: _Scan, T: np.ndarray) -> _Matched:
        features = scan.features
        M = torch.from_numpy(T[:3].astype(np.float32)).to(features.planes.device)
        R, t = M[:, :3].T, M[:, 3]
        found = self._features.match(torch.addmm(t, features.points, R), scan.planes, features.all_normals @ R)
        return _Matched(found.found.cpu().numpy(), found.surfaces.cpu().numpy())

    def _residuals(self, scan: _Scan, matched: _Matched, T: np.ndarray, is_last: bool) -> _Residuals:
        """Distances of planes and edges. Before the last matching the pose is not yet good, and outliers are told
        generously."""
        s, P, kept = self._settings, scan.planes, matched.found.copy()
        gate = (s.gate_constant + s.gate_sigmas * scan.sigmas[:P]) * (1.0 if is_last else 3.0)
        kept[:P] &= matched.distances(_transform(T, scan.points[:P])) < gate
        if s.edge_weight == 0:
            kept[P:] = False
        planes, lines = int(np.count_nonzero(kept[:P])), int(np.count_nonzero(kept[P:]))
        chosen = np.flatnonzero(kept)
        q, surfaces = scan.points.take(chosen, 0), matched.surfaces.take(chosen, 0)
        weights = 1.0 / (scan.sigmas.take(chosen) ** 2 + surfaces[:, 6])
        anchors, axes = surfaces[:, :3], surfaces[:, 3:6]
        if lines:
            weights[planes:] *= s.edge_weight
            axes = np.concatenate([axes[:planes], *_across(axes[planes:])])
            q, anchors, weights = (np.concatenate([a, a[planes:]]) for a in (q, anchors, weights))
        rows = np.empty((len(q), 13), np.float32)
        np.multiply(axes[:, :, None], q[:, None, :], out=rows[:, :9].reshape(-1, 3, 3))
        rows[:, 9:12] = axes
        rows[:, 12] = np.einsum("ij,ij->i", anchors, axes)
        rows *= np.sqrt(weights)[:, None]
        return _Residuals(rows, q, weights, lines)

    def _minimise(self, residuals: _Residuals, T: np.ndarray) -> tuple[_Fit, int]:
        """Levenberg-Marquardt with fixed matches, and the number of steps made: at least one."""
        s = self._settings
        fit = self._linearise(residuals, T)
        damping, steps = 1e-6, 0
        while steps < s.inner_iterations and (steps == 0 or self._clock.allows("step")):
            damped = fit.H.copy()
            damped.flat[::7] *= 1 + damping
            damped.flat[::7] += 1e-9  # what no residual sees stays as it is
            step = -np.linalg.solve(damped, fit.g)
            T_next = fit.T.copy()
            T_next[:3, :3] = cv2.Rodrigues(step[3:])[0] @ T_next[:3, :3]
            T_next[:3, 3] += step[:3]
            next_fit = self._linearise(residuals, T_next)
            steps += 1
            if steps > 1:
                self._clock.end_step("step")
            if next_fit.cost <= fit.cost:
                fit, damping = next_fit, 0.1 * damping
            else:
                damping = 100 * damping
            if np.abs(step[:3]).max() < s.translation_tolerance and np.abs(step[3:]).max() < s.rotation_tolerance:
                break
        return fit, steps

    def _linearise(self, residuals: _Residuals, T: np.ndarray) -> _Fit:
        """Normal equations of a twist from the left about the sensor's centre, and the Huber cost."""
        lines, k = residuals.lines, self._settings.huber_sigmas
        rows = residuals.rows @ _pose_matrix(T)
        size = np.abs(rows[:, 6])
        if lines:  # Huber's norm is of the distance to the line
            both = np.hypot(size[-2 * lines : -lines], size[-lines:])
            size[-2 * lines : -lines], size[-lines:] = both, both
        np.maximum(size, 1e-12, out=size)
        inner = np.minimum(size, k)
        cost = inner * (2 * size - inner)
        sums = (rows * (inner / size)[:, None]).T @ rows
        H = sums.astype(np.float64)
        # the second axes are counted with the first
        return _Fit(T, H[:6, :6], H[:6, 6], float(cost[: len(cost) - lines].sum(dtype=np.float64)))

    def _result(
        self, scan: _Scan, matched: _Matched, residuals: _Residuals, fit: _Fit, settled: bool, outer: int, steps: int
    ) -> FeatureAlignment:
        s, rows, P = self._settings, len(residuals.rows), scan.planes
        found = matched.found[:P]
        distance = np.where(found, matched.distances(_transform(fit.T, scan.points[:P])), np.inf).astype(np.float32)
        inlier = distance < s.overlap_constant + s.overlap_sigmas * scan.sigmas[:P]
        count = int(np.count_nonzero(inlier))
        visibility, weak = _observability(fit, residuals, s.degenerate_below)
        return FeatureAlignment(
            fit.T, rows >= s.min_matches, settled, outer, steps, count / max(P, 1),
            math.sqrt(float(np.square(distance[inlier]).sum()) / max(count, 1)), fit.H, visibility, weak,
        )  # fmt: skip


def _pose_matrix(T: np.ndarray) -> np.ndarray:
    """The matrix float32 [13, 7] that turns a row of `_Residuals` into its derivatives by the twist (v, w) from the
    left about the sensor's centre, axis and (R q) x axis, and its distance."""
    C = np.zeros((13, 7), np.float32)
    R = T[:3, :3]
    C[:9, 6], C[9:12, 6], C[12, 6] = R.reshape(9), T[:3, 3], -1
    C[(9, 10, 11), (0, 1, 2)] = 1
    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # (R q)_y axis_z - (R q)_z axis_y
        C[3 * z : 3 * z + 3, 3 + x] = R[y]
        C[3 * y : 3 * y + 3, 3 + x] = -R[z]
    return C


def _observability(fit: _Fit, residuals: _Residuals, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues [6] and weak directions [k, 6], as `gicp.observability` has them, of these residuals."""
    if not len(residuals.points):
        return np.zeros(6), np.eye(6)
    weights = residuals.weights
    total = float(weights.sum(dtype=np.float64))
    centroid = (weights @ residuals.points).astype(np.float64) / total
    offset = residuals.points - centroid.astype(np.float32)
    radius = math.sqrt(float(weights @ np.einsum("ij,ij->i", offset, offset)) / total)
    about = about_point(fit.H, -fit.T[:3, :3] @ centroid)
    scale = np.array([1.0, 1.0, 1.0] + [1.0 / max(radius, 1e-3)] * 3)
    values, vectors = np.linalg.eigh(about * np.outer(scale, scale) / total)
    return values, vectors[:, values < limit].T


def _transform(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points float32 [n, 3] in the frame that T [4, 4] leads to."""
    M = T.astype(np.float32)
    return points @ M[:3, :3].T + M[:3, 3]


def _across(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [n, 3] at right angles to unit vectors [n, 3] and to each other."""
    x, y, z = directions.T
    zero = np.zeros_like(x)
    steep = (np.abs(z) > 0.7)[:, None]
    first = np.where(steep, np.stack([zero, z, -y], 1), np.stack([y, -x, zero], 1))
    first /= np.sqrt(np.einsum("ij,ij->i", first, first))[:, None]
    a, b, c = first.T
    return first, np.stack([y * c - z * b, z * a - x * c, x * b - y * a], 1)
