# SPDX-License-Identifier: Apache-2.0
"""+inf in float depth says that the sensor found nothing (REP 117): it reaches those who ask and changes no depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_recordings import write_color

from ggslam.sequences.factory import open_sequence
from ggslam.sequences.images import no_returns

BOX = (slice(4, 12), slice(8, 24))


def recording(folder: Path, fill: float) -> Path:
    """Two frames; the second has `fill` in a rectangle, and NaN and -inf in others."""
    (folder / "depth").mkdir(parents=True)
    for i in range(2):
        write_color(folder / "rgb" / f"{i}.png", i)
        depth = np.full((24, 32), 1.5, np.float32)
        if i:
            depth[BOX] = fill
            depth[16:20, 4:8], depth[16:20, 12:16] = np.nan, -np.inf
        np.save(folder / "depth" / f"{i}.npy", depth)
    return folder


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_no_return_is_carried_beside_the_same_depth(tmp_path: Path, scale: float) -> None:
    options = {"intrinsics": "30 31 15 11", "depth_scale": 1, "scale": scale}
    told = list(open_sequence(recording(tmp_path / "inf", np.inf), **options))
    bare = list(open_sequence(recording(tmp_path / "nan", np.nan), **options))
    assert told[0].no_return is None and bare[1].no_return is None
    for a, b in zip(told, bare, strict=True):
        assert np.array_equal(a.depth, b.depth) and np.isfinite(a.depth).all()
    step = round(1 / scale)
    expected = np.zeros((24 // step, 32 // step), bool)
    expected[4 // step : 12 // step, 8 // step : 24 // step] = True
    assert np.array_equal(told[1].no_return, expected)
    asked = told[1].depth_or_infinity()
    assert np.isposinf(asked[expected]).all() and np.array_equal(asked[~expected], told[1].depth[~expected])
    assert told[0].depth_or_infinity() is told[0].depth


@pytest.mark.parametrize(
    ("kind", "place"),
    [("mirrored", np.s_[4:12, 8:24]), ("flipped", np.s_[12:20, 8:24]), ("ray", BOX)],
)
def test_no_return_goes_with_the_kind_of_depth(tmp_path: Path, kind: str, place: tuple) -> None:
    sequence = open_sequence(
        recording(tmp_path, np.inf), intrinsics="30 31 15.5 11.5", depth_scale=1, depth_kind=kind
    )
    found = sequence.frame(1).no_return
    expected = np.zeros((24, 32), bool)
    expected[place] = True
    assert np.array_equal(found, expected)


def test_no_return_goes_through_the_registration_of_depth(tmp_path: Path) -> None:
    """Colour stands 10 cm beside depth: the wall at 1.5 m moves by 2 pixels, what lies beyond all ranges by none."""
    size = "width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 15.5\ncy: 11.5\n"
    T = "T_color_depth: [1, 0, 0, -0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    calibration = tmp_path / "depth.yaml"
    calibration.write_text(size + T + "color: {width: 32, height: 24, fx: 30, fy: 30, cx: 15.5, cy: 11.5}\n")
    options = {"depth_camera": calibration, "intrinsics": "30 30 15.5 11.5", "depth_scale": 1}
    told, bare = (open_sequence(recording(tmp_path / str(fill), fill), **options) for fill in (np.inf, np.nan))
    for a, b in zip(told, bare, strict=True):
        assert np.array_equal(a.depth, b.depth)
    assert told.frame(0).no_return is None
    found, (rows, columns) = told.frame(1).no_return, BOX
    assert found[rows, columns.start : columns.stop - 2].mean() > 0.95  # the wall on its right moves over the rest
    outside = found.copy()
    outside[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1] = False
    assert not outside.any()


def test_whole_numbers_have_no_infinity() -> None:
    assert no_returns(np.full((2, 3), 65535, np.uint16)) is None
    assert no_returns(np.full((2, 3), np.inf, np.float32)).all()
    assert no_returns(np.full((2, 3), np.inf, np.float32), (np.inf,)) is None
    assert no_returns(np.full((2, 3), np.nan, np.float32)) is None
