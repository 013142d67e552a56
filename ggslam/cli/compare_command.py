# SPDX-License-Identifier: Apache-2.0
"""`ggslam compare`: two runs side by side, or a run against a cloud or mesh."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ggslam.cli.changes_command import print_changes
from ggslam.cli.console import console, progress_bar, table
from ggslam.cli.observer import ProgressObserver
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.geometry.clouds import Overlap
    from ggslam.geometry.surface_distances import SurfaceDistances
    from ggslam.jobs.compare.comparison import Comparison
    from ggslam.runs.records.metrics import MetricsRecord

EPILOG = """
[bold]Examples[/]

  ggslam compare runs/with_loops runs/without_loops

  ggslam compare runs/room0 room0_mesh.ply --align truth

  ggslam compare runs/kitchen scan_of_kitchen.ply --align icp

  ggslam compare runs/a runs/b --align trajectory --thresholds 0.01,0.03 --out difference.json

  ggslam compare runs/monday runs/tuesday --changes
"""


class AlignmentName(str, Enum):
    """How A is brought into the frame of B."""

    auto = "auto"
    none = "none"
    truth = "truth"
    icp = "icp"
    trajectory = "trajectory"


SidePath = Annotated[
    Path,
    typer.Argument(metavar="A", help="Folder of a run, PLY or PCD file with a cloud or mesh, or file of Gaussians "
                   "(.sog, .spz, ...)."),
]  # fmt: skip
ReferencePath = Annotated[Path, typer.Argument(metavar="B", help="The reference: a run, cloud or mesh, too.")]


def compare(
    a: SidePath,
    b: ReferencePath,
    align: Annotated[
        AlignmentName,
        typer.Option(help="none: both share a world, as runs of one recording do; truth: by the true poses that a run "
                     "kept, meshes and clouds lying in their world; icp: register A onto B; trajectory: align camera "
                     "positions at common times; auto: truth where that clearly fits better than none."),
    ] = AlignmentName.auto,
    max_distance: Annotated[
        float, typer.Option(help="Farthest partners that fitness and inlier RMSE count, metres; distances to the "
                            "surface count all points.")
    ] = 0.05,
    thresholds: Annotated[str, typer.Option(help="Distances for precision, recall and F1, metres.")] = "0.01,0.02,0.05",
    seed: Annotated[int, typer.Option(help="Seed of the random samples.", min=0)] = 0,
    changes: Annotated[
        bool, typer.Option("--changes", help="For two runs: also list what changed from A, the earlier visit, to B.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="JSON file to write all numbers to.")] = None,
) -> None:  # fmt: skip
    """Compare two maps: how far apart trajectories and surfaces are, and scores side by side. B is the reference."""
    from ggslam.jobs.compare.comparison import compare_maps
    from ggslam.runs.folder import RunFolder
    from ggslam.system.atomic import write_text
    from ggslam.system.json_files import json_ready

    for path in (a, b) if changes else ():
        RunFolder.open(path)  # before anything takes long
    found = compare_maps(a, b, align.value, max_distance, _numbers(thresholds), seed)
    _print(found, max_distance)
    values = found.to_dict()
    if changes:
        values["changes"] = _changes(a, b)
    if out is not None:
        write_text(out, json.dumps(json_ready(values), indent=1) + "\n")
        console.print(f"wrote {out}", highlight=False, markup=False)


def _changes(old: Path, new: Path) -> dict[str, Any]:
    from ggslam.jobs.changes.changes import find_changes

    with progress_bar() as bar:
        outcome = find_changes(old, new, observer=ProgressObserver(bar))
    print_changes(outcome.table)
    return outcome.table.to_dict()


def _numbers(text: str) -> list[float]:
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if not values:
        raise ConfigError(f'--thresholds: expected numbers like "0.01,0.02,0.05", found {text!r}')
    return values


def _print(c: Comparison, max_distance: float) -> None:
    for name, side in (("A", c.a), ("B", c.b)):
        console.print(f"{name}: {side.path}, {quantity(len(side.points), 'point')}", highlight=False, markup=False)
    if c.align != "none":
        console.print(f"A is moved into the frame of B: {_ALIGNED[c.align]}", highlight=False)
    console.print(table(f"overlap within {100 * max_distance:g} cm", _COLUMNS, _overlaps(c)))
    if c.pair_distance_m > max_distance:
        console.print(
            f"note: the points of B are far apart: a partner within {100 * max_distance:g} cm is chance, so fitness "
            f"and the table below say little (--max-distance {c.pair_distance_m:.2f} would); go by the distances to "
            "the surface",
            highlight=False, markup=False, soft_wrap=True,
        )  # fmt: skip
    if max(c.a_on_b.fitness, c.b_on_a.fitness) < CompareTuning.min_partners:
        console.print(
            "note: hardly anything of the two lies together: they show different places, or lie in different worlds "
            "(--align); the distances below mean nothing then", highlight=False, markup=False, soft_wrap=True
        )  # fmt: skip
    if c.icp is not None:
        console.print(
            f"ICP moves A by {100 * c.icp.moved_m:.2f} cm, {c.icp.turned_deg:.3f} deg", highlight=False, markup=False
        )
    else:
        console.print("ICP: too few points of A lie near B", highlight=False)
    rows = [[f"{100 * t.threshold_m:g} cm", *(f"{100 * v:.1f} %" for v in (t.precision, t.recall, t.f1))]
            for t in c.scores.thresholds]  # fmt: skip
    console.print(table("surfaces of A against B", ["within", "precision", "recall", "F1"], rows))
    s = c.scores
    console.print(
        f"accuracy {100 * s.accuracy_m:.2f} cm (median {100 * s.accuracy_median_m:.2f}), completeness "
        f"{100 * s.completeness_m:.2f} cm (median {100 * s.completeness_median_m:.2f})", highlight=False
    )  # fmt: skip
    console.print(_trajectory_line(c), highlight=False)
    verdicts = [side.verdict for side in (c.a, c.b)]
    rows = [["verdict", *("-" if v is None else v.summary() for v in verdicts)]] if any(verdicts) else []
    rows += _metric_rows(c.a.metrics, c.b.metrics)
    if rows:
        console.print(table("scores", ["", "A", "B"], rows))


_ALIGNED = {
    "truth": "by the true poses", "icp": "by ICP", "trajectory": "by camera positions at common times",
}  # fmt: skip


class CompareTuning(Tuning):
    """When two runs show different places."""

    min_partners = 0.05
    """Smallest share of points with a partner, in the better direction."""


_COLUMNS = ["", "fitness", "inlier RMSE", "to the surface: median", "90 %"]


def _overlaps(c: Comparison) -> list[list[str]]:
    def row(name: str, o: Overlap, to: SurfaceDistances) -> list[str]:
        distances = (o.inlier_rmse_m, to.median_m, to.p90_m)
        return [name, f"{o.fitness:.4f}", *(f"{100 * distance:.2f} cm" for distance in distances)]

    rows = [row("A on B", c.a_on_b, c.surface[0]), row("B on A", c.b_on_a, c.surface[1])]
    after = c.surface_after_icp
    if c.icp is not None and c.b_on_a_after_icp is not None and after is not None and c.align != "icp":
        rows.append(row("A on B after ICP", c.icp.overlap, after[0]))
        rows.append(row("B on A after ICP", c.b_on_a_after_icp, after[1]))
    return rows


def _trajectory_line(c: Comparison) -> str:
    t = c.trajectory
    if t is None:
        both = c.a.trajectory is not None and c.b.trajectory is not None
        return (
            f"trajectories: {quantity(c.common_poses, 'pose')} at common times, too few"
            if both
            else "trajectories: not of both"
        )
    return (
        f"trajectories over {t.frames_compared} common frames: RMSE {100 * t.ate_rmse_m:.2f} cm, max "
        f"{100 * t.ate_max_m:.2f} cm (aligned), raw {100 * t.ate_raw_rmse_m:.2f} cm; RPE {100 * t.rpe_trans_m:.2f} cm, "
        f"{t.rpe_rot_deg:.3f} deg"
    )


_METRICS = [
    ("PSNR held out, dB", ("images", "held_out", "psnr"), 1.0, ".2f"),
    ("SSIM held out", ("images", "held_out", "ssim"), 1.0, ".3f"),
    ("LPIPS held out", ("images", "held_out", "lpips"), 1.0, ".3f"),
    ("depth L1 held out, cm", ("images", "held_out", "depth_l1_m"), 100.0, ".2f"),
    ("ATE RMSE, cm", ("trajectory", "ate_rmse_m"), 100.0, ".2f"),
    ("mIoU held out, %", ("segmentation", "held_out", "miou"), 100.0, ".1f"),
    ("Gaussians", ("map", "gaussians"), 1.0, ".0f"),
    ("frames/s", ("speed", "frames_per_s"), 1.0, ".1f"),
    ("peak memory, MB", ("memory", "peak_rss_mb"), 1.0, ".0f"),
]  # fmt: skip


def _metric_rows(a: MetricsRecord | None, b: MetricsRecord | None) -> list[list[str]]:
    """Scores that at least one side has."""
    rows = []
    for name, keys, factor, form in _METRICS:
        values = [None if side is None else side.number(*keys) for side in (a, b)]
        if any(value is not None for value in values):
            rows.append([name, *("-" if v is None else format(factor * v, form) for v in values)])
    return rows
