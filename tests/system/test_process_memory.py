# SPDX-License-Identifier: Apache-2.0
"""What is told of a process's memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from ggslam.system.process_memory import peak_memory_mb, resident_bytes


def test_the_peak_is_that_of_this_process_not_of_the_one_that_started_it() -> None:
    large = np.ones(40_000_000)
    assert peak_memory_mb() > 320 and resident_bytes() > large.nbytes
    code = "from ggslam.system.process_memory import peak_memory_mb; print(peak_memory_mb())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert float(said) < 200
