# SPDX-License-Identifier: Apache-2.0
"""Segments of a keyframe that are begun ahead, in another thread."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.mapping.keyframe import make_keyframe
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.object_masks import MaskSettings, ObjectMasks

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)


def shown(index: int) -> Frame:
    """A wall with a box before it, farther to the right from frame to frame."""
    depth = np.full((60, 80), 2.0, np.float32)
    depth[20:45, 10 + index : 40 + index] = 1.5
    color = np.full((60, 80, 3), 90, np.uint8)
    return Frame(index=index, source_index=index, timestamp=float(index), color=color, depth=depth, camera=CAMERA)


def mask_of(masks: ObjectMasks, frame: Frame) -> np.ndarray | None:
    return masks.labels(frame, make_keyframe(0, frame, np.eye(4)), None).mask


def test_what_is_begun_ahead_is_what_would_be_found() -> None:
    settings = MaskSettings(source="geometry")
    ahead, plain = ObjectMasks(settings), ObjectMasks(settings)
    for index in (0, 3, 12):
        frame = shown(index)
        ahead.begin(frame)
        found, expected = mask_of(ahead, frame), mask_of(plain, shown(index))
        if index == 3:  # too soon after the first one
            assert found is None and expected is None
        else:
            assert found is not None and np.array_equal(found, expected) and len(np.unique(found)) == 2


def test_what_was_begun_of_another_frame_is_not_taken() -> None:
    masks = ObjectMasks(MaskSettings(source="geometry"))
    masks.begin(shown(30))
    expected = mask_of(ObjectMasks(MaskSettings(source="geometry")), shown(0))
    assert expected is not None and np.array_equal(mask_of(masks, shown(0)), expected)


def test_a_failure_reaches_the_one_who_asks() -> None:
    masks, frame = ObjectMasks(MaskSettings(source="geometry")), shown(0)
    broken = replace(frame, color=frame.color[:, :, :1])
    masks.begin(broken)
    with pytest.raises(Exception, match=r"(?i)channel|scn|shape"):
        mask_of(masks, broken)
