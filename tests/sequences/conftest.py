# SPDX-License-Identifier: Apache-2.0
"""Recordings of every format, made for one test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_recordings import MAKERS


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., Path]:
    """make(format): a fresh recording of that format."""

    def build(name: str) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        return MAKERS[name](folder)

    return build
