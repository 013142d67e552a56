# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt and the images they list."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.association import pair_images
from ggslam.sequences.calibration import (
    camera_or_calibration,
    distortion_entry,
    number_entry,
    read_calibration,
)
from ggslam.sequences.camera_files.finding import find_camera_file
from ggslam.sequences.pose_files import data_lines, read_pose_rows, take_rows_by_time
from ggslam.sequences.recording import (
    NO_OPTIONS,
    Calibration,
    FrameFiles,
    ReadOptions,
    Recording,
    missing_depth_problems,
)

DEPTH_SCALE: Final = 5000.0
"""Units per metre of TUM's depth images."""

CALIBRATIONS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), None),
}
"""Published calibration of the three cameras: (fx, fy, cx, cy) and (k1, k2, p1, p2, k3)."""
SIZE: Final = (640, 480)
"""(width, height) of the images that TUM's calibrations are for."""
DEFAULT_CALIBRATION: Final = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy in pixels that TUM recommends for recordings without a calibration of their own."""
CAMERA_IN_NAME = re.compile(r"(?:freiburg|fr)([123])")


class TumFormat:
    """Colour and depth are paired by time; ground truth is interpolated at the time of the colour image."""

    name = "tum"
    layout = "rgb.txt and depth.txt (lines 'time file'), groundtruth.txt optional; freiburg1|2|3 in the folder's name"

    def matches(self, folder: Path) -> bool:
        return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        color_times, color_files = read_image_list(folder / "rgb.txt")
        depth_times, depth_files = read_image_list(folder / "depth.txt")
        pairs, warnings = pair_images(folder, color_times, depth_times, ("rgb.txt", "depth.txt"))
        files = [FrameFiles(folder / color_files[i], folder / depth_files[j]) for i, j in pairs]
        times = color_times[[i for i, _ in pairs]]
        recording = Recording(
            self.name, folder, files, times, DEPTH_SCALE, calibration=DEFAULT_CALIBRATION,
            depth_delays=depth_times[[j for _, j in pairs]] - times, time_source="rgb.txt",
            problems=missing_depth_problems(files), warnings=warnings,
        )  # fmt: skip
        if options.own_camera is None:
            self._add_camera(recording, options)
        truth = folder / "groundtruth.txt"
        if truth.is_file():
            options.add_truth(recording, lambda: take_rows_by_time(recording, read_pose_rows(truth, (8, 9))))
        return recording

    def _add_camera(self, recording: Recording, options: ReadOptions) -> None:
        """The published camera that the folder's name tells; without such a name that of a file in the folder, else the
        benchmark's default."""
        folder = recording.path
        named = any(CAMERA_IN_NAME.search(name) for name in _names(folder))
        file = None if named else options.recorded_camera(lambda: find_camera_file(folder))
        if file is None:
            calibration, recording.distortion, recording.camera_source = self._calibration(folder, recording.warnings)
            recording.camera, recording.calibration = Camera(*SIZE, *calibration), None
            return
        settings = read_calibration(file)
        recording.camera, recording.calibration = camera_or_calibration(file, settings)
        recording.distortion, recording.fisheye = distortion_entry(file, settings)
        recording.camera_source = file.name
        if "depth_scale" in settings:
            recording.depth_scale = options.recorded_scale(lambda: number_entry(file, settings, "depth_scale"))

    def _calibration(self, folder: Path, warnings: list[str]) -> tuple[Calibration, np.ndarray | None, str]:
        """Published calibration of the camera that the folder's name tells, and by which name. A link's own name comes
        before that of the folder it leads to."""
        given, true = _names(folder)
        named = [(name, found[1]) for name in dict.fromkeys((given, true)) if (found := CAMERA_IN_NAME.search(name))]
        if not named:
            names = f"'{true}'" if given == true else f"'{given}', a link to '{true}',"
            warnings.append(
                f"the folder's name {names} does not say freiburg1, 2 or 3: default intrinsics "
                "525 525 319.5 239.5 of 640x480 images without distortion are used; `intrinsics` or `camera` tell "
                "others"
            )
            return DEFAULT_CALIBRATION, None, "default: the folder's name names no camera"
        name, number = named[0]
        source = f"freiburg{number}, by the name '{name}'"
        if named[-1][1] != number:
            source += f" (the folder it leads to says freiburg{named[-1][1]})"
            warnings.append(f"intrinsics are of {source}; give others with `intrinsics` or `camera`")
        calibration, distortion = CALIBRATIONS[number]
        return calibration, None if distortion is None else np.array(distortion), source


def _names(folder: Path) -> tuple[str, str]:
    """The folder's name as given, and where a link leads."""
    return folder.absolute().name, folder.resolve().name


def read_image_list(path: Path) -> tuple[np.ndarray, list[str]]:
    """Times float64 [n] and file names of a TUM image list, in order of time.

    Raises:
        SequenceError: a line is not 'time file', or there is none.
    """
    entries = []
    for number, line in data_lines(path):
        words = line.split(maxsplit=1)
        try:
            time, name = float(words[0]), words[1]
        except (ValueError, IndexError):
            raise SequenceError(f"{path}, line {number}: expected 'time file', found '{line[:60]}'") from None
        if not np.isfinite(time):
            raise SequenceError(f"{path}, line {number}: time is not finite")
        entries.append((time, name))
    if not entries:
        raise SequenceError(f"{path}: lists no images")
    entries.sort()
    return np.array([time for time, _ in entries]), [name for _, name in entries]
