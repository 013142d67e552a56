# SPDX-License-Identifier: Apache-2.0
"""A small run with objects to look at."""

from __future__ import annotations

import pytest

from ggslam.runs.folder import RunFolder


@pytest.fixture(scope="session")
def run(room_run: RunFolder) -> RunFolder:
    """Not to be changed."""
    return room_run
