# SPDX-License-Identifier: Apache-2.0
"""Tables that spreadsheets show and do not compute."""

from __future__ import annotations

import csv
import io
import math

import pytest

from ggslam.system.csv_text import csv_text


@pytest.mark.parametrize(
    "name",
    ["=2+5", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\t=1", "\r=1", '  =HYPERLINK("x")', "＝2+5", "=2\n+5", "-inf-x"],
)
def test_a_formula_becomes_text(name: str) -> None:
    (head, row) = csv.reader(io.StringIO(csv_text(["name", "score"], [[name, 1.5]]), newline=""))
    assert head == ["name", "score"] and row == ["'" + name.replace("\r", "\n"), "1.5"]


@pytest.mark.parametrize("name", ["kitchen", "", "a=b", "-1.5", "+1e-3", "-inf", "a, \"b\"\nc", "'=1", "a\n=2"])
def test_other_texts_stay(name: str) -> None:
    assert list(csv.reader(io.StringIO(csv_text(["n"], [[name, 0]]), newline="")))[1] == [name, "0"]


def test_numbers_keep_all_digits() -> None:
    row = csv_text(["a"], [[-1 / 3, None, math.inf, -7, True]]).splitlines()[1].split(",")
    assert float(row[0]) == -1 / 3 and row[1:] == ["", "inf", "-7", "True"]


def test_a_heading_is_a_cell() -> None:
    assert csv_text(["=1"], []) == "'=1\n"
