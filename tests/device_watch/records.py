# SPDX-License-Identifier: Apache-2.0
"""What a `DeviceWatch` records, and where it happened."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import torch

import ggslam

PACKAGE = f"{Path(ggslam.__file__).parent}/"
OTHERS = (f"{Path(__file__).parent}/", f"{Path(torch.__file__).parent}/")


class DeviceMixing(RuntimeError):
    """Host and device memory in one operation."""


class UnorderedWork(RuntimeError):
    """Two streams use the same memory, and nothing says which is first."""


@dataclass(frozen=True)
class Record:
    """Something that happened.

    Attributes:
        operation: name.
        where: innermost line of ggslam, else of the test: "file:line function".
        bytes: of a copy.
        blocking: whether the host waits.
        stream: that it was started on; 0: the one of all threads.
    """

    operation: str
    where: str
    bytes: int = 0
    blocking: bool = True
    stream: int = 0


def here() -> str:
    """The innermost line of ggslam, else the innermost that is neither torch's nor of this tool."""
    frame, fallback = sys._getframe(1), "?"
    while frame is not None:
        path, text = frame.f_code.co_filename, f"{frame.f_lineno} {frame.f_code.co_name}"
        if path.startswith(PACKAGE):
            return f"{path.removeprefix(PACKAGE)}:{text}"
        if fallback == "?" and not path.startswith(OTHERS):
            fallback = f"{Path(path).name}:{text}"
        frame = frame.f_back  # type: ignore[assignment]
    return fallback
