# SPDX-License-Identifier: Apache-2.0
"""7-Scenes and recordings laid out like it: frame-000000.color.png, .depth.png, .pose.txt, .segm.png."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.calibration import depth_camera_entry, read_calibration
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

DEPTH_CALIBRATION: Final = (585.0, 585.0, 320.0, 240.0)
"""fx, fy, cx, cy of the depth camera in pixels, as published with 7-Scenes."""
COLOR_CALIBRATION: Final = (525.0, 525.0, 320.0, 240.0)
"""fx, fy, cx, cy of the colour camera in pixels, for depth that was registered to it (`.depth.proj.png`)."""

UNREGISTERED = "; intrinsics 585 585 320 240 of the depth camera are used"


class SevenScenesFormat:
    """Depth in millimetres, 65535 invalid. Poses map camera to world."""

    name = "7scenes"
    layout = "frame-000000.color.png, .depth.png, .pose.txt[, .segm.png] here or in seq-01[; camera-intrinsics*.txt]"

    def matches(self, folder: Path) -> bool:
        return any(folder.glob("frame-*.color.*")) or any(folder.glob("seq-*/frame-*.color.*"))

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        frames = self._frames_folder(folder)
        colors = [p for p in image_files(frames) if p.stem.startswith("frame-") and p.stem.endswith(".color")]
        bases = [frames / color.stem.removesuffix(".color") for color in colors]
        raw = options.depth_camera is not None  # its calibration is for the images as recorded
        registered = bool(bases) and not raw and all(Path(f"{base}.depth.proj.png").is_file() for base in bases)
        suffix = ".depth.proj.png" if registered else ".depth.png"
        files = [self._files(color, base, suffix) for color, base in zip(colors, bases, strict=True)]
        told = options.recorded_camera(lambda: self._calibration(folder, frames, registered, options.depth_camera))
        (calibration, source), warnings = told or (DEPTH_CALIBRATION, ""), list[str]()
        if not (registered or raw) and (options.own_camera is not None or source.startswith("published")):
            warnings.append(
                "plain 7-Scenes depth is not registered to the colour image (two cameras, several centimetres apart): "
                f"colours are off by some pixels{UNREGISTERED if options.own_camera is None else ''} "
                "(`depth_camera` registers it)"
            )
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), 1000.0, calibration=calibration,
            problems=missing_depth_problems(files), warnings=warnings, camera_source=source,
        )  # fmt: skip
        options.add_truth(recording, lambda: _add_poses(recording, bases))
        return recording

    def _frames_folder(self, folder: Path) -> Path:
        if any(folder.glob("frame-*.color.*")):
            return folder
        parts = sorted({p.parent for p in folder.glob("seq-*/frame-*.color.*")})
        if len(parts) != 1:
            names = ", ".join(p.name for p in parts) or "none"
            raise SequenceError(f"{folder}: expected one recording, found several ({names}); open one of these folders")
        return parts[0]

    def _files(self, color: Path, base: Path, suffix: str) -> FrameFiles:
        mask = Path(f"{base}.segm.png")
        return FrameFiles(color, Path(f"{base}{suffix}"), mask if mask.is_file() else None)

    def _calibration(
        self, folder: Path, frames: Path, registered: bool, depth_camera: Path | None
    ) -> tuple[Calibration, str]:
        """Intrinsics of the colour images, and what tells them; of the depth images, where nothing brings them to
        colour."""
        places = [p for where in dict.fromkeys((frames, folder)) for p in sorted(where.glob("camera-intrinsics*.txt"))]
        if depth_camera is not None:  # a file may be of the depth camera alone then
            places = [p for p in places if "depth" not in p.name and not _is_of(p, depth_camera)]
        if places:
            place = next((p for p in places if "color" in p.name), places[0])
            return read_intrinsics(place), place.name
        if registered or depth_camera is not None:
            return COLOR_CALIBRATION, "published, of colour"
        return DEPTH_CALIBRATION, "published, of depth"


def _add_poses(recording: Recording, bases: list[Path]) -> None:
    paths = [Path(f"{base}.pose.txt") for base in bases]
    if any(path.is_file() for path in paths):
        poses, problems = poses_of_frames(
            len(paths), lambda i: read_matrix(paths[i]) if paths[i].is_file() else None, paths.__getitem__
        )
        recording.take_poses(poses, "frame-*.pose.txt", problems)


def _is_of(place: Path, depth_camera: Path) -> bool:
    """Whether intrinsics are those of a depth camera, and so not of colour."""
    camera = depth_camera_entry(depth_camera, read_calibration(depth_camera)).camera
    same = np.allclose(read_intrinsics(place)[:2], (camera.fx, camera.fy), rtol=5e-3)
    return "color" not in place.name and bool(same)
