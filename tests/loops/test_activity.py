# SPDX-License-Identifier: Apache-2.0
"""Keyframes are put aside when the camera has gone away, and come back only by a closure or their neighbours."""

from __future__ import annotations

import numpy as np

from ggslam.loops.activity import ActiveKeyframes, ActivitySettings

DEPTH = 2.0


def looking_out(angle: float, radius: float = 6.0) -> np.ndarray:
    """A camera on a circle that looks away from its centre."""
    T = np.eye(4)
    z = np.array([np.cos(angle), np.sin(angle), 0.0])
    T[:3, :3] = np.stack([np.cross([0, 0, 1.0], z), [0, 0, 1.0], z], 1)
    T[:3, 3] = radius * z
    return T


def walked(turns: float, count: int = 120, settings: ActivitySettings | None = None) -> ActiveKeyframes:
    keyframes = ActiveKeyframes(settings)
    for k in range(round(turns * count)):
        keyframes.add(looking_out(2 * np.pi * k / count), DEPTH)
        keyframes.update()
    return keyframes


def test_the_start_of_a_loop_is_put_aside_and_stays_so_on_return() -> None:
    keyframes = walked(1.0)
    assert 0 not in keyframes.active and len(keyframes) - 1 in keyframes.active
    returned = walked(1.05)
    assert 0 not in returned.active and returned.inactive() >= set(range(10))


def test_a_closure_brings_back_what_is_seen_and_motion_the_rest() -> None:
    keyframes = walked(1.0)
    keyframes.add(looking_out(0.0), DEPTH)
    keyframes.activate_around(0)
    assert {0, 1, 2} <= keyframes.active and 40 not in keyframes.active
    for k in range(1, 50):
        keyframes.add(looking_out(2 * np.pi * k / 120), DEPTH)
        keyframes.update()
    assert 45 in keyframes.active


def test_turning_back_needs_no_closure() -> None:
    keyframes = walked(0.9)
    newest = len(keyframes) - 1
    assert 20 not in keyframes.active
    for k in range(newest, 15, -1):
        keyframes.add(looking_out(2 * np.pi * k / 120), DEPTH)
        keyframes.update()
    assert 20 in keyframes.active


def test_a_room_stays_active_for_ever() -> None:
    keyframes = ActiveKeyframes()
    for k in range(300):
        T = np.eye(4)
        T[:3, 3] = [0.5 * np.sin(k / 10), 0.3 * np.cos(k / 7), 0]
        keyframes.add(T, DEPTH)
        assert not keyframes.update()
    assert len(keyframes.active) == 300


def test_after_a_jump_only_what_lies_there_is_active() -> None:
    keyframes = walked(1.0)
    keyframes.restart(30)
    assert 30 in keyframes.active and 119 not in keyframes.active and 60 not in keyframes.active


def test_correction_moves_them() -> None:
    keyframes = walked(1.0)
    shifted = np.stack([looking_out(2 * np.pi * k / 120) for k in range(120)])
    shifted[:, :3, 3] += 100.0
    keyframes.poses.replace(shifted)
    keyframes.add(shifted[0], DEPTH)
    keyframes.activate_around(0)
    assert 0 in keyframes.active


def test_rounds_without_end_keep_no_more_than_enough() -> None:
    keyframes = ActiveKeyframes(ActivitySettings(most=40, forget_after=1000))
    sizes, near, changes = [], [], 0
    for k in range(1200):
        keyframes.add(looking_out(2 * np.pi * k / 120), DEPTH)
        changes += keyframes.update()
        sizes.append(len(keyframes.active))
        here = [abs((other - k + 60) % 120 - 60) < 8 for other in keyframes.active]
        near.append(sum(here))
    assert max(sizes) <= 60 and changes < 1200 / 2
    assert min(near[120:]) >= 8  # what the camera sees is there, mapped now or in the rounds before
    assert not keyframes.inactive()  # all lie right: no loop is looked for among them
    keyframes.restart(600)
    assert not keyframes.spare and 0 in keyframes.inactive()


def test_spare_keyframes_are_forgotten_like_others() -> None:
    keyframes = walked(3.0, settings=ActivitySettings(most=16))
    assert len(keyframes.active) <= 18 and 40 in keyframes.inactive() and 120 in keyframes.inactive()
