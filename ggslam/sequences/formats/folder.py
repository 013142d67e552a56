# SPDX-License-Identifier: Apache-2.0
"""A plain folder: rgb/, depth/, camera.yaml, and if known poses.txt, timestamps.txt, masks/."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.association import poses_at
from ggslam.sequences.calibration import (
    camera_entry,
    depth_camera_entry,
    distortion_entry,
    number_entry,
    read_calibration,
)
from ggslam.sequences.masks import find_masks
from ggslam.sequences.pose_files import data_lines, read_matrix_rows, read_tum_poses
from ggslam.sequences.recording import (
    NO_OPTIONS,
    NOMINAL_RATE,
    FrameFiles,
    ReadOptions,
    Recording,
    image_files,
    image_numbers,
    last_number,
    missing_depth_problems,
    nominal_timestamps,
)

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
        path = folder / "camera.yaml"
        read = partial(read_calibration, path)
        settings = read() if path.exists() else options.recorded_camera(read) or {}
        colors = image_files(folder / "rgb")
        if not colors:
            raise SequenceError(f"{folder / 'rgb'}: no images")
        masks: list[Path | None] = [None] * len(colors)
        if (folder / "masks").is_dir():
            masks = find_masks(folder / "masks", colors)
        files = [FrameFiles(*pair) for pair in zip(colors, _depth_files(folder, colors), masks, strict=True)]
        camera = options.recorded_camera(lambda: camera_entry(path, settings))
        distortion, fisheye = options.recorded_camera(lambda: distortion_entry(path, settings)) or (None, False)
        depth_camera = None
        if "depth_camera" in settings:
            depth_camera = options.recorded_depth_camera(lambda: depth_camera_entry(path, settings["depth_camera"]))
        timestamps, time_source = _timestamps(folder, colors, settings)
        left_out = _without_color(folder, files)
        recording = Recording(
            self.name, folder, files, timestamps,
            options.recorded_scale(lambda: number_entry(path, settings, "depth_scale")), camera, distortion=distortion,
            fisheye=fisheye, depth_camera=depth_camera, time_source=time_source, problems=missing_depth_problems(files),
            instance_names=_instances(path, settings), warnings=left_out,
        )  # fmt: skip
        if (folder / "poses.txt").is_file():
            _add_poses(recording, folder / "poses.txt")
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


def _depth_files(folder: Path, colors: list[Path]) -> list[Path]:
    """The depth image of each colour image: of the same name, else of the same number; a missing one gets a name."""
    candidates = image_files(folder / "depth", (".png",))
    if not candidates:
        raise SequenceError(f"{folder / 'depth'}: no PNG images")
    by_name = {path.stem: path for path in candidates}
    by_number = {last_number(path.stem): path for path in candidates}
    by_number.pop(None, None)
    if any(color.stem in by_name for color in colors):
        return [by_name.get(c.stem, folder / "depth" / f"{c.stem}.png") for c in colors]
    found = [by_number.get(last_number(color.stem)) for color in colors]
    if not any(found):
        raise SequenceError(
            f"{folder}: colour and depth images have neither names nor numbers in common ({colors[0].name}, "
            f"{candidates[0].name})"
        )
    return [path or folder / "depth" / f"{color.stem}.png" for path, color in zip(found, colors, strict=True)]


def _timestamps(folder: Path, colors: list[Path], settings: dict[str, Any]) -> tuple[np.ndarray, str]:
    path = folder / "timestamps.txt"
    if path.is_file():
        try:
            times = np.array([float(line.split()[0]) for _, line in data_lines(path)])
        except ValueError:
            raise SequenceError(f"{path}: expected one time in seconds on each line") from None
        if len(times) != len(colors):
            raise SequenceError(f"{path}: expected {len(colors)} times, one an image, found {len(times)}")
        return times, path.name
    try:
        if all("." in color.stem for color in colors):
            return np.array([float(color.stem) for color in colors]), "names of the images"
    except ValueError:
        pass
    rate = number_entry(folder / "camera.yaml", settings, "frame_rate") if "frame_rate" in settings else NOMINAL_RATE
    if rate <= 0:
        raise SequenceError(f"{folder / 'camera.yaml'}: expected a positive 'frame_rate', found {rate:g}")
    source = f"{rate:g} frames/s of camera.yaml" if "frame_rate" in settings else f"nominal {rate:g} frames/s"
    return _numbered_times(folder, colors) / rate, source


def _numbered_times(folder: Path, colors: list[Path]) -> np.ndarray:
    """Times in frames, float64 [n]: 0, 1, 2, ...; where numbers are left out of the images' names, with their gaps."""
    numbers = image_numbers(colors)
    steps = np.ones(0) if numbers is None else np.diff(numbers)
    if numbers is None or not len(steps) or (steps == steps[0]).all():
        return nominal_timestamps(len(colors), 1.0)
    depths = image_numbers(image_files(folder / "depth", (".png",)))
    first = numbers[0] if depths is None else min(numbers[0], depths[0])
    return (numbers - first) / np.median(steps)


def _without_color(folder: Path, files: list[FrameFiles]) -> list[str]:
    """A warning if there are depth images whose colour image is missing."""
    used = {entry.depth for entry in files}
    unused = [path.name for path in image_files(folder / "depth", (".png",)) if path not in used]
    if not unused:
        return []
    return [f"{folder / 'depth'}: {len(unused)} images have no colour image and are left out; the first: {unused[0]}"]


def _add_poses(recording: Recording, path: Path) -> None:
    """Poses in the order of the frames when there are as many; a TUM trajectory of another length is paired by time."""
    lines = data_lines(path)
    count = len(recording.files)
    if lines and len(lines[0][1].replace(",", " ").split()) == 8:
        times, poses, problems = read_tum_poses(path)
        if len(poses) != count:
            if recording.time_source.startswith("nominal"):
                raise SequenceError(
                    f"{path}: expected {count} poses, one a frame, found {len(poses)} (and the images "
                    "tell no time to pair them by)"
                )
            if problems:
                raise SequenceError(next(iter(problems.values())))
            poses = poses_at(recording.timestamps, times, poses)
        elif recording.time_source.startswith("nominal"):
            recording.timestamps, recording.time_source = times, path.name
        elif (np.diff(times) < 0).any():
            recording.warnings.append(f"{path}: times do not increase; the poses are taken in the order of the lines")
    else:
        poses, problems = read_matrix_rows(path)
        if len(poses) != count:
            raise SequenceError(f"{path}: expected {count} poses, one a frame, found {len(poses)}")
    recording.take_poses(poses, path.name, problems)
