# SPDX-License-Identifier: Apache-2.0
"""No part of reading and looking at a recording writes into the images that a reader gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from format_makers import MORE_MAKERS
from read_only import read_only_images
from test_all_formats import MORE_OPTIONS
from tiny_recordings import MAKERS

from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.sequences.inspection import inspect_sequence


@pytest.mark.parametrize("scale", [None, 0.5])
@pytest.mark.parametrize("name", [*MAKERS, *MORE_MAKERS])
def test_every_format(tmp_path: Path, name: str, scale: float | None) -> None:
    place = {**MAKERS, **MORE_MAKERS}[name](tmp_path)
    options = {**MORE_OPTIONS.get(name, {}), "scale": scale, "min_confidence": 2}
    wanted = list(open_sequence(place, **options))
    with read_only_images() as delivered:
        sequence = open_sequence(place, **options)
        found = list(sequence)
        inspect_sequence(sequence)
    assert len(delivered) >= len(found) == len(wanted)
    for frame, other in zip(found, wanted, strict=True):
        assert _same(frame, other) and not frame.color.flags.writeable


def test_lens_that_is_undone_and_depth_that_is_registered(tmp_path: Path) -> None:
    place = MAKERS["folder"](tmp_path)
    entries = "depth_camera: {width: 32, height: 24, fx: 30, fy: 30, cx: 15, cy: 11, T_color_depth: "
    with (place / "camera.yaml").open("a") as file:
        file.write(entries + "[1, 0, 0, -0.02, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\ndistortion: [0.1, 0, 0, 0, 0]\n")
    wanted = open_sequence(place).frame(1)
    with read_only_images():
        found = open_sequence(place).frame(1)
    assert _same(found, wanted) and found.valid is not None


def _same(frame: Frame, other: Frame) -> bool:
    masks = (frame.mask is None and other.mask is None) or np.array_equal(frame.mask, other.mask)
    return masks and np.array_equal(frame.color, other.color) and np.array_equal(frame.depth, other.depth)
