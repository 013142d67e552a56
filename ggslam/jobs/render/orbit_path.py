# SPDX-License-Identifier: Apache-2.0
"""A way round a map that stays where a recording shows it well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ggslam.geometry.orbits import orbit
from ggslam.jobs.render.shots import Shot, Size, fill_size, look_at_pose, picture_count
from ggslam.runs.folder import RunFolder
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning
from ggslam.volumes.map_upright import upright_of


class OrbitPathTuning(Tuning):
    """Films round a map."""

    seconds = 12.0
    """Of a film that is not told otherwise."""
    samples = 100_000
    """Gaussians that tell which way is up, about."""
    share_left_out = 5.0
    """Percent of the recorded looking directions that are left out on either side."""
    full_turn_deg = 300.0
    """Recorded looking directions from which the way is a full turn; with less it swings to and fro."""
    step_back = 0.5
    """Radius of the circle that a camera turns on in the middle of a place, in spreads of the recorded positions."""
    fov_deg = 55.0
    """Field of view along the shorter side, for maps without a camera."""


@dataclass(frozen=True)
class Swing:
    """A way round a place.

    Attributes:
        middle: [3], what the circle is around, at the camera's height.
        target: [3], what is looked at by a camera that looks inward.
        radius: of the circle in metres.
        dip: tangent of the angle by which a camera that looks outward looks down.
        inward: whether the camera looks at the middle from the circle.
        azimuths: (first, last) looking direction in radians, about `up`.
        axes: [3, 3], rows: two level directions and up.
    """

    middle: np.ndarray
    target: np.ndarray
    radius: float
    dip: float
    inward: bool
    azimuths: tuple[float, float]
    axes: np.ndarray

    def pose(self, phase: float) -> np.ndarray:
        """T_world_camera [4, 4] at `phase` in [0, 1], a whole round."""
        first, last = self.azimuths
        if last - first >= 2 * np.pi - 1e-9:
            angle = first + 2 * np.pi * phase
        else:
            angle = first + (last - first) * (1 - np.cos(2 * np.pi * phase)) / 2
        along = np.cos(angle) * self.axes[0] + np.sin(angle) * self.axes[1]
        position = self.middle - self.radius * along
        return look_at_pose(position, self.target if self.inward else position + along - self.dip * self.axes[2],
                          self.axes[2])  # fmt: skip


def orbit_shots(
    folder: RunFolder, fps: float, seconds: float | None = None, size: Size | None = None
) -> list[Shot]:
    """A film that ends where it begins.

    Around what the cameras looked at from outside, or, where they looked outward (a room seen from its middle), turning
    in the middle of where they were; at their height, level, as far round as they looked. A file of Gaussians is seen
    from a circle around it.

    Raises:
        ConfigError: numbers that make no film.
    """
    count = picture_count(OrbitPathTuning.seconds if seconds is None else seconds, fps, whole=True)
    if folder.has_poses:
        poses = folder.keyframes().poses()
        camera = fill_size(folder.sequence().camera_of(min(poses)), size)
        swing = find_swing(map_sample(folder), np.stack([poses[frame] for frame in sorted(poses)]))
        seen = [swing.pose(k / count) for k in range(count)]
    else:
        camera = plain_camera(size or (1280, 720))
        seen = list(orbit(map_sample(folder).means.numpy(), camera, count))
    return [Shot(k / fps, T, camera) for k, T in enumerate(seen)]


def find_swing(gaussians: GaussianMap, poses: np.ndarray) -> Swing:
    """The way round a map by the poses [N, 4, 4] of the frames that it was made of, in their order."""
    up = upright_of(gaussians, poses).up
    axes = level_axes(up, poses[0, :3, 2])
    positions, forward = poses[:, :3, 3], poses[:, :3, 2]
    focus = _focus(positions, forward)
    level = forward @ axes.T
    ahead = ((focus - positions) * forward).sum(1)
    inward = bool(np.percentile(ahead, OrbitPathTuning.share_left_out) > 0)
    azimuths = _range_of(np.unwrap(np.arctan2(level[:, 1], level[:, 0])))
    height = float(np.median(positions @ up))
    if inward:
        across = (positions - focus) @ axes[:2].T
        radius = float(np.median(np.linalg.norm(across, axis=1)))
        middle = focus + (height - focus @ up) * up
        return Swing(middle, focus, radius, 0.0, True, azimuths, axes)
    middle = np.median(positions, axis=0)
    middle = middle + (height - middle @ up) * up
    spread = float(np.median(np.linalg.norm((positions - middle) @ axes[:2].T, axis=1)))
    dip = float(np.median(-level[:, 2] / np.maximum(np.linalg.norm(level[:, :2], axis=1), 0.1)))
    return Swing(middle, middle, OrbitPathTuning.step_back * spread, dip, False, azimuths, axes)


def _focus(positions: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The point [3] nearest to all optical axes, by least squares."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    normal = across.sum(0) + 1e-6 * len(positions) * np.eye(3)  # parallel axes meet nowhere: near the cameras then
    right = np.einsum("nij,nj->i", across, positions) + 1e-6 * positions.sum(0)
    return np.linalg.solve(normal, right)


def _range_of(azimuths: np.ndarray) -> tuple[float, float]:
    """First and last of looking directions in radians, unwrapped; a full turn where they are nearly one."""
    cut = OrbitPathTuning.share_left_out
    first, last = np.percentile(azimuths, [cut, 100 - cut])
    if azimuths.max() - azimuths.min() >= np.radians(OrbitPathTuning.full_turn_deg):
        return float(first), float(first) + 2 * np.pi
    return float(first), float(last)


def level_axes(up: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """[3, 3], rows: the level direction nearest to `forward`, the one to its left, and `up`."""
    ahead = forward - (forward @ up) * up
    if np.linalg.norm(ahead) < 1e-3:
        ahead = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead), up])


def plain_camera(size: Size) -> Camera:
    """A camera for maps without one, with its axis in the middle of the picture."""
    focal = min(size) / 2 / np.tan(np.radians(OrbitPathTuning.fov_deg) / 2)
    return Camera(*size, focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)


def map_sample(folder: RunFolder) -> GaussianMap:
    """Some of the Gaussians, of all parts of the map."""
    rows = folder.map_in_parts().rows
    out = GaussianMap(rows.like.sh_degree, rows.like.feature_channels, with_moments=False)
    step = max(1, len(rows) // OrbitPathTuning.samples)
    for block in rows.blocks():
        out.append(block.take(torch.arange(0, len(block), step)))
    return out
