# SPDX-License-Identifier: Apache-2.0
"""Where the frames of a run were seen from, and with which camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import RunFolderError
from ggslam.runs.folder import RunFolder, as_written
from ggslam.scene.camera import Camera


def frame_poses(record: dict[str, Any]) -> dict[int, np.ndarray]:
    """T_world_camera of each frame of a run that was not lost, by its index, from its keyframes as refined.

    Args:
        record: content of the run's keyframes.json.

    Raises:
        RunFolderError: it is not as a run writes it, or a pose is no finite matrix [4, 4].
    """
    with as_written(Path("keyframes.json")):
        keyframes = [np.array(k["T_world_camera"], float) for k in record["keyframes"]]
        tracked = [f for f in record["frames"] if f["status"] != "lost" and f["keyframe"] < len(keyframes)]
        poses = {f["frame"]: keyframes[f["keyframe"]] @ np.array(f["T_keyframe_camera"], float) for f in tracked}
    for frame, pose in poses.items():
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise RunFolderError(f"keyframes.json: pose of frame {frame}: expected 4x4 finite numbers")
    return poses


def run_camera(folder: RunFolder) -> Camera:
    """The camera that the run saw with."""
    with as_written(folder.path / "sequence.json"):
        return Camera(**folder.read_json("sequence.json")["camera"])
