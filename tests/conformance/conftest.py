# SPDX-License-Identifier: Apache-2.0
"""Programs of others that read what ggslam writes."""

from __future__ import annotations

import os
import shlex
import shutil

import pytest


@pytest.fixture(scope="session")
def splat_transform() -> list[str]:
    """PlayCanvas' program (npm install -g @playcanvas/splat-transform)."""
    return command_of("splat-transform", "GGSLAM_SPLAT_TRANSFORM")


@pytest.fixture(scope="session")
def usd_convert_gsplat() -> list[str]:
    """NVIDIA's program (pip install usd-convert-gsplat usd-core)."""
    return command_of("usd-convert-gsplat", "GGSLAM_USD_CONVERT_GSPLAT")


def command_of(program: str, variable: str) -> list[str]:
    """What a variable of the environment says, or a program on the PATH; skips the test where there is neither."""
    command = os.environ.get(variable) or shutil.which(program)
    if not command:
        pytest.skip(f"{program} is not there ({variable}, or on the PATH)")
    return shlex.split(command)
