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
    "plan x --from 1 2 --to 3 4 0": "--from: expected 3 numbers, found '1 2 --to'; see `ggslam plan --help`",
    "plan x --from 1 2 0 --to 1e8 4 0": "--to: expected three numbers of metres within 10,000 km, found 1e+08 4 0",
    "plan x --from nan 2 0 --to 3 4 0": "--from: expected three numbers of metres within 10,000 km, found nan 2 0",
    "volumes x --driving --speeds 1,-2": "--speeds: expected numbers of 0 and more like \"0.5,1,2\", found '1,-2'",
    "volumes x --budget-ms 33": "--budget-ms needs --esdf",
    "volumes x --friction 0": "--friction: expected a number, 0.01 to 2, found '0'; see `ggslam volumes --help`",
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
