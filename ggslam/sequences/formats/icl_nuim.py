# SPDX-License-Identifier: Apache-2.0
"""ICL-NUIM in the PNGs that follow TUM RGB-D: associations.txt, rgb/, depth/, *.gt.freiburg.

Its images were rendered with a left-handed camera (x right, y up, z forward), which is why its calibration has a
negative fy. Both camera and world are mirrored here (y -> -y): fy is positive, poses are proper, and a scene comes out
as it looks. Trajectories are thus those of the file with y mirrored.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.pose_files import data_lines, read_tum_poses
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    missing_depth_problems,
    nominal_timestamps,
)

CAMERA = Camera(640, 480, 481.20, 480.0, 319.5, 239.5)
DEPTH_SCALE = 5000.0
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
        if len(truth) > 1:
            names = ", ".join(path.name for path in truth)
            raise SequenceError(f"{folder}: expected one *.gt.freiburg, found {names}")
        if truth:
            _add_poses(recording, truth[0], numbers)
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


def _add_poses(recording: Recording, path: Path, numbers: list[int]) -> None:
    rows, poses, problems = read_tum_poses(path)
    if problems:
        raise SequenceError(next(iter(problems.values())))
    by_number = dict(zip(rows.round().astype(int).tolist(), MIRROR @ poses @ MIRROR, strict=True))
    unknown = np.full((4, 4), np.nan)
    recording.poses = np.array([by_number.get(number, unknown) for number in numbers])
    recording.pose_source = f"{path.name} (y mirrored)"
    without = int(np.isnan(recording.poses[:, 0, 0]).sum())
    if without == len(numbers):
        raise SequenceError(f"{path}: no row has the number of a frame in associations.txt")
    if without:
        recording.warnings.append(f"{without} of {len(numbers)} frames have no true pose in {path.name}")
