# SPDX-License-Identifier: Apache-2.0
"""`ggslam inspect` as people use it."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import GgslamError
from ggslam.sequences import FORMATS, open_sequence


def inspect(*arguments: object) -> str:
    done = CliRunner().invoke(app, ["inspect", *map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split())


def test_what_was_recognised(room: Path) -> None:
    printed = inspect(room)
    for text in ("room (synthetic)", "24,", "160x120", "units a metre", "colour 160x120, depth 160x120", "24 frames",
                 "depth agrees with the poses", "outlines of depth lie on edges of colour, as they should",
                 "ids"):  # fmt: skip
        assert text in printed
    assert "warning" not in printed


def test_a_wrong_depth_scale(room: Path) -> None:
    true = open_sequence(room).depth_scale
    assert f"warning: depth scale {true / 5:g} is suspicious" in inspect(room, "--depth-scale", true / 5)


def test_formats() -> None:
    printed = inspect("--formats")
    assert all(f"{known.name} {known.layout}" in printed for known in FORMATS)


def test_a_file_that_is_nothing(tmp_path: Path) -> None:
    path = tmp_path / "walk.r3d"
    path.write_bytes(b"PK no archive")
    with pytest.raises(GgslamError, match=r"walk\.r3d"):
        inspect(path)
    done = CliRunner().invoke(app, ["inspect"])
    assert done.exit_code == 2
