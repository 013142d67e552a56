# SPDX-License-Identifier: Apache-2.0
"""Recordings in which something covers the lens while the camera goes to where it sees other surfaces."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

COVERED = 8
"""Frames, black and without depth."""
BEGINNING = 10
"""Frames before them."""


def way(begin: int, after: Iterable[int]) -> list[int]:
    """Frames of a walk around the room: so many from its first, `COVERED` on the way to the next, and these."""
    after = list(after)
    covered = np.linspace(begin, after[0], COVERED).round().astype(int).tolist()
    return [*range(begin), *covered, *after]


def write_lost_camera(out: Path, walk: Path, frames: list[int], covered: Iterable[int]) -> Path:
    """Writes a recording of frames of another one, some of them covered, at 30 frames a second.

    Args:
        out: of the recording.
        walk: the other one, in the plain folder layout.
        frames: which of its frames follow one another.
        covered: which of the new frames show nothing.
    """
    header, *lines = (walk / "poses.txt").read_text(encoding="utf-8").splitlines()
    poses = [f"{k / 30:.6f} {lines[i].split(maxsplit=1)[1]}" for k, i in enumerate(frames)]
    for kind in ("rgb", "depth", "masks"):
        (out / kind).mkdir(parents=True)
        for k, i in enumerate(frames):
            shutil.copy(walk / kind / f"{i:06d}.png", out / kind / f"{k:06d}.png")
    for k in covered:
        for kind in ("rgb", "depth", "masks"):
            path = out / kind / f"{k:06d}.png"
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.zeros_like(image))
    (out / "poses.txt").write_text("\n".join([header, *poses]) + "\n", encoding="utf-8")
    shutil.copy(walk / "camera.yaml", out)
    return out
