# SPDX-License-Identifier: Apache-2.0
"""Memory that is full is the machine's fault, in one line, wherever it is noticed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from command_line import ggslam

from ggslam.cli import main
from ggslam.errors import CoreMemoryError, MemoryFullError


def take_memory_of_numpy() -> None:
    np.empty(1 << 60, np.uint8)


def take_memory_of_torch() -> None:
    torch.empty(1 << 60, dtype=torch.uint8)


def raise_our_own() -> None:
    raise MemoryFullError("map.ply: memory is full: no room for its 9 bytes")


def raise_that_of_the_core() -> None:
    raise CoreMemoryError("memory is full in the core")


def raise_bare() -> None:
    raise MemoryError


@pytest.mark.parametrize(
    "fail", [take_memory_of_numpy, take_memory_of_torch, raise_our_own, raise_that_of_the_core, raise_bare]
)
def test_full_memory_is_told_in_a_line(fail: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(main, "app", fail)
    done = ggslam("inspect")
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 1 and len(lines) == 1, done
    assert lines[0].startswith("error: ") and "memory is full" in lines[0]
