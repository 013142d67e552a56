# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ggslam.loops.revisits import Revisits, RevisitSettings
from ggslam.scene.poses import se3_exp

STEP = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))


def walked(steps: int, step: np.ndarray = STEP, **settings: float) -> Revisits:
    """A camera that made so many keyframes, ten centimetres apart."""
    revisits = Revisits(RevisitSettings(**{"gap": 5, "least_way": 0.95, **settings}))
    for _ in range(steps):
        revisits.add(step)
    return revisits


def test_old_keyframes_are_candidates_once_the_camera_went_far_enough() -> None:
    assert walked(5).candidates(1.0).tolist() == []
    assert walked(11).candidates(1.0).tolist() == [0]
    assert walked(14).candidates(1.0).tolist() == [0, 1, 2, 3]
    assert walked(14).candidates(0.5).tolist() == list(range(9))  # nearer things: half the way; but the gap holds
    assert walked(14, enabled=False).candidates(0.5).tolist() == []


def test_turns_count_as_way() -> None:
    turning = walked(11, se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])))
    assert turning.candidates(1.0).tolist() == [0]


def test_what_was_compared_is_near() -> None:
    revisits = walked(15)
    revisits.tie(0, 14)
    assert revisits.candidates(1.0).tolist() == []  # all are less than a metre from one of the ends
    for _ in range(6):
        revisits.add(STEP)
    assert revisits.candidates(1.0).tolist() == [4, 5, 6, 7, 8, 9, 10]  # about the middle of the way from 0 to 14


def test_what_was_compared_in_vain_is_not_compared_again() -> None:
    revisits = walked(14)
    assert len(revisits.candidates(1.0)) > 0
    revisits.pause()
    assert revisits.candidates(1.0).tolist() == []
    revisits.add(STEP)
    assert len(revisits.candidates(1.0)) > 0
