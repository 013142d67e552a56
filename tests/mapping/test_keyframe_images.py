# SPDX-License-Identifier: Apache-2.0
"""What a keyframe keeps of a frame's images."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.identity import ids_of
from ggslam.mapping.keyframe import DEPTH_UNIT, make_keyframe
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame

HEIGHT, WIDTH = 30, 40
CAMERA = Camera(WIDTH, HEIGHT, 40.0, 40.0, 19.5, 14.5)


@pytest.mark.parametrize("far_share", [0.0, 0.01, 0.5])
def test_depth_is_rounded_to_units_and_none_beyond_their_range(far_share: float) -> None:
    rng, most = np.random.default_rng(1), 65535 * DEPTH_UNIT
    depth = rng.uniform(0, most, (HEIGHT, WIDTH)).astype(np.float32)
    depth[0, :2] = 0, np.float32(most)
    depth.reshape(-1)[-round(far_share * depth.size) or depth.size :] = 1.5 * most
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    keyframe = make_keyframe(0, Frame(0, 0, 0.0, color, depth, CAMERA), np.eye(4))
    assert keyframe.depth_unit == DEPTH_UNIT * (2 if far_share == 0.5 else 1)
    units = depth.astype(np.float64) / keyframe.depth_unit
    expected = np.where(depth <= 65535 * keyframe.depth_unit, units, 0)
    assert keyframe.depth.dtype == np.uint16
    assert np.abs(keyframe.depth - expected).max() < 0.51
    assert (keyframe.depth == 0).sum() == 1 + (round(far_share * depth.size) if far_share == 0.01 else 0)


@pytest.mark.parametrize("most", [1, 2, 5, 65536])
def test_ids_of_a_mask_are_each_there_once(most: int) -> None:
    rng = np.random.default_rng(most)
    for mask in (rng.integers(0, most, (HEIGHT, WIDTH)), np.full((HEIGHT, WIDTH), most - 1)):
        mask = mask.astype(np.uint16)
        mask[-1, -1] = most - 1
        found = ids_of(mask)
        assert found.dtype == np.uint16 and np.array_equal(found, np.unique(mask))
    assert len(ids_of(np.zeros((0, 4), np.uint16))) == 0
