# SPDX-License-Identifier: Apache-2.0
"""ScanNet as exported from .sens files: color/0.jpg, depth/0.png, pose/0.txt, intrinsic/intrinsic_color.txt."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.masks import find_masks
from ggslam.sequences.pose_files import poses_of_frames, read_intrinsics, read_matrix
from ggslam.sequences.recording import (
    NO_OPTIONS,
    Calibration,
    FrameFiles,
    ReadOptions,
    Recording,
    image_files,
    missing_depth_problems,
    nominal_timestamps,
)


class ScanNetFormat:
    """Depth in millimetres; poses map camera to world and are -inf where tracking was lost; the colour image is brought
    onto the depth image's pixels by the two intrinsics."""

    name = "scannet"
    layout = "color/0.jpg, depth/0.png, pose/0.txt, intrinsic/intrinsic_color.txt, here or in frames/[; instance-filt/]"

    def matches(self, folder: Path) -> bool:
        return _root(folder) is not None

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        root = _root(folder)
        if root is None:
            raise SequenceError(f"{folder}: expected {self.layout}")
        colors = image_files(root / "color")
        if not colors:
            raise SequenceError(f"{root / 'color'}: no images")
        masks = self._masks(folder, root, colors)
        files = [FrameFiles(c, root / "depth" / f"{c.stem}.png", m) for c, m in zip(colors, masks, strict=True)]
        calibration = options.recorded_camera(partial(read_intrinsics, root / "intrinsic" / "intrinsic_color.txt"))
        depth_calibration, warnings = self._depth_calibration(root, calibration is None)
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), 1000.0, calibration=calibration,
            depth_calibration=depth_calibration, problems=missing_depth_problems(files), warnings=warnings,
        )  # fmt: skip
        options.add_truth(recording, lambda: _add_poses(recording, root / "pose", colors))
        return recording

    def _masks(self, folder: Path, root: Path, colors: list[Path]) -> list[Path | None]:
        for name in ("instance-filt", "instance"):  # the first is the cleaner one
            for place in (root / name, folder / name):
                if place.is_dir():
                    return find_masks(place, colors)
        return [None] * len(colors)

    def _depth_calibration(self, root: Path, own: bool) -> tuple[Calibration | None, list[str]]:
        """Of depth, and a warning where only colour has one; `own`: a user tells that of colour."""
        depth = root / "intrinsic" / "intrinsic_depth.txt"
        if depth.is_file():
            return read_intrinsics(depth), []
        return None, [] if own else [f"{depth} is missing: the depth image is taken to be the same view as colour"]


def _add_poses(recording: Recording, folder: Path, colors: list[Path]) -> None:
    paths = [folder / f"{color.stem}.txt" for color in colors]

    def pose_of(i: int) -> np.ndarray | None:
        T = read_matrix(paths[i]) if paths[i].is_file() else None
        return None if T is None or np.isinf(T).any() else T  # -inf: where tracking was lost

    poses, problems = poses_of_frames(len(paths), pose_of, paths.__getitem__)
    if problems or np.isfinite(poses).any():
        recording.take_poses(poses, "pose/*.txt", problems)


def _root(folder: Path) -> Path | None:
    """The folder that holds color/ and depth/: the given one or frames/ in it."""
    for root in (folder, folder / "frames"):
        if (root / "color").is_dir() and (root / "depth").is_dir():
            return root
    return None
