# SPDX-License-Identifier: Apache-2.0
"""Golden streams and small clouds for the codec."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def gpcc_data() -> Path:
    """Folder of golden G-PCC streams: `GGSLAM_GPCC`, else `../shared/gpcc` beside the checkout. Skips if absent."""
    folder = Path(os.environ.get("GGSLAM_GPCC", Path(__file__).parents[3] / "shared" / "gpcc"))
    if not (folder / "golden").is_dir():
        pytest.skip(f"no golden G-PCC streams at {folder} (set GGSLAM_GPCC)")
    return folder


@pytest.fixture(scope="session")
def surface() -> tuple[np.ndarray, np.ndarray]:
    """A bumpy coloured sheet on a grid of 8 bits: points int32 [N, 3] without duplicates, colours uint8 [N, 3]."""
    x, y = np.meshgrid(np.arange(150), np.arange(100), indexing="ij")
    z = np.round(20 + 8 * np.sin(x / 17) + 6 * np.cos(y / 11)).astype(np.int64)
    points = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.int32)
    colors = np.stack([100 + 80 * np.sin(x / 9), 120 + 70 * np.cos(y / 13), 90 + z], -1).reshape(-1, 3)
    order = np.random.default_rng(0).permutation(len(points))
    return points[order], colors.astype(np.uint8)[order]
