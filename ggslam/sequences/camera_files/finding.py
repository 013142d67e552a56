# SPDX-License-Identifier: Apache-2.0
"""Looking for the camera file of a recording in its folder."""

from __future__ import annotations

from pathlib import Path

from ggslam.errors import SequenceError

CAMERA_FILE = "camera.yaml"
"""Of a plain folder."""
USUAL_NAMES = (
    "camera.yml", "camera.json", "camera.txt", "camera_info.yaml", "camera_info.yml", "calibration.yaml",
    "calibration.yml", "calibration.json", "calib.yaml", "calib.yml", "calib.txt", "intrinsics.yaml", "intrinsics.json",
    "intrinsics.txt", "intrinsic.json", "intrinsic.txt", "camera_intrinsic.json", "camera_intrinsics.json",
    "camera-intrinsics.txt", "K.txt", "cameras.txt", "ost.yaml", "camchain.yaml", "cam_params.json",
)  # fmt: skip


def find_camera_file(folder: Path) -> Path | None:
    """camera.yaml, else the one file with another usual name of a camera's calibration; None without one.

    Raises:
        SequenceError: there are several; which is meant nobody can tell.
    """
    own = folder / CAMERA_FILE
    if own.exists():
        return own
    found = [folder / name for name in USUAL_NAMES if (folder / name).is_file()]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise SequenceError(f"{folder}: holds {names}; choose the colour camera's with `camera`")
    return found[0] if found else None
