# SPDX-License-Identifier: Apache-2.0
"""Runs `ggslam` in a process of its own and tells what it used, for the benchmarks."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Usage:
    """Peak resident memory, 10^6 bytes, seconds, those of all its threads together, and what the command printed."""

    peak_mb: float
    seconds: float
    processor_seconds: float
    said: str


def usage(words: Sequence[str]) -> Usage:
    """Runs `ggslam` with these words; ends the program if that fails."""
    return usage_of([sys.executable, "-m", "ggslam", *words], ROOT)


def usage_of(command: Sequence[str], folder: Path | None = None) -> Usage:
    """Runs any program, in a folder; ends this one if that fails."""
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    said = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{' '.join(command)}\n{said}")
    took = time.perf_counter() - start
    return Usage(used.ru_maxrss * 1024 / 1e6, took, used.ru_utime + used.ru_stime, said)
