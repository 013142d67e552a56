#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Tracks recordings against a map of discs put in at keyframes (a stand-in for the mapper) and prints how well.

    python scripts/bench_tracking.py ../shared/data/livingroom ../shared/data/redkitchen
    python scripts/bench_tracking.py ../shared/data/shelf --scale 0.5 --state trained --photometric always

The map is in one of two states: `birth` (discs as inserted) or `trained` (means moved by 1.5 mm in the plane and 0.5 mm
along the normal, axes turned by 3 degrees, sizes changed, as optimisation does).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import cv2
import numpy as np
import torch

from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, matrix_to_quaternion, orthonormalized, quaternion_to_matrix
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.gicp import GicpTarget, align
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import TrackerSettings


def explained_depth(gaussians: GaussianMap, frame: Frame, T_world_camera: np.ndarray) -> np.ndarray:
    """Depth of the nearest Gaussian about each pixel, infinite where the map has none, [H, W]."""
    camera = frame.camera
    T = inverse(T_world_camera).astype(np.float32)
    p = gaussians.means.numpy() @ T[:3, :3].T + T[:3, 3]
    p = p[p[:, 2] > 0.05]
    u = np.rint(camera.fx * p[:, 0] / p[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * p[:, 1] / p[:, 2] + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(depth, (v[inside], u[inside]), p[inside, 2])
    return cv2.erode(depth, np.ones((3, 3)))


def insert_discs(
    gaussians: GaussianMap, frame: Frame, T: np.ndarray, keyframe: int, settings: TrackerSettings,
    context: NativeContext, state: str, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Adds a flat disc for each pixel that the map does not explain."""
    camera = frame.camera
    dense = dataclasses.replace(settings.points, count=camera.width * camera.height)
    found = extract_points(frame.depth, camera, dense, settings.noise, context)
    u, v = found.pixels.T
    z = found.points[:, 2]
    if len(gaussians):
        known = explained_depth(gaussians, frame, T)[v, u]
        new = ~np.isfinite(known) | (z < known - np.maximum(0.05, 0.03 * known))
    else:
        new = np.ones(len(z), bool)
    R = T[:3, :3].astype(np.float32)
    normals = found.normals[new] @ R.T
    means = found.points[new] @ R.T + T[:3, 3].astype(np.float32)
    quaternions = rotation_from_z(normals)
    scale = 0.6 * z[new] / camera.fx
    log_scales = np.log(np.stack([scale, scale, 0.2 * scale], 1))
    if state == "trained":
        means, quaternions, log_scales = perturbed(means, quaternions, log_scales, normals, rng)
    gaussians.insert(
        *(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (means, quaternions, log_scales)),
        torch.full((len(means),), 2.0), torch.from_numpy(frame.color[v, u][new].astype(np.float32) / 255),
        birth_keyframe=keyframe,
    )  # fmt: skip


def rotation_from_z(normals: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [n, 4] that turn the z axis to unit vectors [n, 3]."""
    q = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals), np.float32)], 1)
    q[normals[:, 2] < -0.999] = [0, 1, 0, 0]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def perturbed(
    means: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Discs as training leaves them: moved, turned and resized a little."""
    move = rng.normal(0, 0.0015, means.shape)
    move -= (move * normals).sum(1, keepdims=True) * normals
    move += rng.normal(0, 0.0005, (len(means), 1)) * normals
    turned = quaternions + rng.normal(0, np.radians(3) / 2, quaternions.shape)
    return means + move, turned / np.linalg.norm(turned, axis=1, keepdims=True), log_scales + rng.normal(0, 0.3, log_scales.shape)


def ate_rmse(estimated: np.ndarray, true: np.ndarray) -> float:
    """Root mean square distance of camera centres [n, 4, 4] after the best rigid alignment, metres."""
    x, y = estimated[:, :3, 3], true[:, :3, 3]
    U, _, Vt = np.linalg.svd((y - y.mean(0)).T @ (x - x.mean(0)))
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt((((x - x.mean(0)) @ R.T + y.mean(0) - y) ** 2).sum(1).mean()))
