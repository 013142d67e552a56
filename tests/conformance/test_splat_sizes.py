# SPDX-License-Identifier: Apache-2.0
"""Every export of Gaussians at half, once and twice a size, in decibels against the map, by the tests' own renderer: as
the tests read the file, and as ggslam does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from splat_formats import SPLAT_FORMATS, with_colors
from splat_maps import C0, Splats
from splat_rendering import Pinhole, decibels, look_at, render

from ggslam.formats.splat_formats import read_splats
from ggslam.runs.folder import RunFolder

SIZES = (0.5, 1.0, 2.0)
POSE = look_at((0.5, -1.0, -5.0))
SPREAD = 3.0
"""Decibels that a size may differ by from the bar of pictures of one size."""


def pictures(splats: Splats, T_camera_world: np.ndarray) -> list[np.ndarray]:
    cameras = [Pinhole.centred(round(96 * size), round(72 * size), 80.0 * size) for size in SIZES]
    return [render(splats, camera, T_camera_world) for camera in cameras]


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_at_each_size(
    kind: str, degree: int, exported: Callable[[str, int, bool], Path], run_of: Callable[[int, bool], RunFolder]
) -> None:
    known, path, run = SPLAT_FORMATS[kind], exported(kind, degree, True), run_of(degree, True)
    expected = Splats.of(run.gaussians())
    if known.recolored:
        expected = with_colors(expected, run.object_table().palette()[run.gaussians().object_id.numpy()] / 255)
    elif known.base_colors:
        expected = with_colors(expected, (0.5 + C0 * expected.sh[:, 0]).clip(0, 1))
    wanted = pictures(expected, POSE)
    ours = pictures(Splats.of(read_splats(path / "lod-meta.json" if path.is_dir() else path)), POSE)
    theirs = pictures(known.read(path), known.pose(POSE))
    for size, found, own, picture in zip(SIZES, theirs, ours, wanted, strict=True):
        assert decibels([found], [picture]) > known.decibels[degree] - SPREAD, size
        assert decibels([own], [picture]) > min(known.decibels[degree] - SPREAD, 100.0), size
