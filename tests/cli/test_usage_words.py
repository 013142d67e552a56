# SPDX-License-Identifier: Apache-2.0
"""Mistakes on the command line get one sentence: no frames, none of the libraries' own words."""

from __future__ import annotations

import pytest
from command_line import ggslam

CASES = {
    "runn x": "there is no command 'runn'; did you mean run?; see `ggslam --help`",
    "--verison": "there is no option --verison; did you mean --version?; see `ggslam --help`",
    "run x --strid 3": "there is no option --strid; did you mean --stride?; see `ggslam run --help`",
    "run x --stride a": "--stride: expected a whole number, 1 or more, found 'a'; see `ggslam run --help`",
    "run x --stride=0": "--stride: expected a whole number, 1 or more, found '0'; see `ggslam run --help`",
    "run x --port 70000": "--port: expected a whole number, 0 to 65535, found '70000'; see `ggslam run --help`",
    "run x --scale abc": "--scale: expected a number, found 'abc'; see `ggslam run --help`",
    "run x --stride": "--stride needs a value; see `ggslam run --help`",
    "run a b": "more arguments than the command takes: b; see `ggslam run --help`",
    "encode a": "OUT is missing; see `ggslam encode --help`",
    "batch x --engine cloud": "--engine: expected one of local, ray, slurm, found 'cloud'; see `ggslam batch --help`",
}


@pytest.mark.parametrize("words", CASES)
def test_mistakes_get_one_sentence(words: str) -> None:
    done = ggslam(*words.split())
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"error: {CASES[words]}\n")


def test_a_command_alone_shows_its_help() -> None:
    done = ggslam("view")
    assert "ggslam view runs/kitchen" in done.stdout and "error" not in done.stderr
