# SPDX-License-Identifier: Apache-2.0
"""Each of the 256 shades of a map is what map_server makes of it by its published rules, thresholds included."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.jobs.plan.ros_maps import read_ros_map

LEVELS = np.arange(256, dtype=np.uint8).reshape(16, 16)
THRESHOLDS = ((0.65, 0.196), (50 / 255, 50 / 255), (1 - 205 / 255, 1 - 205 / 255), (128 / 255, 127 / 255), (1.0, 0.0))


def write(folder: Path, mode: str, negate: int, limits: tuple[float, float], alpha: int | None = None) -> Path:
    """The map of all levels; `alpha`: as a PNG with it."""
    if alpha is None:
        (folder / "m.pgm").write_bytes(b"P5\n16 16\n255\n" + LEVELS.tobytes())
    else:
        cv2.imwrite(str(folder / "m.png"), np.dstack([LEVELS] * 3 + [np.full_like(LEVELS, alpha)]))
    told = folder / "m.yaml"
    told.write_text(
        f"image: m.{'pgm' if alpha is None else 'png'}\nmode: {mode}\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\n"
        f"negate: {negate}\noccupied_thresh: {limits[0]!r}\nfree_thresh: {limits[1]!r}\n"
    )
    return told


@pytest.mark.parametrize(("mode", "negate"), list(product(("trinary", "scale"), (0, 1))))
def test_levels_are_those_of_map_server(tmp_path: Path, mode: str, negate: int) -> None:
    shade = LEVELS.astype(float) / 255
    occupied = shade if negate else 1 - shade
    for least, most in THRESHOLDS:
        found = read_ros_map(write(tmp_path, mode, negate, (least, most)))
        assert np.array_equal(found.occupied, (occupied > least)[::-1])
        assert np.array_equal(found.free, ((occupied < most) & ~(occupied > least))[::-1])


@pytest.mark.parametrize("alpha", [0, 128, 254, 255])
def test_what_is_not_opaque_is_unknown(tmp_path: Path, alpha: int) -> None:
    for limits in THRESHOLDS:
        found, opaque = (read_ros_map(write(tmp_path, "scale", 0, limits, a)) for a in (alpha, 255))
        assert np.array_equal(found.occupied, opaque.occupied & (alpha == 255))
        assert np.array_equal(found.free, opaque.free & (alpha == 255))


def test_raw_levels_above_a_hundred_are_unknown(tmp_path: Path) -> None:
    for negate in (0, 1):
        found = read_ros_map(write(tmp_path, "raw", negate, (0.65, 0.196)))
        levels = LEVELS[::-1].astype(int)
        assert np.array_equal(found.occupied, (levels > 65) & (levels <= 100))
        assert np.array_equal(found.free, levels < 20)


def test_a_mode_that_there_is_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="m.yaml: mode: expected trinary, scale, raw, found 'grey'"):
        read_ros_map(write(tmp_path, "grey", 0, (0.65, 0.196)))
