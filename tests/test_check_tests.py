# SPDX-License-Identifier: Apache-2.0
"""What `scripts/tools/check_tests.py` breaks on purpose is still there to be broken."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts" / "tools"))
from check_tests import FAULTS, Fault, applied  # noqa: E402


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_is_one_line_of_the_code(fault: Fault) -> None:
    text = (ROOT / fault.file).read_text()
    assert applied(fault, text) != text
    assert all((ROOT / "tests" / name.split("::")[0]).is_file() for name in fault.tests)


def test_many_rooms_and_the_compiled_core_are_among_them() -> None:
    assert len({fault.file.split("/")[1] for fault in FAULTS}) >= 10
    assert sum(fault.compiled for fault in FAULTS) >= 3


def test_a_line_that_is_gone_or_stands_twice_is_refused() -> None:
    fault = Fault("x", "x.py", "a = 1", "a = 2", ())
    assert applied(fault, "a = 1\n") == "a = 2\n"
    for text in ("b = 1\n", "a = 1\na = 1\n"):
        with pytest.raises(ValueError, match="not once"):
            applied(fault, text)
