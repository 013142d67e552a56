# SPDX-License-Identifier: Apache-2.0
"""Versions and machine that a run was made with."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

from ggslam import __version__
from ggslam.native.loader import NativeContext

_PACKAGES = ("torch", "numpy", "scipy", "opencv-python-headless", "gtsam", "kornia")


def environment(threads: int | None = None) -> dict[str, Any]:
    """Versions, processor, threads and instruction set of the kernels, as text and numbers.

    Args:
        threads: that the run was given; None or 0: all processors.
    """
    context = NativeContext(threads or None)
    return {
        "ggslam": __version__, "python": platform.python_version(),
        **{name: version for name in _PACKAGES if (version := _version(name)) is not None},
        "system": f"{platform.system()} {platform.release()} {platform.machine()}", "processor": processor(),
        "processors": os.cpu_count(), "threads": context.threads, "instruction_set": context.instruction_set,
    }  # fmt: skip


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
