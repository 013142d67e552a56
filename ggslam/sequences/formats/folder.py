# SPDX-License-Identifier: Apache-2.0
"""A plain folder: rgb/, depth/, camera.yaml, and if known poses.txt, timestamps.txt, masks/."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.calibration import (
    camera_or_calibration,
    depth_camera_entry,
    distortion_entry,
    number_entry,
    read_calibration,
)
from ggslam.sequences.camera_files.finding import CAMERA_FILE, find_camera_file
from ggslam.sequences.image_folders import OF_NAMES, ImagePairs, depth_images, pair_folders
from ggslam.sequences.masks import find_masks
from ggslam.sequences.pose_files import (
    PoseRows,
    data_lines,
    read_pose_rows,
    take_rows,
    take_rows_by_number,
    take_rows_by_time,
)
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    RecordingTuning,
    image_numbers,
    missing_depth_problems,
    nominal_timestamps,
)
from ggslam.sequences.stamps import are_counted, unit_of_stamps
from ggslam.system.clock_units import UNITS

GENERATOR_KEY = "generator"
"""Entry of camera.yaml that marks a recording as written by `ggslam.synthetic`."""


class FolderFormat:
    """The simplest layout for one's own data.

    camera.yaml holds width, height, fx, fy, cx, cy, depth_scale and optionally distortion [k1, k2, p1, p2, k3, ...],
    distortion_model (opencv or fisheye), frame_rate, instances {id: name}, and depth_camera (width, height, fx, fy, cx,
    cy, T_color_depth, distortion) where the depth images are to be registered to the colour images. A
    depth image belongs to the colour image of the same name or number.
    poses.txt holds TUM lines or 4x4 matrices as rows.
    """

    name = "folder"
    layout = "rgb/, depth/, camera.yaml (width height fx fy cx cy depth_scale)[; poses.txt, timestamps.txt, masks/]"

    def matches(self, folder: Path) -> bool:
        return (folder / "camera.yaml").is_file()

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        path = folder / CAMERA_FILE
        path = path if path.exists() or options.own_camera is not None else find_camera_file(folder) or path
        read = partial(read_calibration, path)
        settings = read() if path.exists() else options.recorded_camera(read) or {}
        pairs = pair_folders(folder, folder / "rgb", folder / "depth")
        masks: list[Path | None] = [None] * len(pairs.colors)
        if (folder / "masks").is_dir():
            masks = find_masks(folder / "masks", pairs.colors)
        files = [FrameFiles(*entry) for entry in zip(pairs.colors, pairs.depths, masks, strict=True)]
        camera, calibration = options.recorded_camera(partial(camera_or_calibration, path, settings)) or (None, None)
        distortion, fisheye = options.recorded_camera(lambda: distortion_entry(path, settings)) or (None, False)
        depth_camera = None
        if "depth_camera" in settings:
            depth_camera = options.recorded_depth_camera(lambda: depth_camera_entry(path, settings["depth_camera"]))
        timestamps, time_source = _timestamps(folder, pairs, path, settings)
        recording = Recording(
            self.name, folder, files, timestamps, options.recorded_scale(lambda: _depth_scale(path, settings)), camera,
            calibration, distortion=distortion, fisheye=fisheye, depth_camera=depth_camera, time_source=time_source,
            depth_delays=pairs.delays, problems=missing_depth_problems(files), warnings=pairs.warnings,
            instance_names=_instances(path, settings),
            camera_source=path.name,
        )  # fmt: skip
        _hint_at_numbering(recording, pairs.colors)
        if (folder / "poses.txt").is_file():
            options.add_truth(recording, lambda: _add_poses(recording, folder / "poses.txt"))
        return recording

    def lacks_camera_only(self, folder: Path) -> bool:
        """Whether all but camera.yaml is there, which a user may give instead."""
        return all((folder / name).is_dir() for name in ("rgb", "depth"))


class SyntheticFormat(FolderFormat):
    """A plain folder written by `ggslam synth`: camera.yaml says so."""

    name = "synthetic"
    layout = f"as 'folder', with '{GENERATOR_KEY}:' in camera.yaml"

    def matches(self, folder: Path) -> bool:
        try:
            return super().matches(folder) and GENERATOR_KEY in read_calibration(folder / "camera.yaml")
        except SequenceError:
            return False  # the plain folder's reader will tell what is wrong


def _instances(path: Path, settings: dict[str, Any]) -> dict[int, str]:
    instances = settings.get("instances") or {}
    try:
        return {int(key): str(value) for key, value in instances.items()}
    except (AttributeError, TypeError, ValueError):
        raise SequenceError(f"{path}: expected 'instances' to map ids to names, found '{instances}'") from None


def _depth_scale(path: Path, settings: dict[str, Any]) -> float:
    if not settings and not path.exists():
        raise SequenceError(f"{path.parent}: holds no {path.name}; the units of its depth images per metre are unknown")
    return number_entry(path, settings, "depth_scale")


def _timestamps(
    folder: Path, pairs: ImagePairs, camera_file: Path, settings: dict[str, Any]
) -> tuple[np.ndarray, str]:
    path, colors = folder / "timestamps.txt", pairs.colors
    if path.is_file() and pairs.delays is None:  # else names are times, and some images are left out
        times = np.array([_time_in(path, number, line) for number, line in data_lines(path)])
        if len(times) != len(colors):
            raise SequenceError(f"{path}: expected {len(colors)} times, one an image, found {len(times)}")
        return times, path.name
    if pairs.times is not None:
        return pairs.times, OF_NAMES
    rate = number_entry(camera_file, settings, "frame_rate") if "frame_rate" in settings else RecordingTuning.rate_hz
    if rate <= 0:
        raise SequenceError(f"{camera_file}: expected a positive 'frame_rate', found {rate:g}")
    source = f"{rate:g} frames/s of {camera_file.name}" if "frame_rate" in settings else f"nominal {rate:g} frames/s"
    return _numbered_times(folder, colors) / rate, source


def _time_in(path: Path, number: int, line: str) -> float:
    word = line.split()[0]
    try:
        time = float(word)
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise SequenceError(f"{path}, line {number}: expected a time in seconds, found '{word[:40]}'")
    return time


def _numbered_times(folder: Path, colors: list[Path]) -> np.ndarray:
    """Times in frames, float64 [n]: 0, 1, 2, ...; where numbers are left out of the images' names, with their gaps."""
    numbers = image_numbers(colors)
    steps = np.ones(0) if numbers is None else np.diff(numbers)
    if numbers is None or not len(steps) or (steps == steps[0]).all():
        return nominal_timestamps(len(colors), 1.0)
    depths = image_numbers(depth_images(folder / "depth"))
    first = numbers[0] if depths is None else min(numbers[0], depths[0])
    return (numbers - first) / np.median(steps)


def _hint_at_numbering(recording: Recording, colors: list[Path]) -> None:
    """Says of a missing depth image that depth may be numbered from another start, if there are as many."""
    depths = depth_images(recording.path / "depth")
    first, other = image_numbers(colors), image_numbers(depths)
    if not recording.problems or first is None or other is None or len(first) != len(other):
        return
    step = int(other[0] - first[0])
    if step == 0 or (other - first != step).any():
        return
    at = min(recording.problems)
    recording.problems[at] += (
        f"; depth images are numbered {other[0]} to {other[-1]}, colour images {first[0]} to {first[-1]}: if the first "
        f"belong together, `depth_delay` {-step}f pairs them"
    )


def _add_poses(recording: Recording, path: Path) -> None:
    """Poses of lines without times in the order of the frames; of lines with as many as there are frames, too; else
    paired by time, or by the numbers of the images where the first number of a line counts frames."""
    rows = read_pose_rows(path)
    count, nominal = len(recording.files), recording.time_source.startswith("nominal")
    if rows.ids is not None:
        take_rows_by_number(recording, rows, rows.ids)
    elif rows.stamps is None:
        take_rows(recording, rows)
    elif len(rows.poses) == count:
        _take_in_order(recording, rows, rows.stamps)
    elif are_counted(rows.stamps):
        take_rows_by_number(recording, rows, rows.stamps)
    elif nominal:
        raise SequenceError(
            f"{path}: expected {count} poses, one a frame, found {len(rows.poses)} (and the images have no times to "
            "pair them by)"
        )
    else:
        take_rows_by_time(recording, rows)


def _take_in_order(recording: Recording, rows: PoseRows, stamps: np.ndarray) -> None:
    """One pose a frame; where the images tell no time, the file's is theirs."""
    if recording.time_source.startswith("nominal"):
        if np.isfinite(stamps).all() and not are_counted(stamps):
            unit = unit_of_stamps(stamps, None)
            recording.timestamps, recording.time_source = stamps * UNITS[unit], rows.path.name
            if unit != "s":
                recording.time_source += f", read as {unit}"
    elif (np.diff(stamps) < 0).any():
        recording.warnings.append(
            f"{rows.path}: times do not increase; the poses are taken in the order of the lines"
        )
    take_rows(recording, rows)
