# SPDX-License-Identifier: Apache-2.0
"""What tells a focal length, and what must not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.sequences import open_sequence
from ggslam.sequences.focal_doubts import doubt_focal_length, pairs_matched
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


def test_factors_are_found_to_a_few_per_cent(room: Path, tmp_path: Path) -> None:
    sequence = open_sequence(room)
    pairs = pairs_matched(sequence, [sequence.frame(k, masks=False) for k in (0, 5, 10, 15, 20)])
    assert len(pairs) >= 4
    for factor in (1.0, 1.3, 2.0, 0.5):
        camera = replace(sequence.camera, fx=factor * sequence.camera.fx, fy=factor * sequence.camera.fy)
        doubt = doubt_focal_length([(replace(a, camera=camera), replace(b, camera=camera)) for a, b in pairs])
        assert doubt is not None and doubt.wrong == (factor != 1)
        assert factor == 1 or abs(np.log(factor * doubt.likely)) < 0.08


def test_a_big_thing_that_moves_is_no_focal_length() -> None:
    """A board over half of the image comes nearer and turns while the camera does something else."""
    first, second = frames()
    texture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8), (0, 0), 1.5)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    shown = []
    for frame, depth, grow, left in ((first, 1.2, 1.0, 0), (second, 1.0, 1.2, 60)):
        board = cv2.warpAffine(texture, np.array([[grow, 0, -left], [0, grow, -20.0]]), (320, 240))
        color, z = frame.color.copy(), frame.depth.copy()
        color[:, 140:], z[:, 140:] = board[:, 140:], np.float32(depth)
        shown.append(replace(frame, color=color, depth=z))
    doubt = doubt_focal_length([(shown[0], shown[1])])
    assert doubt is not None and not doubt.wrong
