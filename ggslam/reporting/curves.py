# SPDX-License-Identifier: Apache-2.0
"""Line plots as PNG and SVG, drawn by matplotlib (optional extra `plots`)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ggslam.errors import MissingDependency
from ggslam.system.atomic import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKERS = "osv^Dx"


@dataclass(frozen=True)
class Curve:
    """One line of a plot; points whose x or y is not finite are left out."""

    label: str
    x: Sequence[float]
    y: Sequence[float]


@dataclass(frozen=True)
class Panel:
    """One pair of axes; `from_zero`: the y axis begins at 0."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    from_zero: bool = False


def require_plotting() -> None:
    """Raises MissingDependency, saying how to get it, if matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise MissingDependency("plots need matplotlib: pip install 'ggslam[plots]', or go without plots") from None


def draw_panels(stem: Path, panels: Sequence[Panel]) -> list[Path]:
    """Draws panels side by side and writes them as `stem`.png and `stem`.svg; returns the paths.

    Raises:
        MissingDependency: matplotlib is not installed.
        RunFolderError: a file cannot be written.
    """
    require_plotting()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    written = []
    # One seed for the names within the SVG and no date: the same numbers give the same file.
    with rc_context({"svg.hashsalt": "ggslam", "font.size": 9}):
        figure = Figure(figsize=(4.8 * len(panels), 3.6), layout="constrained")
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            _draw(axes, panel)
        for suffix, options in ((".png", {"dpi": 150}), (".svg", {"metadata": {"Date": None}})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=suffix[1:], **options)  # type: ignore[arg-type]
            written.append(stem.with_name(stem.name + suffix))
            write_bytes(written[-1], buffer.getvalue())
    return written


def _draw(axes: Axes, panel: Panel) -> None:
    for number, curve in enumerate(panel.curves):
        x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
        finite = np.isfinite(x) & np.isfinite(y)
        if finite.any():
            axes.plot(x[finite], y[finite], marker=_MARKERS[number % len(_MARKERS)], markersize=4, label=curve.label)
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    axes.grid(alpha=0.3)
    if panel.from_zero:
        axes.set_ylim(bottom=0)
    if axes.lines:
        axes.legend()
