# SPDX-License-Identifier: Apache-2.0
"""Estimates the rotation of the camera between two frames from the shift of the whole image.

Small images hide motion blur, and their phases tell large shifts (`cv2.phaseCorrelate`, which has its sources): where
a turn is too fast for features and for constant velocity this is right to a few degrees. A shift that the camera's
translation made is taken for a turn, too.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class ImageTurnTuning(Tuning):
    """Estimate of the camera's rotation from the shift of the image."""

    width = 80
    """Width, in pixels, of the reduced images."""
    min_response = 0.3
    """Smallest peak of the correlation, in [0, 1]. Below it, images have too little in common."""


def small_image(color: np.ndarray) -> np.ndarray:
    """Grey values float32 [h, `ImageTurnTuning.width`] of colour uint8 [H, W, 3]."""
    height = max(2, round(color.shape[0] * ImageTurnTuning.width / color.shape[1]))
    return cv2.cvtColor(
        cv2.resize(color, (ImageTurnTuning.width, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY
    ).astype(np.float32)


def image_turn(before: np.ndarray, now: np.ndarray, camera: Camera) -> np.ndarray:
    """T_before_now [4, 4], a turn, from two small images; the identity if they have too little in common.

    Args:
        before, now: see `small_image`.
        camera: of the images that they were made of.
    """
    window = cv2.createHanningWindow((now.shape[1], now.shape[0]), cv2.CV_32F)
    (columns, rows), response = cv2.phaseCorrelate(before, now, window)
    T = np.eye(4)
    if response >= ImageTurnTuning.min_response:
        larger = camera.width / now.shape[1]
        yaw, pitch = np.arctan(columns * larger / camera.fx), np.arctan(rows * larger / camera.fy)
        T[:3, :3] = Rotation.from_euler("yx", [yaw, -pitch]).as_matrix().T
    return T
