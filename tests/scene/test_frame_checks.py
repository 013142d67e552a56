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
    with pytest.raises(SequenceError, match=r"frame 3: depth looks like millimetres \(median \d+\).*divide it by 1000"):
        check_frame(replace(FRAME, depth=1000 * METRES), CAMERA)


def test_centimetres_are_not_called_millimetres_alone() -> None:
    with pytest.raises(SequenceError, match="millimetres or centimetres .*millimetres by 1000, centimetres by 100"):
        check_frame(replace(FRAME, depth=100 * METRES), CAMERA)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"depth": METRES[:-1]}, "depth is 40x29, expected 40x30"),
     ({"depth": METRES.astype(np.float64)}, "depth is float64"),
     ({"depth": METRES - 1}, "negative, infinite or NaN"), ({"depth": METRES + np.inf}, "negative, infinite or NaN"),
     ({"color": np.zeros((30, 40, 4), np.uint8)}, "colour is uint8"),
     ({"depth": (1000 * METRES).astype(np.uint16)}, "depth is uint16"),
     ({"depth": None}, "depth is NoneType, expected a numpy array"),
     ({"camera": Camera(40, 30, 60.0, 60.0, 19.5, 14.5)}, "frame 3: it is of .*fx=60.0.*expected .*fx=30.0"),
     ({"camera": Camera(80, 60, 30.0, 30.0, 19.5, 14.5)}, "frame 3: it is of .*width=80"),
     ({"timestamp": float("nan")}, "its time is nan"),
     ({"T_world_camera": np.eye(4)[:3]}, r"T_world_camera has shape \[3, 4\], expected a finite 4x4"),
     ({"T_world_camera": np.full((4, 4), np.nan)}, "T_world_camera has numbers that are not finite")],
)  # fmt: skip
def test_wrong_images(change: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        check_frame(replace(FRAME, **change), CAMERA)
