# SPDX-License-Identifier: Apache-2.0
"""What is told of a process's memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ggslam.system.process_memory as room
from ggslam.system.process_memory import peak_memory_bytes, peak_memory_mb, resident_bytes


def test_the_peak_is_that_of_this_process_not_of_the_one_that_started_it() -> None:
    large = np.ones(40_000_000)
    assert peak_memory_mb() > 320 and resident_bytes() > large.nbytes
    code = "from ggslam.system.process_memory import peak_memory_mb; print(peak_memory_mb())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert float(said) < 200


def test_where_the_system_does_not_tell_the_peak_stands_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(room, "_OWN_MEMORY", bytes(tmp_path / "nothing"))
    assert resident_bytes() == peak_memory_bytes()
    (tmp_path / "text").write_text("no number")
    monkeypatch.setattr(room, "_OWN_MEMORY", bytes(tmp_path / "text"))
    assert resident_bytes() == peak_memory_bytes()
