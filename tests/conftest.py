# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared recordings: `GGSLAM_DATA`, else `../shared/data` beside the checkout. Skips if absent."""
    folder = Path(os.environ.get("GGSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no shared recordings at {folder} (set GGSLAM_DATA)")
    return folder


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated recording: 24 frames of a furnished room, 160x120, with depth noise, exact poses and masks."""
    from ggslam.sequences.synthetic import write_synthetic_sequence

    folder = tmp_path_factory.mktemp("recordings") / "room"
    write_synthetic_sequence(folder, frames=24, width=160, height=120, seed=0, noise=True)
    return folder
