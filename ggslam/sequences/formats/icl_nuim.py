# SPDX-License-Identifier: Apache-2.0
"""ICL-NUIM in the PNGs that follow TUM RGB-D: associations.txt, rgb/, depth/, *.gt.freiburg.

Its images were rendered with a left-handed camera (x right, y up, z forward), which is why its calibration has a
negative fy. Both camera and world are mirrored here (y -> -y): fy is positive, poses are proper, and a scene comes out
as it looks. Trajectories are thus those of the file with y mirrored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.pose_files import data_lines, read_pose_rows
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    missing_depth_problems,
    nominal_timestamps,
)

CAMERA = Camera(640, 480, 481.20, 480.0, 319.5, 239.5)
DEPTH_SCALE: Final = 5000.0
"""Units per metre of ICL-NUIM's depth images."""
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


class IclNuimFormat:
    """Frames are listed as `number depth number colour`; the rows of the ground truth carry the same numbers."""

    name = "icl-nuim"
    layout = "associations.txt (lines 'number depth/0.png number rgb/0.png')[, *.gt.freiburg]"

    def matches(self, folder: Path) -> bool:
        # Other recordings may carry an associations.txt of their own beside the lists that TUM has.
        return (folder / "associations.txt").is_file() and not (folder / "rgb.txt").is_file()

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        numbers, files = _frames(folder)
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), DEPTH_SCALE, CAMERA,
            problems=missing_depth_problems(files),
        )  # fmt: skip
        truth = sorted(folder.glob("*.gt.freiburg"))
        if truth:
            options.add_truth(recording, lambda: _add_poses(recording, truth, numbers))
        return recording


def _frames(folder: Path) -> tuple[list[int], list[FrameFiles]]:
    path = folder / "associations.txt"
    numbers, files = [], []
    for line_number, line in data_lines(path):
        words = line.split()
        try:
            _, first, number, second = float(words[0]), words[1], round(float(words[2])), words[3]
        except (ValueError, IndexError, OverflowError):
            raise SequenceError(
                f"{path}, line {line_number}: expected 'number depth/0.png number rgb/0.png', found '{line[:60]}'"
            ) from None
        color, depth = (first, second) if "rgb" in first else (second, first)
        numbers.append(number)
        files.append(FrameFiles(folder / color, folder / depth))
    if not files:
        raise SequenceError(f"{path}: lists no images")
    return numbers, files


def _add_poses(recording: Recording, paths: list[Path], numbers: list[int]) -> None:
    if len(paths) > 1:
        names = ", ".join(path.name for path in paths)
        raise SequenceError(f"{recording.path}: expected one *.gt.freiburg, found {names}")
    rows = read_pose_rows(paths[0], (8,))
    assert rows.stamps is not None
    told = np.isfinite(rows.stamps)
    mirrored = MIRROR @ rows.poses[told] @ MIRROR
    by_number = dict(zip(rows.stamps[told].round().astype(int).tolist(), mirrored, strict=True))
    unknown = np.full((4, 4), np.nan)
    poses = np.array([by_number.get(number, unknown) for number in numbers])
    recording.take_poses(poses, f"{paths[0].name} (y mirrored)", rows.problems)
