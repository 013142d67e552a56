# SPDX-License-Identifier: Apache-2.0
"""Plots as SVG, for pages and as files of their own, and as PNG."""

from __future__ import annotations

import html
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from ggslam.reporting.pictures import write_picture
from ggslam.reporting.plots import Box, Drawing, Plot, Stroke, Word, draw
from ggslam.system.atomic import write_text
from ggslam.system.tuning import Tuning

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#6a3d9a", "#444444")
"""Told apart with all common kinds of colour blindness (after Okabe and Ito, made dark enough for lines on white)."""
_LIGHT = {
    "axis": "#5b6270", "grid": "#e3e6ea", "text": "#30343b", "band": "#f3d9c6",
    **{f"series{number}": color for number, color in enumerate(PALETTE)},
}  # fmt: skip
_FILE_STYLE = "".join(
    [".plot text{font:13px system-ui,sans-serif;fill:#30343b}.plot .strong{font-weight:600;font-size:14px}"]
    + [f".plot .{name}{{stroke:{color};fill:none}}" for name, color in _LIGHT.items()]
    + [f".plot rect.band{{fill:{_LIGHT['band']};stroke:none}}"]
)


class PlotFileTuning(Tuning):
    """How plots become PNG files."""

    sharpness = 4
    """They are drawn this many times larger, then reduced to two pixels for each of the plot's."""


def svg(drawing: Drawing, plot: Plot, style: str = "") -> str:
    """A drawing as an SVG element, that fits itself to the width it is given.

    Args:
        drawing: of the plot.
        plot: its words become what screen readers say and what a script shows under the pointer.
        style: CSS to put into it; a page brings its own.
    """
    left, top, right, bottom = drawing.frame
    label = html.escape(f"{plot.title}: {plot.y_label} over {plot.x_label}", quote=True)
    data = " ".join(f"{value:.9g}" for value in (*drawing.frame, *drawing.limits))
    names = html.escape("\n".join(series.label for series in plot.series), quote=True).replace("\n", "&#10;")
    parts = [
        f'<svg class="plot" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawing.width} {drawing.height}" '
        f'role="img" aria-label="{label}" data-axes="{data}" data-names="{names}" '
        f'data-x="{html.escape(plot.x_label, quote=True)}">'
    ]
    parts += [f"<style>{style}</style>"] if style else []
    parts += [_element(item) for item in drawing.items]
    return "".join([*parts, "</svg>"])


def _element(item: Stroke | Word | Box) -> str:
    if isinstance(item, Box):
        size = f'x="{item.x:.1f}" y="{item.y:.1f}" width="{item.width:.1f}" height="{item.height:.1f}"'
        return f'<rect class="{item.color}" {size}/>'
    if isinstance(item, Word):
        turn = f' transform="rotate(-90 {item.x:.1f} {item.y:.1f})"' if item.upright else ""
        strong = ' class="strong"' if item.strong else ""
        place = f'x="{item.x:.1f}" y="{item.y:.1f}" text-anchor="{item.anchor}"'
        return f"<text {place}{strong}{turn}>{html.escape(item.text)}</text>"
    number = "" if item.number is None else f' data-n="{item.number}"'
    if item.dots:  # each dot is a line of no length with a round end: one element for all of them
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in item.points)
        style = 'stroke-width="6" stroke-linecap="round"'
        return f'<path class="{item.color}" {style}{number} d="{path}"/>'
    dash = ' stroke-dasharray="6 4"' if item.dashed else ""
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in item.points)
    return f'<polyline class="{item.color}" stroke-width="{item.width:g}"{dash}{number} points="{points}"/>'


@lru_cache
def _rgb(name: str) -> tuple[int, int, int]:
    code = _LIGHT[name]
    return int(code[1:3], 16), int(code[3:5], 16), int(code[5:7], 16)


def rasterize(drawing: Drawing) -> np.ndarray:
    """A drawing as pixels, uint8 [2 height, 2 width, 3]. Letters that are not ASCII become question marks."""
    s = PlotFileTuning.sharpness
    canvas = np.full((s * drawing.height, s * drawing.width, 3), 255, np.uint8)
    for item in drawing.items:
        if isinstance(item, Box):
            corner = (round(s * item.x), round(s * item.y))
            opposite = (round(s * (item.x + item.width)), round(s * (item.y + item.height)))
            cv2.rectangle(canvas, corner, opposite, _rgb(item.color), cv2.FILLED)
        elif isinstance(item, Word):
            _write(canvas, item)
        elif item.dots:
            for x, y in item.points:
                cv2.circle(canvas, (round(s * x), round(s * y)), 3 * s, _rgb(item.color), cv2.FILLED)
        else:
            for part in _dashes(item.points) if item.dashed else [item.points]:
                pixels = np.rint(s * part).astype(np.int32).reshape(-1, 1, 2)
                cv2.polylines(canvas, [pixels], False, _rgb(item.color), max(1, round(s * item.width)))
    return cv2.resize(canvas, None, fx=2 / s, fy=2 / s, interpolation=cv2.INTER_AREA)


def _dashes(points: np.ndarray, length: float = 10.0, share: float = 0.6) -> list[np.ndarray]:
    """A polyline cut into dashes, each with the corners on its way."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    parts = []
    for begin in np.arange(0, along[-1], length):
        end = min(begin + share * length, along[-1])
        stops = np.concatenate([[begin], along[(along > begin) & (along < end)], [end]])
        parts.append(np.stack([np.interp(stops, along, points[:, k]) for k in (0, 1)], 1))
    return parts


def _write(canvas: np.ndarray, word: Word) -> None:
    s, font = PlotFileTuning.sharpness, cv2.FONT_HERSHEY_SIMPLEX
    size, thick = 0.42 * s * (1.2 if word.strong else 1.0), round(1.1 * s / 2) + (s // 2 if word.strong else 0)
    text = word.text.encode("ascii", "replace").decode()
    (wide, tall), below = cv2.getTextSize(text, font, size, thick)
    share = {"start": 0.0, "middle": 0.5, "end": 1.0}[word.anchor]
    if not word.upright:
        place = (round(s * word.x - share * wide), round(s * word.y))
        cv2.putText(canvas, text, place, font, size, _rgb("text"), thick, cv2.LINE_AA)
        return
    patch = np.full((tall + below + 2 * thick, wide, 3), 255, np.uint8)
    cv2.putText(patch, text, (0, tall + thick), font, size, _rgb("text"), thick, cv2.LINE_AA)
    patch = np.rot90(patch)
    top, left = max(0, round(s * word.y - wide / 2)), max(0, round(s * word.x) - tall)
    target = canvas[top : top + patch.shape[0], left : left + patch.shape[1]]
    np.minimum(target, patch[: target.shape[0], : target.shape[1]], out=target)


def write_plots(folder: Path, plots: list[Plot]) -> list[Path]:
    """Writes each plot as NAME.svg and NAME.png into a folder that is there; returns the files.

    Raises:
        RunFolderError: a file cannot be written.
    """
    return [path for plot in plots for path in write_sheet(folder / plot.name, [plot])]


def write_sheet(stem: Path, plots: Sequence[Plot]) -> list[Path]:
    """Writes plots side by side as `stem`.svg and `stem`.png; returns the files. Those without data are left out, and
    if all are, nothing is written.

    Raises:
        RunFolderError: a file cannot be written.
    """
    shown = [plot for plot in plots if plot.has_data()]
    if not shown:
        return []
    height = 480 if any(plot.equal for plot in shown) else 340
    drawings = [draw(plot, height=height, titled=True) for plot in shown]
    if len(shown) == 1:
        text = svg(drawings[0], shown[0], _FILE_STYLE)
    else:
        ends = np.cumsum([drawing.width for drawing in drawings]).tolist()
        parts = [
            svg(drawing, plot).replace("<svg ", f'<svg x="{end - drawing.width}" width="{drawing.width}" ', 1)
            for drawing, plot, end in zip(drawings, shown, ends, strict=True)
        ]
        text = (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {ends[-1]} {height}">'
                f"<style>{_FILE_STYLE}</style>{''.join(parts)}</svg>")  # fmt: skip
    files = [stem.with_name(stem.name + suffix) for suffix in (".svg", ".png")]
    write_text(files[0], text + "\n")
    write_picture(files[1], np.concatenate([rasterize(drawing) for drawing in drawings], axis=1))
    return files
