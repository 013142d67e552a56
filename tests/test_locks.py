# SPDX-License-Identifier: Apache-2.0
"""What is installed by scripts/install.sh is locked, whole, and tied to no index."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOCKS = sorted((ROOT / "requirements").glob("*.lock"))
pytestmark = pytest.mark.skipif(not LOCKS, reason="not in a checkout")


def lines(lock: str) -> list[str]:
    text = (ROOT / "requirements" / f"{lock}.lock").read_text()
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_every_line_names_a_version_and_a_sum() -> None:
    assert [path.stem for path in LOCKS] == ["build", "demo", "tests", "torch-cpu"]
    for path in LOCKS:
        assert "://" not in path.read_text()
        for line in lines(path.stem):
            assert re.fullmatch(r"[a-z0-9.-]+==[\w.!]+ --hash=sha256:[0-9a-f]{64}", line), line


def test_the_locks_have_what_the_project_names() -> None:
    script = ROOT / "scripts" / "tools" / "make_locks.py"
    done = subprocess.run([sys.executable, script, "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_demo_installs_nothing_that_is_not_tested() -> None:
    assert set(lines("demo")) <= set(lines("tests"))
    assert not {"torch", "jax"} & {line.split("==")[0] for line in lines("tests")}
