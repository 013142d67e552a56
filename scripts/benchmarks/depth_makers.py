# SPDX-License-Identifier: Apache-2.0
"""Recordings whose depth errs as that of phones does, made from exact ones: smooth to the eye, and wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

DepthMaker = Callable[[np.ndarray], np.ndarray]
"""Depth in metres, float32 [H, W], 0 where unknown, of one frame after the other -> what the camera says instead."""

SMALL = (160, 120)
"""Columns and rows of a depth camera whose images are made larger."""
FIELD = (8, 6)
"""Columns and rows of the knots of an error that changes slowly across the image."""
CORRELATION_FRAMES, SHARE = 8.0, 0.01
"""Frames after which an error has changed by a factor e, and its standard deviation as a share of the depth."""


def smoothed() -> DepthMaker:
    """Depth as of a small camera: means over pixels, smoothed over their neighbours, and made large again. Edges become
    slopes; nothing looks noisy."""

    def make(depth: np.ndarray) -> np.ndarray:
        small = cv2.resize(depth, SMALL, interpolation=cv2.INTER_AREA)
        seen = cv2.resize((depth > 0).astype(np.float32), SMALL, interpolation=cv2.INTER_AREA)
        small, seen = (cv2.GaussianBlur(image, (0, 0), 1.0) for image in (small, seen))
        filled = np.where(seen > 0.5, small / np.maximum(seen, 1e-3), 0).astype(np.float32)
        size = depth.shape[1], depth.shape[0]
        large = cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR)
        whole = cv2.resize((filled > 0).astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.999
        return np.where(whole, large, 0).astype(np.float32)

    return make


def drifting(seed: int = 0) -> DepthMaker:
    """Depth times an error that changes slowly across the image and from frame to frame: neighbours in space and time
    err together, so that no single image shows it."""
    random = np.random.default_rng(seed)
    keep = float(np.exp(-1 / CORRELATION_FRAMES))
    knots = random.standard_normal(FIELD[::-1])

    def make(depth: np.ndarray) -> np.ndarray:
        nonlocal knots
        field = cv2.resize(knots, (depth.shape[1], depth.shape[0]), interpolation=cv2.INTER_CUBIC)
        knots = keep * knots + (1 - keep * keep) ** 0.5 * random.standard_normal(FIELD[::-1])
        return (depth * (1 + SHARE * field)).astype(np.float32)

    return make


MAKERS: dict[str, Callable[[], DepthMaker]] = {"smoothed": smoothed, "drifting": drifting}
"""By the name that a recording gets after a plus sign, as in `livingroom+smoothed`."""


def write_with_depth(source: Path, folder: Path, make: DepthMaker) -> None:
    """A copy of a recording in Replica's layout (depth in millimetres) with other depth; all other files are links."""
    (folder / "results").mkdir(parents=True)
    for path in (*sorted(source.iterdir()), *sorted((source / "results").iterdir())):
        target = folder / path.relative_to(source)
        if path.name.startswith("depth"):
            depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
            cv2.imwrite(str(target), np.rint(1000 * make(depth)).clip(0, 65535).astype(np.uint16))
        elif path.name != "results":
            target.symlink_to(path.resolve())
