# SPDX-License-Identifier: Apache-2.0
"""Where the lines of plots go, and the files that come of them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.reporting.plot_files import rasterize, svg, write_plots, write_sheet
from ggslam.reporting.plots import Band, Plot, PlotTuning, Series, Stroke, Word, draw, tick_text, ticks


def curves(drawing_items: list, number: int = 0) -> list[np.ndarray]:
    return [item.points for item in drawing_items if isinstance(item, Stroke) and item.number == number]


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0, 10, 5) == [0, 2, 4, 6, 8, 10]
    np.testing.assert_allclose(ticks(0.93, 0.981, 6), [0.93, 0.94, 0.95, 0.96, 0.97, 0.98])
    assert ticks(-3, 3, 3) == [-2, 0, 2]
    assert [tick_text(v, 0.05) for v in (-0.05, 0.0, 0.1)] == ["-0.05", "0.00", "0.10"]
    assert tick_text(200_000, 50_000) == "200k"


def test_values_stand_where_the_axes_say() -> None:
    plot = Plot("p", "Title", "frame", "error (cm)", [Series("a", [0, 5, 10], [0, 4, 2])], from_zero=True)
    drawing = draw(plot)
    left, top, right, bottom = drawing.frame
    x0, x1, y0, y1 = drawing.limits
    assert (x0, x1, y0) == (0, 10, 0) and y1 > 4
    (points,) = curves(drawing.items)
    np.testing.assert_allclose(points[1], [(left + right) / 2, bottom - (bottom - top) * 4 / y1])
    words = [item.text for item in drawing.items if isinstance(item, Word)]
    assert {"frame", "error (cm)"} <= set(words)


def test_gaps_interrupt_a_curve_and_lost_frames_are_marked() -> None:
    values = [1.0, 2.0, np.nan, np.nan, 3.0, 4.0]
    plot = Plot("p", "t", "x", "y", [Series("a", range(6), values)], [Band(1.5, 3.5, "lost")])
    drawing = draw(plot)
    assert [len(part) for part in curves(drawing.items)] == [2, 2]
    assert "lost" in [item.text for item in drawing.items if isinstance(item, Word)]


def test_long_curves_are_thinned_but_keep_their_extremes() -> None:
    values = np.zeros(100_000)
    values[51_234], values[70_001] = 9, -7
    drawing = draw(Plot("p", "t", "x", "y", [Series("a", np.arange(len(values)), values)]))
    (points,) = curves(drawing.items)
    assert 100 < len(points) < 2.2 * PlotTuning.max_points
    y0, y1 = drawing.limits[2:]
    top, bottom = drawing.frame[1], drawing.frame[3]
    shown = y1 - (y1 - y0) * (points[:, 1] - top) / (bottom - top)
    assert shown.max() == pytest.approx(9) and shown.min() == pytest.approx(-7)


def test_maps_have_one_unit_along_both_axes() -> None:
    drawing = draw(Plot("p", "t", "x", "y", [Series("a", [0, 10], [0, 1])], equal=True))
    (points,) = curves(drawing.items)
    wide, tall = np.abs(points[1] - points[0])
    assert wide == pytest.approx(10 * tall)
    left, top, right, bottom = drawing.frame
    assert (points[:, 0] >= left).all() and (points[:, 0] <= right).all()


@pytest.mark.parametrize("values", [[5.0], [5.0, 5.0], [0.0, 0.0], [-3.0, -3.0]])
def test_constant_and_single_values_can_be_drawn(values: list[float]) -> None:
    for from_zero in (False, True):
        drawing = draw(Plot("p", "t", "x", "y", [Series("a", range(len(values)), values)], from_zero=from_zero))
        points = np.concatenate(curves(drawing.items))
        left, top, right, bottom = drawing.frame
        assert ((points >= [left, top]) & (points <= [right, bottom])).all()


def test_a_plot_without_finite_values_says_so() -> None:
    empty = Plot("p", "t", "x", "y", [Series("a", [0, 1], [np.nan, np.inf])])
    assert not empty.has_data() and not Plot("p", "t", "x", "y", []).has_data()
    with pytest.raises(ValueError, match="plot p"):
        draw(empty)


def test_svg_is_well_formed_and_escapes_words() -> None:
    plot = Plot("p", 'a "b" <i>', "x & y", "y", [Series("<script>", [0, 1], [1, 2]), Series("b", [0], [1], "dots")])
    root = ElementTree.fromstring(svg(draw(plot), plot))
    assert root.get("data-names") == "<script>\nb"
    assert not list(root.iter("{http://www.w3.org/2000/svg}script"))
    assert "<script>" in [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]


def test_files_show_curves_in_their_colours(tmp_path: Path) -> None:
    series = [Series("a", [0, 1], [1, 2]), Series("b", [0, 1], [2, 1], dashed=True, color=1)]
    plot = Plot("error", "t", "x", "y", series)
    written = write_plots(tmp_path, [plot])
    assert [path.name for path in written] == ["error.svg", "error.png"]
    ElementTree.parse(written[0])
    pixels = cv2.imread(str(written[1]))[..., ::-1]
    np.testing.assert_array_equal(pixels, rasterize(draw(plot, height=340, titled=True)))
    blue = (pixels == (0, 0x72, 0xB2)).all(-1).sum()
    orange = (pixels == (0xD5, 0x5E, 0)).all(-1).sum()
    assert 0.4 * blue < orange < 0.8 * blue  # three fifths of it


def test_a_sheet_holds_plots_side_by_side(tmp_path: Path) -> None:
    one = Plot("one", "One", "x", "y", [Series("a", [0, 1, 2], [3, 1, 2], "marked")])
    other, empty = replace(one, name="other", title="Other"), replace(one, series=[Series("a", [0], [np.inf])])
    written = write_sheet(tmp_path / "sheet_0.5", [one, empty, other])
    assert [path.name for path in written] == ["sheet_0.5.svg", "sheet_0.5.png"]
    space = "{http://www.w3.org/2000/svg}"
    parts = ElementTree.parse(written[0]).getroot().findall(f"{space}svg")
    assert [float(part.get("x", -1)) for part in parts] == [0.0, float(parts[0].get("width", 0))]
    assert all(len(part.findall(f"{space}path")) == 1 for part in parts)  # the dots
    left = rasterize(draw(one, height=340, titled=True))
    pixels = cv2.imread(str(written[1]))[..., ::-1]
    assert pixels.shape[1] == 2 * left.shape[1]
    np.testing.assert_array_equal(pixels[:, : left.shape[1]], left)
    assert write_sheet(tmp_path / "none", [empty]) == [] and len(list(tmp_path.iterdir())) == 2
