# SPDX-License-Identifier: Apache-2.0
"""What of a memory limit a map gets, as the program's own need is found out."""

from __future__ import annotations

import pytest

import ggslam.slam.memory_budget
from ggslam.errors import ConfigError
from ggslam.slam.memory_budget import MB, MemoryBudget


class Process:
    """Stands for the process: resident memory now and at most, MB."""

    now, peak = 100, 100


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Process:
    found = Process()
    monkeypatch.setattr(ggslam.slam.memory_budget, "resident_bytes", lambda: found.now * MB)
    monkeypatch.setattr(ggslam.slam.memory_budget, "peak_memory_bytes", lambda: found.peak * MB)
    for name in ("release_early", "trim"):
        monkeypatch.setattr(ggslam.slam.memory_budget, name, lambda: None)
    return found


def test_what_is_left_goes_to_the_map(process: Process) -> None:
    budget = MemoryBudget(300 * MB)
    assert budget.map_bytes is None
    process.now, process.peak = 210, 220
    budget.measure(20 * MB)
    assert budget.program_bytes == 200 * MB and budget.map_bytes == 100 * MB


def test_what_passed_between_two_looks_counts_once(process: Process) -> None:
    budget = MemoryBudget(300 * MB)
    process.now = process.peak = 210
    budget.measure(10 * MB)
    assert not budget.check(10 * MB)
    process.now, process.peak = 290, 310  # 20 MB that are gone again by now
    assert budget.check(90 * MB) and budget.map_bytes == 80 * MB
    process.now = 220
    assert not budget.check(10 * MB) and budget.map_bytes == 80 * MB, "the old peak says nothing of this step"


def test_a_given_budget_stays(process: Process) -> None:
    budget = MemoryBudget(300 * MB, 50 * MB)
    process.now = process.peak = 400
    assert not budget.check(10 * MB) and budget.map_bytes == 50 * MB


def test_no_room_is_told(process: Process) -> None:
    budget = MemoryBudget(120 * MB)
    process.now = process.peak = 150
    budget.measure(10 * MB)
    assert budget.map_bytes == 8 * MB and "memory_limit_mb=120 cannot be kept" in budget.notes[0]
    with pytest.raises(ConfigError, match=r"memory_limit_mb.*\b150 MB"):
        MemoryBudget(120 * MB)
