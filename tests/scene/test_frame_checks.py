# SPDX-License-Identifier: Apache-2.0
"""What is said of frames that are not what they should be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.frame_checks import check_frame, wrong_unit

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
METRES = np.linspace(0, 12, 1200, dtype=np.float32).reshape(30, 40)
FRAME = Frame(3, 3, 0.0, np.zeros((30, 40, 3), np.uint8), METRES, CAMERA)


def test_metres_pass() -> None:
    check_frame(FRAME, CAMERA)
    assert not wrong_unit(np.zeros((30, 40), np.float32))


def test_millimetres_are_recognised() -> None:
    with pytest.raises(SequenceError, match=r"frame 3: .*median \d+\D.*\b1000\b"):
        check_frame(replace(FRAME, depth=1000 * METRES), CAMERA)


def test_centimetres_are_not_called_millimetres_alone() -> None:
    with pytest.raises(SequenceError, match=r"frame 3: .*\b1000\b.*\b100\b"):
        check_frame(replace(FRAME, depth=100 * METRES), CAMERA)


def test_frames_are_checked_at_birth() -> None:
    color = np.zeros((30, 40, 3), np.uint8)
    for images, problem in (
        ((color[:20], METRES), "frame 5: colour is 40x20, expected 40x30"),
        ((color.astype(np.float32), METRES), "frame 5: colour is float32"),
        ((color, METRES.astype(np.uint16)), "frame 5: depth is uint16"), ((color, [[1.0]]), "frame 5: depth is list"),
    ):  # fmt: skip
        with pytest.raises(SequenceError, match=problem):
            Frame(0, 5, 0.0, *images, CAMERA)  # type: ignore[arg-type]
    with pytest.raises(SequenceError, match=r"frame 5: camera is dict, expected a ggslam\.Camera"):
        Frame(0, 5, 0.0, color, METRES, {"fx": 30})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [({"depth": METRES[:-1]}, "depth.*40x29.*40x30"),
     ({"depth": METRES.astype(np.float64)}, "depth.*float64"),
     ({"depth": METRES - 1}, "frame 3: .*depth.*NaN"), ({"depth": METRES + np.inf}, "frame 3: .*depth.*NaN"),
     ({"color": np.zeros((30, 40, 4), np.uint8)}, r"colour.*uint8"),
     ({"depth": (1000 * METRES).astype(np.uint16)}, "depth.*uint16"),
     ({"depth": None}, "depth.*NoneType"),
     ({"camera": Camera(40, 30, 60.0, 60.0, 19.5, 14.5)}, "frame 3: .*fx=60.0.*fx=30.0"),
     ({"camera": Camera(80, 60, 30.0, 30.0, 19.5, 14.5)}, "frame 3: colour is 40x30, expected 80x60"),
     ({"timestamp": float("nan")}, "time.*nan"),
     ({"T_world_camera": np.eye(4)[:3]}, r"T_world_camera.*\[3, 4\].*4x4"),
     ({"T_world_camera": np.full((4, 4), np.nan)}, "T_world_camera.*finite")],
)  # fmt: skip
def test_wrong_images(change: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        check_frame(replace(FRAME, **change), CAMERA)
