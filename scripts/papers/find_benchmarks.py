# SPDX-License-Identifier: Apache-2.0
"""Importing this lets a script import the benchmarks' modules, and what they take from the tests."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / folder) for folder in (".", "scripts/benchmarks", "tests", "tests/volumes")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
