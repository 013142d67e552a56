# SPDX-License-Identifier: Apache-2.0
"""Replica as rendered for vMAP ("Replica-V2"): rgb/rgb_0.png, depth/depth_0.png, semantic_instance/, traj_w_c.txt.

A scene holds the renderings in imap/00 (and imap/01, another walk); the folder of one of them may be given too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

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
)

CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE: Final = 1000.0
"""Units per metre of vMAP's depth images."""


class VmapFormat:
    """Poses map camera to world, OpenCV axes; depth in millimetres; the camera is the same for all scenes."""

    name = "vmap"
    layout = "imap/00/ (or here) with rgb/rgb_0.png, depth/depth_0.png, traj_w_c.txt[; semantic_instance/]"

    def matches(self, folder: Path) -> bool:
        return bool(_walks(folder))

    def read(self, folder: Path, options: ReadOptions = NO_OPTIONS) -> Recording:
        walks = _walks(folder)
        if not walks:
            raise SequenceError(f"{folder}: expected {self.layout}")
        root = walks[0]
        files = [_frame(root, color) for color in image_files(root / "rgb")]
        warnings = []
        if len(walks) > 1:
            warnings.append(f"{folder} holds {len(walks)} walks: {root.relative_to(folder)} is read; open another one")
        recording = Recording(
            self.name, folder, files, nominal_timestamps(len(files)), DEPTH_SCALE, CAMERA,
            problems=missing_depth_problems(files), warnings=warnings,
        )  # fmt: skip
        options.add_truth(recording, lambda: add_row_poses(recording, root / "traj_w_c.txt"))
        return recording


def _frame(root: Path, color: Path) -> FrameFiles:
    number = last_number(color.stem)
    mask = root / "semantic_instance" / f"semantic_instance_{number}.png"
    return FrameFiles(color, root / "depth" / f"depth_{number}.png", mask if mask.is_file() else None)


def _walks(folder: Path) -> list[Path]:
    """Folders with rgb/rgb_*: the given one, or imap/00, imap/01, ... in it."""
    return [root for root in (folder, *sorted(folder.glob("imap/*"))) if any(root.glob("rgb/rgb_*.*"))]
