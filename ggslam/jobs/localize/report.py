# SPDX-License-Identifier: Apache-2.0
"""Results of localizing a recording: the numbers of SRT-PM's table 1, a trajectory, and plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.formats.trajectory import write_tum
from ggslam.jobs.progress import Observer
from ggslam.localization.localizer import Localization
from ggslam.reporting.plot_files import write_sheet
from ggslam.reporting.plots import Plot, Series
from ggslam.scene.poses import turning_angle
from ggslam.system.atomic import make_folder
from ggslam.system.json_files import write_json
from ggslam.system.process_memory import peak_memory_mb
from ggslam.system.tuning import Tuning


class BeyondMapTuning(Tuning):
    """When a scan lies beyond the map."""

    max_share = 0.5
    """Largest share of a scan beyond the map without a warning."""


@dataclass(frozen=True)
class LocalizationReport:
    """Results and what they are compared with.

    Attributes:
        map, sequence: as they were asked for.
        full: whether the whole map was aligned to.
        timestamps: float64 [n], seconds.
        results: of each frame or scan.
        truth: given poses [n, 4, 4], NaN where unknown, or None.
        damaged: what is wrong with cells that were left out.
        radius: R' in metres.
    """

    map: str
    sequence: str
    full: bool
    timestamps: np.ndarray
    results: Sequence[Localization]
    truth: np.ndarray | None
    damaged: Sequence[str] = ()
    radius: float = 0.0

    def poses(self) -> np.ndarray:
        """T_world_sensor [n, 4, 4], NaN where it was not located."""
        unknown = np.full((4, 4), np.nan)
        return np.array([r.T_world_sensor if r.status.is_located else unknown for r in self.results])

    def errors_m(self) -> np.ndarray | None:
        """Distances [n] to the given poses as they are, NaN where either is unknown."""
        if self.truth is None:
            return None
        return np.asarray(np.linalg.norm(self.poses()[:, :3, 3] - self.truth[: len(self.results), :3, 3], axis=1))

    def beyond(self) -> float:
        """Median share of a scan's points that lie beyond the map in memory; 0 of images."""
        return float(np.median([r.beyond for r in self.results])) if self.results else 0.0

    def warnings(self) -> list[str]:
        """What the user should know of the map and the recording."""
        if self.beyond() <= BeyondMapTuning.max_share:
            return []
        what = f"{self.beyond():.0%} of the points of a scan (median) lie beyond"
        if self.full:
            return [f"{what} the map and do not count"]
        return [f"{what} the map in memory (R' {self.radius:g} m) and do not count"]

    def summary(self) -> dict[str, Any]:
        """All numbers; None for what is not known."""
        n = max(1, len(self.results))
        ms = 1e3 * np.array([r.seconds for r in self.results] or [np.nan])
        points = [r.map_points for r in self.results if r.map_points]
        return {
            "map": self.map, "sequence": self.sequence, "full_map": self.full, "frames": len(self.results),
            "located_share": sum(r.status.is_located for r in self.results) / n,
            "statuses": dict(Counter(r.status.value for r in self.results)),
            "localization_ms": {"mean": ms.mean(), "median": np.median(ms), "p95": np.percentile(ms, 95),
                                "max": ms.max()},
            "map_ms_mean": 1e3 * sum(r.map_seconds for r in self.results) / n,
            "align_ms_mean": 1e3 * sum(r.align_seconds for r in self.results) / n,
            "map_points_mean": float(np.mean(points)) if points else 0.0,
            "map_changes": sum(r.map_changed for r in self.results),
            "beyond_map_median": self.beyond(), "warnings": self.warnings(),
            "damaged_cells": list(self.damaged), "peak_rss_mb": peak_memory_mb(), **self._accuracy(),
        }  # fmt: skip

    def _accuracy(self) -> dict[str, Any]:
        errors = self.errors_m()
        if errors is None or self.truth is None:
            return {"rmse_m": None, "rmse_aligned_m": None, "rotation_rmse_deg": None}
        known = np.isfinite(errors)
        pairs = zip(self.poses()[known], self.truth[: len(self.results)][known], strict=True)
        turns = np.degrees([turning_angle(one, other) for one, other in pairs])
        scores = score_trajectory(self.poses(), self.truth[: len(self.results)])
        return {
            "rmse_m": float(np.sqrt((errors[known] ** 2).mean())) if known.any() else None,
            "error_max_m": float(errors[known].max()) if known.any() else None,
            "rmse_aligned_m": None if scores is None else scores.ate_rmse_m,
            "rotation_rmse_deg": float(np.sqrt((turns**2).mean())) if known.any() else None,
        }


def write_localization(report: LocalizationReport, out: Path, observer: Observer) -> None:
    """Writes trajectory.txt, localization.json, and the plots path.png and path.svg.

    Raises:
        RunFolderError: a file cannot be written.
    """
    make_folder(out)
    write_tum(out / "trajectory.txt", report.timestamps[: len(report.results)], report.poses())
    frames = [
        {"timestamp": time, "status": r.status.value, "overlap": r.overlap, "rmse_m": r.rmse_m, "reason": r.reason,
         "beyond_map": r.beyond,
         "map_points": r.map_points, "map_ms": 1e3 * r.map_seconds, "align_ms": 1e3 * r.align_seconds}
        for time, r in zip(report.timestamps.tolist(), report.results, strict=False)
    ]  # fmt: skip
    content = {"summary": report.summary(), "frames": frames}
    write_json(out / "localization.json", content)
    write_sheet(out / "path", _plots(report))


def _plots(report: LocalizationReport) -> list[Plot]:
    paths = {"located": report.poses()[:, :3, 3]}
    if report.truth is not None:
        paths = {"given": report.truth[: len(report.results), :3, 3], **paths}
    spread = np.nan_to_num(np.nanmax(paths["located"], 0) - np.nanmin(paths["located"], 0)) if len(
        report.results
    ) and np.isfinite(paths["located"]).any() else np.ones(3)  # fmt: skip
    across, along = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    path = [Series(name, p[:, across], p[:, along], color=n) for n, (name, p) in enumerate(paths.items())]
    times = (report.timestamps - report.timestamps[0])[: len(report.results)]
    errors, ms = report.errors_m(), [1e3 * r.seconds for r in report.results]
    plots = [Plot("path", "path", f"{'xyz'[across]}, m", f"{'xyz'[along]}, m", path, equal=True)]
    if errors is not None:
        distance = Series("distance", times, 100 * errors)
        plots.append(Plot("error", "distance from the given poses", "s", "cm", [distance], from_zero=True))
    return [*plots, Plot("time", "time of a frame", "s", "ms", [Series("a frame", times, ms)], from_zero=True)]
