# SPDX-License-Identifier: Apache-2.0
"""Structures, enumerations and constants of the compiled core, by the names in the headers of this folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ggslam.abi.headers import Declarations

HEADERS = ("codec", "common", "mapping", "objects", "planning", "rendering", "sight", "tracking", "volumes")
DECLARED = Declarations(Path(__file__).parent, HEADERS)
globals().update(DECLARED.names)


def __getattr__(name: str) -> Any:
    raise AttributeError(f"no header in ggslam/abi/core declares {name}")
