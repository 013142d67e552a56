# SPDX-License-Identifier: Apache-2.0
"""Blind and stopping distances."""

from __future__ import annotations

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
