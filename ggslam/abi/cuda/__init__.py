# SPDX-License-Identifier: Apache-2.0
"""Structures, enumerations and constants of the CUDA kernels, by the names in the headers of this folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ggslam.abi.core import DECLARED as CORE
from ggslam.abi.headers import Declarations

HEADERS = (
    "common", "growth", "mapping", "rendering", "sampled_identity", "seen_map", "sight", "tracked_features", "tracking",
    "training", "volumes",
)  # fmt: skip
DECLARED = Declarations(Path(__file__).parent, HEADERS, CORE.structures)
globals().update(DECLARED.names)


def __getattr__(name: str) -> Any:
    raise AttributeError(f"no header in ggslam/abi/cuda declares {name}")
