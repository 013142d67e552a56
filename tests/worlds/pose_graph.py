# SPDX-License-Identifier: Apache-2.0
"""Pose lists (`graph.txt`) that come with LiDAR scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.text_numbers import parse_numbers
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.untrusted_files import FileTuning, read_untrusted


def read_pose_graph(path: str | Path) -> dict[str, np.ndarray]:
    """Poses T_world_sensor float64 [4, 4] by name, of lines `name x y z qx qy qz qw`, in the file's order.

    Raises:
        FormatError: the file is missing, empty, or a line has something else.
    """
    path = Path(path)
    lines = read_untrusted(path, FileTuning.max_text_bytes).splitlines()
    poses = {}
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        if len(words) != 8:
            raise FormatError(f"{path}: line {number}: expected a name and 7 numbers, found {len(words)} words")
        x = parse_numbers(words[1:], f"line {number}", path)
        if not np.isfinite(x).all() or abs(np.linalg.norm(x[3:]) - 1) > 0.01:
            raise FormatError(f"{path}: line {number}: {x[3:].tolist()} is no unit quaternion with a finite position")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = quaternion_to_matrix(x[[6, 3, 4, 5]]), x[:3]
        poses[words[0].decode(errors="replace")] = T
    if not poses:
        raise FormatError(f"{path}: no poses")
    return poses
