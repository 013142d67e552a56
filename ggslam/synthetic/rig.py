# SPDX-License-Identifier: Apache-2.0
"""A generated recording by several cameras that are fixed to one another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import yaml

from ggslam import __version__
from ggslam.errors import SequenceError
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.synthetic.scene import Scene
from ggslam.synthetic.writer import check_target, new_folder, plan_recording, write_recording
from ggslam.system.tuning import Tuning

YAWS = {"front": 0.0, "left": -90.0, "back": 180.0, "right": 90.0}
"""Degrees by which a camera of this name is turned to the right."""


class SyntheticRigTuning(Tuning):
    """How cameras are mounted."""

    radius_m = 0.06
    """Distance from the middle of the rig to each camera, in metres."""


def camera_yaw(text: str) -> tuple[str, float]:
    """Name and yaw of a camera of a rig: one of `YAWS`, or a number of degrees to the right, which is called "yaw45".

    Raises:
        SequenceError: neither.
    """
    name = text.strip()
    if name in YAWS:
        return name, YAWS[name]
    try:
        yaw = float(name)
    except ValueError:
        yaw = np.nan
    if not abs(yaw) <= 360:
        raise SequenceError(f"rig: expected {', '.join(YAWS)} or degrees from -360 to 360, found '{name}'")
    return f"yaw{yaw:g}".replace("-", "m"), yaw


def camera_on_rig(yaw: float) -> np.ndarray:
    """T_rig_camera [4, 4] of a camera that looks away from the middle of the rig, so many degrees to the right."""
    angle = np.radians(yaw)
    T = np.eye(4)
    T[:3, 0], T[:3, 2] = (np.cos(angle), 0.0, -np.sin(angle)), (np.sin(angle), 0.0, np.cos(angle))
    T[:3, 3] = SyntheticRigTuning.radius_m * T[:3, 2]
    return np.where(np.abs(T) < 1e-12, 0.0, T)


def write_synthetic_rig(
    folder: str | Path,
    cameras: Sequence[str] = ("front", "back"),
    *,
    frames: int | None = None,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    noise: bool = True,
    trajectory: str | None = None,
    frame_rate: float | None = None,
    scene: Scene | str = "room",
    depth_distortion: float | None = None,
    delay: float = 0.0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Ray-casts recordings by the cameras of a rig: a folder for each, as `write_synthetic_sequence` makes it, and
    rig.yaml. The first camera walks as one alone does, and records the same.

    Args:
        folder: to be made.
        cameras: see `camera_yaw`.
        delay: seconds by which each camera takes its images after the one before it.
        frames, width, height, seed, noise, trajectory, frame_rate, scene, depth_distortion, overwrite: as of
            `write_synthetic_sequence`.
        progress: called with (frames done, frames), of all cameras.

    Returns:
        The folder.

    Raises:
        SequenceError: impossible arguments, or the folder cannot be written.
    """
    target = Path(folder)
    named = [camera_yaw(text) for text in cameras]
    names = [name for name, _ in named]
    if len(names) < 2 or len(set(names)) < len(names):
        raise SequenceError(f"rig: expected two cameras or more, each once, found {', '.join(names) or 'none'}")
    plan = plan_recording(width, height, frames, seed, noise, trajectory, frame_rate, scene, depth_distortion)
    if not 0 <= delay * (len(named) - 1) < 1 / plan.frame_rate:
        raise SequenceError(f"rig: expected a delay of less than a frame, {1 / plan.frame_rate:.3f} s, found {delay:g}")
    check_target(target, "rig.yaml", overwrite)
    T_rig_camera = [camera_on_rig(yaw) for _, yaw in named]
    with new_folder(target) as work:
        for number, name in enumerate(names):
            late = number * delay
            T_first_camera = inverse(T_rig_camera[0]) @ T_rig_camera[number]
            poses = _later(plan.poses, late * plan.frame_rate) @ T_first_camera
            (work / name).mkdir()
            told = _progress_of(progress, number, len(named))
            write_recording(work / name, plan, poses, plan.times + late, number, told)
        (work / "rig.yaml").write_text(_describe(names, T_rig_camera), encoding="utf-8")
    return target


def _later(poses: np.ndarray, share: float) -> np.ndarray:
    """Poses [n, 4, 4] a share of a step later; the last one goes on as the step before it went."""
    if not share:
        return poses
    steps = inverse(poses[:-1]) @ poses[1:]
    steps = np.concatenate([steps, steps[-1:]])
    return np.stack([T @ se3_exp(share * se3_log(step)) for T, step in zip(poses, steps, strict=True)])


def _progress_of(
    progress: Callable[[int, int], None] | None, number: int, cameras: int
) -> Callable[[int, int], None] | None:
    if progress is None:
        return None
    return lambda done, total: progress(number * total + done, cameras * total)


def _describe(names: Sequence[str], T_rig_camera: Sequence[np.ndarray]) -> str:
    entries = [
        {"name": name, "recording": name, "T_rig_camera": T.reshape(-1).round(12).tolist()}
        for name, T in zip(names, T_rig_camera, strict=True)
    ]
    text = yaml.safe_dump({"cameras": entries}, sort_keys=False, default_flow_style=None, width=200)
    return f"# generator: ggslam synth {__version__}\n{text}"
