# SPDX-License-Identifier: Apache-2.0
"""Replica as rendered for NICE-SLAM: results/frame*.jpg, results/depth*.png, traj.txt, cam_params.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.pose_files import add_row_poses
from ggslam.sequences.recording import (
    NO_OPTIONS,
    FrameFiles,
    ReadOptions,
    Recording,
    image_files,
    last_number,
    missing_depth_problems,
    nominal_timestamps,
    read_text,
)

DEFAULT_CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEFAULT_DEPTH_SCALE = 6553.5


class ReplicaFormat:
    """Reads Replica and everything laid out like it. Depth belongs to colour by its number."""

    name = "replica"
    layout = "results/frame000000.jpg|png, results/depth000000.png, traj.txt, cam_params.json here or one folder up"

    def matches(self, folder: Path) -> bool:
        return any((folder / "results").glob("frame*.*"))

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        colors = [p for p in image_files(folder / "results") if p.stem.startswith("frame")]
        if not colors:
            raise SequenceError(f"{folder / 'results'}: no frame*.jpg or frame*.png")
        files = [self._files(folder, color) for color in colors]
        camera, depth_scale, names = self._parameters(folder)
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), depth_scale, camera,
            instance_names=names, problems=missing_depth_problems(files),
        )  # fmt: skip
        add_row_poses(recording, folder / "traj.txt")
        return recording

    def _files(self, folder: Path, color: Path) -> FrameFiles:
        digits = color.stem.removeprefix("frame")
        mask = folder / "semantic_instance" / f"semantic_instance_{last_number(color.stem)}.png"
        return FrameFiles(color, folder / "results" / f"depth{digits}.png", mask if mask.is_file() else None)

    def _parameters(self, folder: Path) -> tuple[Camera, float, dict[int, str]]:
        path = next((p for p in (folder / "cam_params.json", folder.parent / "cam_params.json") if p.is_file()), None)
        if path is None:
            return DEFAULT_CAMERA, DEFAULT_DEPTH_SCALE, {}
        try:
            content: dict[str, Any] = json.loads(read_text(path))
            c = content["camera"]
            camera = Camera(int(c["w"]), int(c["h"]), float(c["fx"]), float(c["fy"]), float(c["cx"]), float(c["cy"]))
            names = {int(key): str(value) for key, value in content.get("instances", {}).items()}
            depth_scale = float(c["scale"])
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            raise SequenceError(
                f'{path}: expected {{"camera": {{w, h, fx, fy, cx, cy, scale}}}} with numbers; problem: {error!r}'
            ) from None
        return camera, depth_scale, names
