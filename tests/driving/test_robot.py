# SPDX-License-Identifier: Apache-2.0
"""Robots as the command line writes them."""

from __future__ import annotations

import pytest

from ggslam.driving.robot import Robot, parse_robot
from ggslam.errors import ConfigError


def test_a_robot_is_read() -> None:
    assert parse_robot("0.4,0.18") == Robot(0.4, 0.18)
    assert parse_robot("base:1.2,0.3,0.02") == Robot(1.2, 0.3, 0.02, "base")
    assert parse_robot("1.2,0.3").band == (0.05, 1.2)


@pytest.mark.parametrize(
    "text", ["", "0.4", "a,b", "0.4,0.1,0.02,3", ":0.4,0.1", "a b:0.4,0.1", "../x:0.4,0.1", "nan,0.1", "0.4,-1",
             "0.04,0.1", "0.4,0.1,0.4", "a:b:0.4,0.1", "inf,1"],
)  # fmt: skip
def test_what_is_no_robot_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"[Rr]obot"):
        parse_robot(text)
