# SPDX-License-Identifier: Apache-2.0
"""Line plots: what is to be shown (`Plot`), and where each line and word of it goes (`draw`), for `plot_files`.

Colours are names that a style sheet or a palette resolves: series0 to series7, axis, grid, text, band.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ggslam.system.tuning import Tuning


class PlotTuning(Tuning):
    """How plots are laid out."""

    max_points = 800
    """Most points of a curve; a longer one is drawn by the lowest and highest value of each stretch."""
    colors = 8
    """Number of colours."""
    left = 74
    """Left margin, in pixels."""
    right = 16
    """Right margin, in pixels."""
    top = 12
    """Upper margin, in pixels."""
    bottom = 46
    """Lower margin, in pixels."""
    character_width = 9.0
    """Mean width of a letter of the legend, in pixels; narrow windows show letters larger than lines."""
    legend_row = 20
    """Height of a row of the legend, in pixels."""


@dataclass(frozen=True)
class Series:
    """One curve.

    Attributes:
        label: its name in the legend.
        x, y: as many numbers each; where one is not finite, the curve is interrupted.
        kind: line, dots alone, or a line with a dot at each point.
        color: number of its colour, 0 to 7.
        dashed: whether the line is.
    """

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    kind: Literal["line", "dots", "marked"] = "line"
    color: int = 0
    dashed: bool = False


@dataclass(frozen=True)
class Band:
    """A stretch of the x axis to be marked, such as frames without a pose."""

    low: float
    high: float
    label: str


@dataclass(frozen=True)
class Plot:
    """One pair of axes.

    Attributes:
        name: of its file.
        title: a few words.
        x_label, y_label: with units.
        series: the curves.
        bands: marked stretches of x; those of one label share a line of the legend.
        from_zero: y begins at 0.
        equal: one unit is as long along x as along y (maps).
        note: a sentence for below the plot.
        named: the legend names a curve even if it is alone.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    bands: Sequence[Band] = ()
    from_zero: bool = False
    equal: bool = False
    note: str = ""
    named: bool = False

    def has_data(self) -> bool:
        """Whether anything would be seen."""
        return any(np.isfinite(_xy(s)).all(1).any() for s in self.series)


@dataclass(frozen=True)
class Stroke:
    """A polyline float [N, 2] in pixels, or with `dots` the dots at these places; `number` of its series."""

    points: np.ndarray
    color: str
    width: float = 1.0
    dashed: bool = False
    dots: bool = False
    number: int | None = None


@dataclass(frozen=True)
class Word:
    """A text; x is its start, middle or end; upright texts run from below to above."""

    text: str
    x: float
    y: float
    anchor: Literal["start", "middle", "end"] = "middle"
    upright: bool = False
    strong: bool = False


@dataclass(frozen=True)
class Box:
    """A filled rectangle."""

    x: float
    y: float
    width: float
    height: float
    color: str


@dataclass
class Drawing:
    """A plot in pixels.

    Attributes:
        width, height: of the picture.
        frame: left, top, right, bottom of the axes.
        limits: x and y at left, right, bottom, top of the axes.
        items: in the order in which they are drawn.
    """

    width: int
    height: int
    frame: tuple[float, float, float, float]
    limits: tuple[float, float, float, float]
    items: list[Stroke | Word | Box] = field(default_factory=list)


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """About `count` round numbers (1, 2 or 5 times a power of ten apart) from `low` to `high`."""
    raw = (high - low) / max(1, count)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float, step: float) -> str:
    """A number of an axis, with as many digits as ticks `step` apart need."""
    if max(abs(value), step) >= 1e5:
        return f"{value / 1000:.0f}k" if step >= 1000 else f"{value:.0f}"
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value + 0.0:.{digits}f}" if abs(value) > step / 1e6 else f"{0:.{digits}f}"


def draw(plot: Plot, width: int = 640, height: int = 300, titled: bool = False) -> Drawing:
    """Lays a plot out.

    Args:
        plot: with data.
        width, height: pixels. Plots with equal units take less of it if that is their shape.
        titled: whether the title is part of the drawing.
    """
    legend = _legend_rows(plot, width)
    top = PlotTuning.top + (24 if titled else 0) + PlotTuning.legend_row * len(legend)
    x0, x1, y0, y1 = _limits(plot)
    left, right, bottom = float(PlotTuning.left), float(width - PlotTuning.right), float(height - PlotTuning.bottom)
    if plot.equal:
        x0, x1, y0, y1 = _equalise((x0, x1, y0, y1), right - left, bottom - top)
    drawing = Drawing(width, height, (left, top, right, bottom), (x0, x1, y0, y1))
    if titled:
        drawing.items.append(Word(plot.title, width / 2, 22, strong=True))
    for band in plot.bands:
        low, high = (left + (right - left) * (np.clip(v, x0, x1) - x0) / (x1 - x0) for v in (band.low, band.high))
        drawing.items.append(Box(low, top, max(high - low, 2), bottom - top, "band"))
    _axes(drawing, plot)
    scale = np.array([(right - left) / (x1 - x0), -(bottom - top) / (y1 - y0)])
    for number, series in enumerate(plot.series):
        for part in _parts(series):
            pixels = np.array([left, bottom]) + (part - np.array([x0, y0])) * scale
            dots = series.kind == "dots" or len(part) == 1
            drawing.items.append(Stroke(pixels, f"series{series.color}", 1.8, series.dashed, dots, number))
            if series.kind == "marked" and not dots:
                drawing.items.append(Stroke(pixels, f"series{series.color}", dots=True))
    _legend(drawing, plot, legend, PlotTuning.top + (24 if titled else 0))
    return drawing


def _xy(series: Series) -> np.ndarray:
    return np.stack([np.asarray(series.x, float), np.asarray(series.y, float)], 1).reshape(-1, 2)


def _parts(series: Series) -> list[np.ndarray]:
    """Stretches [N, 2] without gaps, thinned."""
    xy = _xy(series)
    finite = np.isfinite(xy).all(1)
    if series.kind == "dots":
        return [xy[finite]] if finite.any() else []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]]).astype(int)))
    stride = max(1, math.ceil(len(xy) / PlotTuning.max_points))
    return [_thin(xy[a:b], 2 * stride) for a, b in edges.reshape(-1, 2)]


def _thin(xy: np.ndarray, stretch: int) -> np.ndarray:
    """Of every `stretch` points those of lowest and highest y; all, if that is 2."""
    if stretch <= 2 or len(xy) <= 2:
        return xy
    keep = {0, len(xy) - 1}
    for begin in range(0, len(xy), stretch):
        part = xy[begin : begin + stretch, 1]
        keep |= {begin + int(part.argmin()), begin + int(part.argmax())}
    return xy[sorted(keep)]


def _limits(plot: Plot) -> tuple[float, float, float, float]:
    xy = np.concatenate([_xy(s) for s in plot.series])
    xy = xy[np.isfinite(xy).all(1)]
    if not len(xy):
        raise ValueError(f"plot {plot.name}: no finite values")
    (x0, y0), (x1, y1) = xy.min(0).tolist(), xy.max(0).tolist()
    if plot.from_zero:
        y0, y1 = min(0.0, y0), max(y1, 0.0)
    if x1 - x0 <= 1e-9 * max(1.0, abs(x0)):
        x0, x1 = x0 - 0.5, x1 + 0.5
    if y1 - y0 <= 1e-9 * max(1.0, abs(y0)):
        y0, y1 = y0 - (0 if plot.from_zero and y0 == 0 else 0.5), y1 + 0.5
    margin = 0.05 * (y1 - y0)
    return x0, x1, y0 - (0 if plot.from_zero and y0 == 0 else margin), y1 + margin


def _equalise(
    limits: tuple[float, float, float, float], width: float, height: float
) -> tuple[float, float, float, float]:
    """Limits around the same centre with one unit as long along both axes, and a margin."""
    x0, x1, y0, y1 = limits
    unit = max(1.06 * (x1 - x0) / width, (y1 - y0) / height, 1e-6)
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    return x - unit * width / 2, x + unit * width / 2, y - unit * height / 2, y + unit * height / 2


def _axes(drawing: Drawing, plot: Plot) -> None:
    (left, top, right, bottom), (x0, x1, y0, y1) = drawing.frame, drawing.limits
    xs = ticks(x0, x1, max(2, int((right - left) / 90)))
    ys = ticks(y0, y1, max(2, int((bottom - top) / 40)))
    items = drawing.items
    for value in ys:
        y = bottom - (bottom - top) * (value - y0) / (y1 - y0)
        items.append(Stroke(np.array([[left, y], [right, y]]), "grid"))
        items.append(Word(tick_text(value, _step(ys)), left - 7, y + 4, "end"))
    for value in xs:
        x = left + (right - left) * (value - x0) / (x1 - x0)
        items.append(Stroke(np.array([[x, top], [x, bottom]]), "grid"))
        items.append(Word(tick_text(value, _step(xs)), x, bottom + 18))
    items.append(Stroke(np.array([[left, top], [left, bottom], [right, bottom]]), "axis"))
    items.append(Word(plot.x_label, (left + right) / 2, bottom + 38))
    items.append(Word(plot.y_label, 13, (top + bottom) / 2, upright=True))


def _step(values: list[float]) -> float:
    return values[1] - values[0] if len(values) > 1 else max(abs(values[0]), 1e-3) if values else 1.0


def _entries(plot: Plot) -> list[tuple[str, Series | None]]:
    series: list[tuple[str, Series | None]] = [(s.label, s) for s in plot.series]
    bands: list[tuple[str, Series | None]] = [(label, None) for label in dict.fromkeys(b.label for b in plot.bands)]
    return (series if len(series) > 1 or plot.named else []) + bands


def _legend_rows(plot: Plot, width: int) -> list[list[tuple[str, Series | None]]]:
    """Entries of the legend in rows that fit; one curve alone needs none where its axis names it."""
    rows: list[list[tuple[str, Series | None]]] = []
    used = math.inf
    for entry in _entries(plot):
        wide = _entry_width(entry[0])
        if used + wide > width - PlotTuning.left - PlotTuning.right:
            rows.append([])
            used = 0
        rows[-1].append(entry)
        used += wide
    return rows


def _entry_width(label: str) -> float:
    return 40 + PlotTuning.character_width * len(label)


def _legend(drawing: Drawing, plot: Plot, rows: list[list[tuple[str, Series | None]]], top: float) -> None:
    for number, row in enumerate(rows):
        x, y = float(PlotTuning.left), top + PlotTuning.legend_row * number + 5
        for label, series in row:
            if series is None:
                drawing.items.append(Box(x, y - 6, 18, 12, "band"))
            else:
                dots = series.kind == "dots"
                points = np.array([[x + 9, y]]) if dots else np.array([[x, y], [x + 18, y]])
                drawing.items.append(Stroke(points, f"series{series.color}", 2.4, series.dashed, dots))
            drawing.items.append(Word(label, x + 24, y + 4, "start"))
            x += _entry_width(label)
