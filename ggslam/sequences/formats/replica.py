# SPDX-License-Identifier: Apache-2.0
"""Replica as rendered for NICE-SLAM: results/frame*.jpg, results/depth*.png, traj.txt, cam_params.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.json_files import camera_of, number_of, read_object
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
)

DEFAULT_CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEFAULT_DEPTH_SCALE: Final = 6553.5
"""Units per metre of the depth images of Replica recordings without `cam_params.json`."""


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
        camera, depth_scale, names = self._parameters(folder, options)
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), depth_scale, camera,
            instance_names=names, problems=missing_depth_problems(files),
        )  # fmt: skip
        told = any((place / "cam_params.json").is_file() for place in (folder, folder.parent))
        recording.camera_source = "cam_params.json" if told else "Replica's published camera"
        options.add_truth(recording, lambda: add_row_poses(recording, folder / "traj.txt"))
        return recording

    def _files(self, folder: Path, color: Path) -> FrameFiles:
        digits = color.stem.removeprefix("frame")
        mask = folder / "semantic_instance" / f"semantic_instance_{last_number(color.stem)}.png"
        return FrameFiles(color, folder / "results" / f"depth{digits}.png", mask if mask.is_file() else None)

    def _parameters(self, folder: Path, options: ReadOptions) -> tuple[Camera | None, float, dict[int, str]]:
        path = next((p for p in (folder / "cam_params.json", folder.parent / "cam_params.json") if p.is_file()), None)
        if path is None:
            return DEFAULT_CAMERA, DEFAULT_DEPTH_SCALE, {}
        content = read_object(path)
        values = content.get("camera")
        entries: dict[str, Any] = values if isinstance(values, dict) else {}
        place = f"{path}, camera"
        keys = ("w", "h", "fx", "fy", "cx", "cy")
        camera = options.recorded_camera(lambda: camera_of(place, *(number_of(place, entries, key) for key in keys)))
        scale = options.recorded_scale(lambda: number_of(place, entries, "scale"))
        try:
            names = {int(key): str(value) for key, value in content.get("instances", {}).items()}
        except (TypeError, ValueError, AttributeError) as error:
            raise SequenceError(f"{path}: expected 'instances' to map ids to names; problem: {error!r}") from None
        return camera, scale, names
