# SPDX-License-Identifier: Apache-2.0
"""What is said of frames that are not what they should be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.frame_checks import check_frame, in_millimetres

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
METRES = np.linspace(0, 12, 1200, dtype=np.float32).reshape(30, 40)
FRAME = Frame(3, 3, 0.0, np.zeros((30, 40, 3), np.uint8), METRES, CAMERA)


def test_metres_pass() -> None:
    check_frame(FRAME, CAMERA)
    assert not in_millimetres(np.zeros((30, 40), np.float32))


def test_millimetres_are_recognised() -> None:
    with pytest.raises(SequenceError, match=r"frame 3: depth looks like millimetres \(median \d+\).*divide it by 1000"):
        check_frame(replace(FRAME, depth=1000 * METRES), CAMERA)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"depth": METRES[:-1]}, "depth is 40x29, expected 40x30"),
     ({"depth": METRES.astype(np.float64)}, "depth is float64"),
     ({"depth": METRES - 1}, "negative, infinite or NaN"), ({"depth": METRES + np.inf}, "negative, infinite or NaN"),
     ({"color": np.zeros((30, 40, 4), np.uint8)}, "colour is uint8"),
     ({"depth": (1000 * METRES).astype(np.uint16)}, "depth is uint16")],
)  # fmt: skip
def test_wrong_images(change: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        check_frame(replace(FRAME, **change), CAMERA)
