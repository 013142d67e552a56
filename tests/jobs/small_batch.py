# SPDX-License-Identifier: Apache-2.0
"""A manifest with a small recording and one that is missing."""

from __future__ import annotations

from pathlib import Path

from ggslam.synthetic import write_synthetic_sequence


def write_small_batch(folder: Path, recordings: str, frames: int = 6) -> Path:
    """Writes the recording `first` and a manifest of `recordings` (a YAML list) into a folder; gives the manifest."""
    write_synthetic_sequence(folder / "first", frames=frames, width=64, height=48, seed=0)
    path = folder / "batch.yaml"
    options = "options: --iterations 1 --set mapping.first_frame_iterations=2"
    path.write_text(f"{options}\nrecordings: {recordings}\nout: table\n")
    return path
