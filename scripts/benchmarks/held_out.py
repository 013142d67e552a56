# SPDX-License-Identifier: Apache-2.0
"""The frames that a run never trained on, for the benchmarks."""

from __future__ import annotations

import numpy as np

from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import inverse


def held_out_poses(folder: RunFolder) -> dict[int, np.ndarray]:
    """T_camera_world by frame number; of a run that held out none, those of the frames that are no keyframes."""
    record = folder.keyframes()
    poses, keyframes = record.poses(), record.keyframe_numbers()
    evaluation = folder.config().evaluation
    others = [index for index in sorted(poses) if index not in keyframes]
    number = folder.sequence().own_number
    held_out = [i for i in others if evaluation.is_held_out(number(i))]
    return {index: inverse(poses[index]) for index in held_out or others}
