# SPDX-License-Identifier: Apache-2.0
"""Blind and stopping distances."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ggslam.errors import ConfigError
from ggslam.volumes.safety import GRAVITY, Braking, Latencies


def test_distances_follow_the_equation() -> None:
    braking = Braking(Latencies(sensor=0.03, map=0.02, plan=0.04, network=0.01), friction=0.6)
    assert braking.blind_distance(2.0) == pytest.approx(0.2)
    assert braking.stopping_distance(2.0) == pytest.approx(0.2 + 4 / (2 * 0.6 * GRAVITY))


def test_the_largest_speed_stops_just_in_time() -> None:
    braking = Braking(Latencies(map=0.2), friction=0.4)
    for distance in (0.5, 3.0, 10.0):
        assert braking.stopping_distance(braking.largest_speed(distance)) == pytest.approx(distance)
    slower = Braking(Latencies(map=0.4), friction=0.4)
    assert slower.largest_speed(3.0) < braking.largest_speed(3.0)


def test_impossible_values_are_refused() -> None:
    with pytest.raises(ConfigError, match="friction"):
        Braking(friction=0.0)
    with pytest.raises(ConfigError, match="map"):
        Latencies(map=float("nan"))


def test_an_obstacle_waits_for_frames_map_and_controller() -> None:
    fast = Latencies(sensor=0.02, map=0.01, plan=0.05, frame_period=0.03, frames=2, control_period=0.04)
    assert fast.wait == pytest.approx(2 * 0.03 + 0.04)
    assert fast.total == pytest.approx(0.08 + fast.wait)
    slow = replace(fast, map=0.05)  # busy with a frame from before when the first is taken that shows the obstacle
    assert slow.wait == pytest.approx(0.03 + 2 * 0.05 + 0.04)
    calm = replace(slow, map_calm=0.02)  # is done with those before
    assert calm.wait == pytest.approx(0.03 + 0.05 + 0.04)
    assert Latencies().wait == 0


def test_unbraked_load_and_margins_shorten_the_way() -> None:
    plain = Braking(Latencies(0, 0, 0))
    assert Braking(Latencies(0, 0, 0), braked_share=0.5).stopping_distance(2) == 2 * plain.stopping_distance(2)
    kept = Braking(margin=0.3)
    assert kept.stopping_distance(1.5) == pytest.approx(Braking().stopping_distance(1.5) + 0.3)
    assert kept.stopping_distance(kept.largest_speed(2.0)) == pytest.approx(2.0)
    assert kept.largest_speed(0.2) == 0
