# SPDX-License-Identifier: Apache-2.0
"""A depth image prepared for segmentation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DepthSurface:
    """What a depth image shows; arrays are contiguous.

    Attributes:
        valid: bool [H, W], pixels with depth, small holes bridged.
        depth: float32 [H, W], metres, smoothed within surfaces; where not valid: the bridged or an arbitrary value.
        inverse: float32 [H, W], 1 / depth.
        points: float32 [H, W, 3], points in the camera frame.
        normals: float32 [H, W, 3], unit normals towards the camera.
        sigma: float, standard deviation of the noise of inverse depth, 1/m.
        step: pixels over which the normals were taken.
    """

    valid: np.ndarray
    depth: np.ndarray
    inverse: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    sigma: float
    step: int
