# SPDX-License-Identifier: Apache-2.0
"""Disks that are really full or read-only, and folders that vanish, as fault_table.py lets them happen."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts" / "tools"


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What became of the faults of disks and folders, by name. A process of its own, which forks for each command."""
    out = tmp_path_factory.mktemp("faults") / "rows.json"
    done = subprocess.run(
        [sys.executable, SCRIPTS / "fault_table.py", "--only", "disk,mid-run", "--json", out],
        capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert out.exists(), done.stdout + done.stderr
    found = {row["fault"]: row for row in json.loads(out.read_text())}
    if not any("disk" in name for name in found):
        pytest.skip("no small disk (tmpfs) can be mounted here")
    return found


pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root"),
    pytest.mark.slow,  # ten runs and exports in processes of their own
]


def test_no_fault_of_a_disk_loses_anything(rows: dict[str, dict[str, Any]]) -> None:
    assert len(rows) >= 9
    assert {name: row["problems"] for name, row in rows.items() if row["problems"]} == {}


def test_a_run_goes_where_there_is_room_and_says_so(rows: dict[str, dict[str, Any]]) -> None:
    for name, row in rows.items():
        if "mid-run" in name and "output folder is deleted" in name:
            assert "run of 14 frames" in row["kept"], row
        elif "run is saved" in name or "output folder" in name:
            assert row["code"] == 1 and "saved to ./fallback/" in row["said"], row
            assert "run of 14 frames in the fallback folder" in row["kept"] and ".staged-" not in row["said"], row


def test_what_was_to_be_replaced_stays(rows: dict[str, dict[str, Any]]) -> None:
    commands = [row for name, row in rows.items() if name.startswith("the disk is full: ")]
    for row in commands:
        assert row["code"] != 0 and "No space left on device" in row["said"] and "left behind" not in row["said"], row
        assert "existing files are untouched" in row["kept"], row
    assert sum("the file that was to be replaced" in row["kept"] for row in commands) == 4
