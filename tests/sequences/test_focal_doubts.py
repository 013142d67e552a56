# SPDX-License-Identifier: Apache-2.0
"""What tells a focal length, and what must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.sequences.focal_doubts import doubt_focal_length
from ggslam.synthetic import RayCaster, furnished_room

CAMERA = Camera(320, 240, 240.0, 240.0, 159.5, 119.5)


def frames() -> list[Frame]:
    """Two views of a room, half a metre and 17 degrees apart."""
    caster, T = RayCaster(furnished_room(0), 0), np.eye(4)
    T[:3, 3] = (2.0, 1.8, 1.4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    views = [caster.render(CAMERA, pose) for pose in (T, T @ se3_exp(np.array([0.5, 0, 0, 0, -0.3, 0])))]
    return [Frame(i, i, 0.0, view.color, view.depth, CAMERA) for i, view in enumerate(views)]


def test_a_wrong_focal_length_is_told_and_a_right_one_is_not() -> None:
    first, second = frames()
    right = doubt_focal_length([(first, second)])
    assert right is not None and not right.wrong and right.error < 0.01
    longer = replace(CAMERA, fx=1.8 * CAMERA.fx, fy=1.8 * CAMERA.fy)
    wrong = doubt_focal_length([(replace(first, camera=longer), replace(second, camera=longer))])
    assert wrong is not None and wrong.wrong and abs(np.log(wrong.factor * 1.8)) < 0.15


def test_colour_that_got_stuck_tells_nothing() -> None:
    first, second = frames()
    assert doubt_focal_length([(first, replace(second, color=first.color))]) is None
