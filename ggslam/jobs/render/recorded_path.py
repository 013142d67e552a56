# SPDX-License-Identifier: Apache-2.0
"""The camera's own way through a run, as smooth as one likes."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ggslam.errors import ConfigError
from ggslam.jobs.render.shots import Shot, Size, fill_size, film_times
from ggslam.runs.folder import RunFolder
from ggslam.system.tuning import Tuning


class RecordedPathTuning(Tuning):
    """Films along the recorded way."""

    smoothing_s = 0.25
    """Standard deviation of the smoothing of poses over time, in seconds: hands that tremble are calm."""
    max_smoothing_s = 60.0
    """Most of it: longer, and a film hardly moves."""
    frame_s = 1 / 30
    """Time between frames without times, in seconds."""


def recorded_shots(
    folder: RunFolder, fps: float, seconds: float | None = None, size: Size | None = None,
    smoothing: float = RecordedPathTuning.smoothing_s, at_frames: bool = False,
) -> list[Shot]:  # fmt: skip
    """A film along the recorded way: of a rig along its first camera's, of a merged run along its longest recording's.

    Args:
        folder: of the run.
        fps: pictures a second.
        seconds: that the film shall take; None: as the recording.
        size: of the pictures; None: as the run saw them.
        smoothing: of the poses, a standard deviation in seconds; 0: the way goes through each pose at its time.
        at_frames: each picture is seen from the pose of the last frame recorded by then, for comparing the two.

    Raises:
        ConfigError: the run has no poses, or numbers that make no film.
    """
    if not folder.has_poses:
        raise ConfigError(f"{folder.path}: tells no recorded poses; use `path` orbit or a file of keys")
    if not 0 <= smoothing <= RecordedPathTuning.max_smoothing_s:
        limit = f"expected 0 to {RecordedPathTuning.max_smoothing_s:g} seconds"
        raise ConfigError(f"`smoothing`: {limit}, found {smoothing:g}")
    frames, times, poses = _longest_walk(folder)
    shown, taken = film_times(float(times[-1]), fps, seconds)
    last = np.clip(np.searchsorted(times, taken + 1e-6, side="right") - 1, 0, len(frames) - 1)
    camera = fill_size(folder.sequence().camera_of(frames[0]), size)
    seen = poses[last] if at_frames else smooth_poses(times, poses, taken, smoothing)
    return [Shot(float(t), T, camera, frames[i]) for t, T, i in zip(shown, seen, last, strict=True)]


def _longest_walk(folder: RunFolder) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Frames, their times from 0 in seconds, rising, and T_world_camera [n, 4, 4]."""
    record, poses, recording = folder.keyframes(), folder.keyframes().poses(), folder.sequence()
    walks: dict[tuple[int, int], list[int]] = {}
    for number in sorted(poses):
        walks.setdefault(recording.walk_of(number), []).append(number)
    if not walks:
        raise ConfigError(f"{folder.path}: no frame of this run was located, so there is nowhere to look from")
    frames = max((walk for (_, camera), walk in walks.items() if camera == 0), key=len, default=[*walks.values()][0])
    told = {f.frame: f.timestamp for f in record.frames}
    times = np.array([np.nan if told.get(f) is None else told[f] for f in frames], float)
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        times = (np.array(frames) - frames[0]) * RecordedPathTuning.frame_s
    return frames, times - times[0], np.stack([poses[f] for f in frames])


def smooth_poses(times: np.ndarray, poses: np.ndarray, at: np.ndarray, smoothing: float) -> np.ndarray:
    """Poses between poses.

    Args:
        times: float64 [n], rising.
        poses: T_world_camera [n, 4, 4] at these.
        at: float64 [m], times within them.
        smoothing: standard deviation in seconds; with 0, a straight line at even speed leads from pose to pose.

    Returns:
        T_world_camera float64 [m, 4, 4].
    """
    if len(times) == 1:
        return np.repeat(poses, len(at), 0)
    if smoothing > 0:
        step = min(smoothing / 4, max(times[-1], 1e-6))
        grid = np.linspace(0, times[-1], int(np.ceil(times[-1] / step)) + 1)
        poses, times = _filter_poses(smooth_poses(times, poses, grid, 0), smoothing / (grid[1] - grid[0])), grid
    out = np.tile(np.eye(4), (len(at), 1, 1))
    at = np.clip(at, times[0], times[-1])
    out[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(at, times, poses[:, axis, 3])
    return out


def _filter_poses(poses: np.ndarray, sigma: float) -> np.ndarray:
    """Means of neighbouring poses [n, 4, 4] under a bell curve of `sigma` rows; rotations as means of quaternions."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turned = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0))
    quaternions[1:] *= turned[:, None]  # q and -q are one rotation; the mean needs neighbours on one side
    out = poses.copy()
    out[:, :3, 3] = gaussian_filter1d(poses[:, :3, 3], sigma, axis=0, mode="nearest")
    out[:, :3, :3] = Rotation.from_quat(gaussian_filter1d(quaternions, sigma, axis=0, mode="nearest")).as_matrix()
    return out
