# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run's map from the poses of its frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import ConfigError
from ggslam.formats.atomic import make_folder
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.reporting.pictures import color_of_depth, color_to_uint8, depth_range, write_picture
from ggslam.run_folder import RunFolder
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse

KINDS = ("color", "depth", "alpha")


def frame_poses(record: dict[str, Any]) -> dict[int, np.ndarray]:
    """T_world_camera of each frame of a run that was not lost, by its index, from its keyframes as refined.

    Args:
        record: content of the run's keyframes.json.
    """
    keyframes = [np.array(k["T_world_camera"]) for k in record["keyframes"]]
    tracked = [f for f in record["frames"] if f["status"] != "lost" and f["keyframe"] < len(keyframes)]
    return {f["frame"]: keyframes[f["keyframe"]] @ np.array(f["T_keyframe_camera"]) for f in tracked}


def run_camera(folder: RunFolder) -> Camera:
    """The camera that the run saw with."""
    values: dict[str, Any] = folder.read_json("sequence.json")["camera"]
    return Camera(**values)


def select_frames(folder: RunFolder, numbers: str | None, every: int | None, count: int = 8) -> list[int]:
    """Frame numbers from a list like "0,50,100", or every n-th, or `count` spread evenly.

    Raises:
        ConfigError: not a number, or no such frame in the run.
    """
    known = sorted(frame_poses(folder.read_json("keyframes.json")))
    if numbers is not None:
        try:
            wanted = [int(number) for number in numbers.split(",")]
        except ValueError:
            raise ConfigError(f"--frames: expected numbers like 0,50,100, found {numbers!r}") from None
        missing = [number for number in wanted if number not in known]
        if missing:
            raise ConfigError(f"--frames: the run has frames {known[0]} to {known[-1]}, not {missing[0]}")
        return wanted
    if every is not None:
        return known[::every]
    return [known[i] for i in np.unique(np.linspace(0, len(known) - 1, count).round().astype(int))]


def render_frames(
    folder: RunFolder, frames: list[int], what: list[str], out: Path, width: int | None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Path]:  # fmt: skip
    """Renders frames to `out`/frame000123_color.png and so on; returns the files.

    Raises:
        ConfigError: `what` names something else than color, depth, alpha.
    """
    unknown = [kind for kind in what if kind not in KINDS]
    if unknown:
        raise ConfigError(f"--what: expected some of {','.join(KINDS)}, found {unknown[0]!r}")
    camera = run_camera(folder)
    if width is not None:
        camera = camera.resized(width, round(camera.height * width / camera.width))
    make_folder(out)
    gaussians, rasterizer = folder.gaussians(), CpuRasterizer()
    poses = frame_poses(folder.read_json("keyframes.json"))
    written = []
    for done, frame in enumerate(frames):
        view = rasterizer.forward(gaussians, camera, inverse(poses[frame]), features=False)
        pictures = {
            "color": lambda v=view: color_to_uint8(v.image.numpy()),
            "depth": lambda v=view: _depth_picture(v.expected_depth.numpy(), v.alpha.numpy()),
            "alpha": lambda v=view: (255 * np.clip(v.alpha.numpy(), 0, 1) + 0.5).astype(np.uint8),
        }
        for kind in what:
            written.append(out / f"frame{frame:06d}_{kind}.png")
            write_picture(written[-1], pictures[kind]())
        progress(done + 1)
    return written


def _depth_picture(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    depth = np.where(alpha > 0.5, depth, 0)
    return color_of_depth(depth, *depth_range(depth))
