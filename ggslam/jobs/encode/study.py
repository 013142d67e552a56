# SPDX-License-Identifier: Apache-2.0
"""A sweep over the codec's quantisers as files: tables, plots and pictures of the decoded cloud.

    study.csv, study.json        one row per step: settings, sizes, rates, PSNR, D1, D2, times, energy
    rate_distortion_*.png, .svg  quality over bits per point;  time_*.png, .svg: seconds over the quantiser
    cloud_*.png                  the decoded cloud at each step, seen from one place;  clouds_*.png: all on one sheet
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.coding.cloud import PointCloud
from ggslam.coding.settings import CodecSettings
from ggslam.coding.study import SWEEPS, GridCloud, StudyRow, SweepStep, run_sweep
from ggslam.reporting.cloud_pictures import CloudView, contact_sheet, draw_cloud, view_of
from ggslam.reporting.pictures import write_picture
from ggslam.reporting.plot_files import write_sheet
from ggslam.reporting.plots import Plot, Series
from ggslam.system.atomic import make_folder, write_text
from ggslam.system.csv_text import csv_text
from ggslam.system.energy import EnergyMeter
from ggslam.system.json_files import write_json
from ggslam.system.plurals import quantity


@dataclass(frozen=True)
class Study:
    """What a sweep gave: its rows, the files written, and what the reader should know."""

    rows: list[StudyRow]
    files: list[Path]
    notes: list[str]


def write_study(
    cloud: GridCloud,
    steps: Sequence[SweepStep],
    settings: CodecSettings,
    folder: Path,
    plots: bool = True,
    progress: Callable[[StudyRow], None] | None = None,
) -> Study:
    """Runs the sweep and writes its files into `folder` (made if it is not there).

    Args:
        cloud: from `on_grid`.
        steps: from `sweep_steps`.
        settings: slices, threads and tools.
        folder: where to.
        plots: whether to draw the plots.
        progress: is given each row when it is there.

    Raises:
        RunFolderError: a file cannot be written.
    """
    meter = EnergyMeter()
    pictures = _Pictures(cloud, folder)
    rows = []
    for row, decoded in run_sweep(cloud, steps, settings, meter):
        rows.append(row)
        make_folder(folder)  # now that there is something for it
        pictures.draw(row, decoded)
        if progress is not None:
            progress(row)
    files = [*write_tables(folder, cloud, settings, rows, meter.note), *pictures.sheets()]
    if plots:
        files += _draw_plots(folder, rows)
    return Study(rows, files, [meter.note] if meter.note else [])


def write_tables(
    folder: Path, cloud: GridCloud, settings: CodecSettings, rows: Sequence[StudyRow], note: str
) -> list[Path]:
    """Writes study.csv and study.json; in the latter, and empty in the former, what is infinite or unknown is null."""
    table = [row.values() for row in rows]
    write_text(folder / "study.csv", csv_text(list(table[0]), (list(row.values()) for row in table)))
    about = {
        "points": len(cloud.grid), "peak": cloud.peak, "voxels_per_unit": cloud.quantization.scale,
        "threads": settings.threads, "slices": settings.slices, "split": settings.split, "note": note or None,
    }  # fmt: skip
    write_json(folder / "study.json", {**about, "rows": table})
    return [folder / "study.csv", folder / "study.json"]


def step_name(step: SweepStep) -> str:
    """`qp_22`, `scale_0.5` or `geometry_qp_08`."""
    if step.sweep == "geometry":
        return f"scale_{step.geometry_scale:.4g}"
    return f"qp_{step.qp:02d}" if step.sweep == "qp" else f"geometry_qp_{step.geometry_qp:02d}"


class _Pictures:
    """Draws decoded clouds, all from one place, and collects them by sweep."""

    def __init__(self, cloud: GridCloud, folder: Path) -> None:
        self._folder, self._cloud = folder, cloud
        points = self._place(cloud.grid)
        self._view: CloudView = view_of(points)
        original = draw_cloud(points, cloud.colors, self._view, 1 / cloud.quantization.scale)
        self._original = (original, f"original, {quantity(len(cloud.grid), 'point')}")
        self._drawn: dict[str, list[tuple[np.ndarray, str]]] = {}

    def _place(self, voxels: np.ndarray) -> np.ndarray:
        return self._cloud.quantization.restore(voxels)

    def draw(self, row: StudyRow, decoded: PointCloud) -> None:
        """Draws and writes one picture."""
        step = row.step
        size = 1 / (self._cloud.quantization.scale * step.geometry_scale)
        picture = draw_cloud(self._place(decoded.points), decoded.attributes["color"], self._view, size)
        write_picture(self._folder / f"cloud_{step_name(step)}.png", picture)
        quality = f"Y {row.color.y:.1f} dB" if step.sweep == "qp" else f"D1 {row.d1:.1f} dB"
        caption = f"{step.words()}: {8 * row.total_bytes / row.input_points:.2f} bits a point, {quality}"
        self._drawn.setdefault(step.sweep, [self._original]).append((picture, caption))

    def sheets(self) -> list[Path]:
        """Writes the contact sheets."""
        written = []
        for sweep, drawn in self._drawn.items():
            pictures, captions = zip(*drawn, strict=True)
            written.append(self._folder / f"clouds_{sweep}.png")
            write_picture(written[-1], contact_sheet(pictures, captions))
        return written


def _draw_plots(folder: Path, rows: Sequence[StudyRow]) -> list[Path]:
    written = []
    for sweep in SWEEPS:
        table = [row.values() for row in rows if row.step.sweep == sweep]
        if table:
            written += write_sheet(folder / f"rate_distortion_{sweep}", _rate_plots(table, sweep))
            written += write_sheet(folder / f"time_{sweep}", [_time_plot(table, sweep)])
    return written


def _rate_plots(table: list[dict[str, Any]], sweep: str) -> list[Plot]:
    groups = [("colour, Y U V", ["psnr_y", "psnr_u", "psnr_v"]), ("colour, R G B", ["psnr_r", "psnr_g", "psnr_b"])]
    if sweep != "qp":
        groups = [("geometry", ["d1", "d2"]), *groups]
    rate = "color_bpp" if sweep == "qp" else "geometry_bpp"
    plots = []
    for title, names in groups:
        used = rate if title == "geometry" or sweep == "qp" else "total_bpp"
        x = [row[used] for row in table]
        curves = _series({name.removeprefix("psnr_").upper(): [row[name] for row in table] for name in names}, x)
        plots.append(Plot(title, title, f"bits per point ({used.removesuffix('_bpp')})", "PSNR, dB", curves))
    return plots


def _time_plot(table: list[dict[str, Any]], sweep: str) -> Plot:
    key, label = {
        "qp": ("qp", "QP"), "geometry": ("geometry_scale", "geometry scale"),
        "geometry_qp": ("geometry_qp", "geometry QP"),
    }[sweep]  # fmt: skip
    x = [row[key] for row in table]
    curves = _series({name: [row[f"{name}_s"] for row in table] for name in ("encode", "decode")}, x)
    return Plot("time", "time", label, "seconds", curves, from_zero=True)


def _series(columns: dict[str, list[float]], x: list[float]) -> list[Series]:
    return [Series(name, x, y, "marked", color) for color, (name, y) in enumerate(columns.items())]
