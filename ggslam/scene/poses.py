# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms: 4x4 float64 matrices, unit quaternions (wxyz), and the exponential map of SE(3)."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dgesdd, dgetrf

_Row = tuple[float, float, float, float]
Matrix = tuple[_Row, _Row, _Row, _Row]


def skew(w: np.ndarray) -> np.ndarray:
    """Matrix [w]x with [w]x v = w x v, [3, 3]."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def translation(by: np.ndarray) -> np.ndarray:
    """Transforms [..., 4, 4] of shifts [..., 3]."""
    T = np.zeros((*np.shape(by)[:-1], 4, 4))
    T[..., :, :] = np.eye(4)
    T[..., :3, 3] = by
    return T


def se3_exp(twist: np.ndarray) -> np.ndarray:
    """Exponential of a twist (v, w) [6], translation first: a transform [4, 4], or NaN. |w| in radians."""
    vx, vy, vz, x, y, z = map(float, twist)  # numbers: optimisation steps take many, and arrays of three cost more
    angle2 = x * x + y * y + z * z
    if not math.isfinite(angle2):
        return np.full((4, 4), np.nan)
    angle = math.sqrt(angle2)
    if angle < 1e-6:
        a, b, c = 1.0 - angle2 / 6, 0.5 - angle2 / 24, 1.0 / 6 - angle2 / 120
    else:
        a, b, c = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    # R = I + a W + b W W and t = (I + b W + c W W) v, with W v = w x v and W W = w w^T - |w|^2 I.
    along, d = c * (x * vx + y * vy + z * vz), 1.0 - c * angle2
    ax, ay, az = a * x, a * y, a * z
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    return np.array([
        [1.0 - b * (y * y + z * z), xy - az, xz + ay, d * vx + b * (y * vz - z * vy) + along * x],
        [xy + az, 1.0 - b * (x * x + z * z), yz - ax, d * vy + b * (z * vx - x * vz) + along * y],
        [xz - ay, yz + ax, 1.0 - b * (x * x + y * y), d * vz + b * (x * vy - y * vx) + along * z],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip


def rotation_about(axis: np.ndarray, degrees: float) -> np.ndarray:
    """The rotation [3, 3] about an axis [3], a unit vector."""
    return se3_exp(np.concatenate([np.zeros(3), np.radians(degrees) * axis]))[:3, :3]


def left_multiplication(quaternions: np.ndarray) -> np.ndarray:
    """Matrices [..., 4, 4] whose product with a quaternion wxyz is the Hamilton product of these [..., 4] with it."""
    w, x, y, z = np.moveaxis(np.asarray(quaternions, np.float64), -1, 0)
    rows = [(w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w)]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def so3_log(R: np.ndarray) -> np.ndarray:
    """Rotation vector [3] in radians of a rotation matrix [3, 3], angle in [0, pi]."""
    q = matrix_to_quaternion(R)
    if q[0] < 0:
        q = -q
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-12:
        return 2.0 * q[1:]
    return 2.0 * np.arctan2(sine, q[0]) * q[1:] / sine


def se3_log(T: np.ndarray) -> np.ndarray:
    """Twist (v, w) [6] with se3_exp(twist) = T; inverse of `se3_exp` for angles below pi."""
    w = so3_log(T[:3, :3])
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < 1e-4:
        factor = 1.0 / 12 + angle**2 / 720
    else:
        factor = (1 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2  # the half angle stays exact near half a turn
    V_inverse = np.eye(3) - 0.5 * W + factor * W @ W
    return np.concatenate([V_inverse @ T[:3, 3], w])


def transform_points(points: np.ndarray, T_to_from: np.ndarray) -> np.ndarray:
    """Points [n, 3] in the frame that T_to_from [4, 4] leads to."""
    return points @ T_to_from[:3, :3].T + T_to_from[:3, 3]


def turning_angle(T_one: np.ndarray, T_other: np.ndarray) -> float:
    """Angle in radians between the rotations of two poses [4, 4]."""
    apart = (T_one[:3, :3] - T_other[:3, :3]).ravel()
    return 2.0 * math.asin(min(1.0, math.sqrt(apart.dot(apart)) / math.sqrt(8.0)))


def separation(T_one: np.ndarray, T_other: np.ndarray) -> tuple[float, float]:
    """How far two poses [4, 4] are apart: metres and degrees."""
    shift = T_one[:3, 3] - T_other[:3, 3]
    return math.sqrt(shift.dot(shift)), math.degrees(turning_angle(T_one, T_other))


def motion_of(T_new_old: np.ndarray, middle: np.ndarray) -> tuple[float, float]:
    """How far a motion [4, 4] moves a thing with its middle at [3], metres, and turns it, degrees."""
    shift = transform_points(middle[None], T_new_old)[0] - middle
    return float(np.linalg.norm(shift)), math.degrees(turning_angle(T_new_old, np.eye(4)))


def to_matrix(T: np.ndarray) -> Matrix:
    """A pose [4, 4] as files have it."""
    a, b, c, d = ((float(r[0]), float(r[1]), float(r[2]), float(r[3])) for r in T)
    return a, b, c, d


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms, [..., 4, 4]."""
    R_t = T[..., :3, :3].swapaxes(-1, -2)
    out = np.zeros(T.shape, T.dtype)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def orthonormalize(T: np.ndarray) -> np.ndarray:
    """The transform with its 3x3 part replaced by the nearest rotation (removes accumulated rounding)."""
    U, _, Vt, failed = dgesdd(T[:3, :3])  # np.linalg calls the same with twenty functions of Python about it
    if failed:
        raise np.linalg.LinAlgError(f"no nearest rotation of {T[:3, :3].tolist()}")
    sign, out = np.zeros((3, 3)), np.zeros((4, 4))
    sign[0, 0] = sign[1, 1] = out[3, 3] = 1.0
    sign[2, 2] = _determinant(U @ Vt)
    out[:3, :3] = U @ sign @ Vt
    out[:3, 3] = T[:3, 3]
    return out


def _determinant(R: np.ndarray) -> float:
    """Of a rotation [3, 3] or a reflection, to the last digit as `np.linalg.det` has it."""
    factors, rows, _ = dgetrf(R)
    a, b, c = factors.diagonal().tolist()
    first, second, _ = rows.tolist()  # each was swapped with a row, or itself
    size = math.exp(math.log(abs(a)) + math.log(abs(b)) + math.log(abs(c)))
    return math.copysign(size, a * b * c) * (1 if (first == 0) == (second == 1) else -1)


def fit_similarity(source: np.ndarray, target: np.ndarray, with_scale: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The similarities that bring points nearest to their partners in the least-squares sense (S. Umeyama,
    "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", 1991).

    Args:
        source, target: [..., N, 3], corresponding points, N >= 3.
        with_scale: also estimates a scale; else it is 1.

    Returns:
        (T_target_source [..., 4, 4] rigid, scale s [...]): target ~ R (s source) + t.
    """
    source_mean, target_mean = source.mean(-2), target.mean(-2)
    a, b = source - source_mean[..., None, :], target - target_mean[..., None, :]
    U, singular, Vt = np.linalg.svd(np.swapaxes(b, -1, -2) @ a)
    signs = np.ones_like(singular)
    signs[..., 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))  # no reflections
    R = (U * signs[..., None, :]) @ Vt
    spread = (a * a).sum((-2, -1))
    scale = np.ones_like(spread)
    if with_scale:
        scale = np.where(spread > 0, (singular * signs).sum(-1) / np.maximum(spread, 1e-300), 1.0)
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., 3, 3] = R, 1
    T[..., :3, 3] = target_mean - (scale[..., None, None] * R @ source_mean[..., None])[..., 0]
    return T, scale


def quaternion_to_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions wxyz [..., 4] (normalised here)."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quaternion(R: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [..., 4] of rotation matrices [..., 3, 3].

    Shepperd's method: of four equivalent formulas the one with the largest divisor is taken for each matrix.
    """
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    squares = np.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1)
    a, b, c = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    d, e, f = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    candidates = np.stack(
        [np.stack([squares[..., 0], a, b, c], -1), np.stack([a, squares[..., 1], d, e], -1),
         np.stack([b, d, squares[..., 2], f], -1), np.stack([c, e, f, squares[..., 3]], -1)], -2
    )  # fmt: skip
    best = np.argmax(squares, -1)[..., None, None]
    q = np.take_along_axis(candidates, best, -2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def is_valid_pose(T: np.ndarray) -> bool:
    """Whether a 4x4 matrix is finite and its rotation part orthonormal to 1 % with determinant +1."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-2 and np.linalg.det(R) > 0.5)
