# SPDX-License-Identifier: Apache-2.0
"""The table of what modes leave out: what it says is what runs do, and runs say it."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import ggslam, succeed

from ggslam.errors import ConfigError
from ggslam.slam.config import Config, load_config
from ggslam.slam.filter_chain import filter_classes
from ggslam.slam.filters.camera_fixtures import CameraFixtures
from ggslam.slam.filters.frame_filter import InRigs
from ggslam.slam.modes import CAPABILITIES, Lack, Mode, modes_of, notes, refuse, table

REFUSED = {
    (Mode.RIG, "realtime_fps"): "realtime_fps=10", (Mode.RIG, "memory_limit_mb"): "memory_limit_mb=4000",
    (Mode.RIG, "device"): "device=cuda", (Mode.RIG, "tracker"): "tracker=edges_planes",
    (Mode.GPU, "memory_limit_mb"): "memory_limit_mb=4000", (Mode.PAGED, "device"): "device=cuda",
    (Mode.GPU, "identity.schedule"): "identity.schedule=colors",
}  # fmt: skip
"""What each mode refuses, by the setting that asks for it."""


def lack(name: str, mode: Mode) -> Lack | None:
    (found,) = [one for one in CAPABILITIES if one.name == name]
    return found.lacks.get(mode)


def test_what_is_refused_names_its_setting() -> None:
    listed = {(mode, one.setting) for one in CAPABILITIES for mode in one.lacks if one.lacks[mode] is Lack.REFUSED}
    assert {pair for pair in listed if pair[1]} == set(REFUSED)
    for (mode, setting), override in REFUSED.items():
        refuse(mode, Config())
        with pytest.raises(ConfigError, match=f"^{setting}: "):
            refuse(mode, load_config(None, [override]))


def test_a_rig_leaves_out_the_filters_that_the_table_says() -> None:
    left_out = [kind for kind in filter_classes() if kind.in_rigs is InRigs.LEFT_OUT]
    assert left_out == [CameraFixtures]
    assert lack("masking what is fixed to the camera", Mode.RIG) is Lack.LEFT_OUT


def test_only_what_the_settings_ask_for_is_noted() -> None:
    asked, not_asked = Config(), load_config(None, ["movers.enabled=false"])
    assert modes_of(asked, True, False) == [Mode.RIG]
    (with_movers,), (without,) = notes([Mode.RIG], asked), notes([Mode.RIG], not_asked)
    assert with_movers.startswith("a rig of cameras")
    assert "moving things" in with_movers and "moving things" not in without
    assert not notes([], asked)


def test_every_capability_is_a_row() -> None:
    heading, *rows = table()
    assert len(heading) == 1 + len(Mode) and [row[0] for row in rows] == [one.name for one in CAPABILITIES]
    assert sum(cell != "yes" for row in rows for cell in row[1:]) == sum(len(one.lacks) for one in CAPABILITIES)
    printed = succeed("doctor", "--modes")
    assert all(mode.value in printed for mode in Mode)


def test_a_run_says_once_and_first_what_it_leaves_out(tmp_path: Path) -> None:
    succeed("synth", tmp_path / "room", "--frames", 4, "--width", 64, "--height", 48)
    done = ggslam("run", tmp_path / "room", "--out", tmp_path / "run", "--set", "realtime_fps=200", "--refine", 0)
    said = " ".join((done.stdout + done.stderr).split())
    assert done.returncode == 0 and said.count("real time postpones to the end") == 1
    assert said.index("real time postpones to the end") < said.index("keyframe")
