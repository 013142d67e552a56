# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import time
from typing import Any

import pytest
import yaml

from ggslam.system.plain_yaml import PlainYamlError, parse_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [("a: 1\nb: [1, 2.5, -2]\nc: x", {"a": 1, "b": [1, 2.5, -2], "c": "x"}), ("1e-3", 0.001), ("1.5E+3", 1500.0),
     (".5", 0.5), ("2.", 2.0), ("-.inf", -math.inf), ("yes", True), ("off", False), ("~", None), ("", None),
     ("'1'", "1"), ("0x10", 16), ("1_000", 1000), ("1:30", "1:30"), ("2024-01-01", "2024-01-01"), ("<<: 1", {"<<": 1}),
     ("e5", "e5"), ("1e", "1e"), ("# nothing", None)],
)  # fmt: skip
def test_values(text: str, value: Any) -> None:
    found = parse_yaml(text)
    assert found == value and type(found) is type(value)


def test_what_ggslam_writes_comes_back() -> None:
    from ggslam.slam.config import Config, config_to_dict

    values = config_to_dict(Config())
    assert parse_yaml(yaml.safe_dump(values)) == values


@pytest.mark.parametrize(
    ("text", "reason"),
    [("a: &x [1]\nb: *x", r"line 2: aliases"), ("!!python/object/apply:os.system [ls]", "os.system is not read"),
     ("!!binary aGk=", "binary is not read"), ("a: !!timestamp 2001-01-01", "timestamp"), ("!!set {a}", "set"),
     ("[" * 40, "deeper than 32"), ("{a: b: c}", "expected"), ("? [1]\n: 2", "unhashable"),
     ("a: " + "9" * 5000, "digits"), ("\x00", "not allowed"), ("x" * ((1 << 20) + 1), "at most")],
)  # fmt: skip
def test_what_is_not_plain_is_refused_in_one_line(text: str, reason: str) -> None:
    with pytest.raises(PlainYamlError, match=reason) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value)


def test_a_bomb_of_aliases_takes_no_time() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    begin = time.monotonic()
    with pytest.raises(PlainYamlError):
        parse_yaml("\n".join(lines))
    assert time.monotonic() - begin < 1
