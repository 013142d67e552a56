# SPDX-License-Identifier: Apache-2.0
"""`ggslam localize`: find out where a recording was made, in a map of the place."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar, table
from ggslam.cli.observer import ProgressObserver
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.jobs.localize.report import LocalizationReport

EPILOG = """
[bold]Examples[/]

  ggslam localize runs/kitchen data/second_visit

  ggslam localize office.grid scans/tuesday --start-pose "12.5 3 1.3 0 0 0 1"

  ggslam localize campus.pcd scans/tuesday --near "120 -40 15"

  ggslam localize campus.grid scans/tuesday --radius auto

  ggslam localize campus.grid scans/tuesday --body -0.4,-0.3,-0.5,0.2,0.3,-0.1

  ggslam localize campus.pcd scans/tuesday --start-pose given --full-map --out localized/full

  ggslam localize campus.pcd scans/tuesday --start-pose given --set scans.search.reach=4 --set scans.scan.farthest=100
"""


class OtherWorldTuning(Tuning):
    """When true poses seem to be in another world."""

    max_ratio = 4.0
    """Largest RMSE over the RMSE after alignment."""


MapPath = Annotated[
    Path,
    typer.Argument(metavar="MAP", help="Folder of a grid store (`ggslam submaps`) or of a run, or a cloud: .ply, .pcd, "
                   ".npy, .bin."),
]  # fmt: skip
RecordingPath = Annotated[
    Path, typer.Argument(metavar="SEQUENCE", help="Folder of an RGB-D recording, or of laser scans (.bin, .npy, .pcd).")
]


StartPose = Annotated[
    str | None,
    typer.Option(metavar="POSE", help='Pose of the first frame: "x y z qx qy qz qw", sensor to map; or the word given: '
                 "the recording's own pose."),
]  # fmt: skip
NoStartPose = Annotated[
    bool,
    typer.Option("--no-start-pose", help="Search for the first frame or scan in the map (default)."),
]
Near = Annotated[
    str | None,
    typer.Option(metavar="PLACE", help='Roughly where the recording was made: "x y sigma" or "x y z sigma", metres in '
                 "the map. Only places within 3 sigma are searched."),
]  # fmt: skip
FullMap = Annotated[bool, typer.Option("--full-map", help="Align to the whole map, for comparison.")]
Out = Annotated[Path | None, typer.Option(help="Folder for the results; default localized/NAME.")]
Radius = Annotated[
    str | None,
    typer.Option(metavar="METRES|auto", help="R': align to cells whose centres are so near; auto: as far as each scan "
                 "or frame sees, less where the map is dense. Default: the map's, of a cloud what suits the scanner."),
]  # fmt: skip
Voxel = Annotated[
    float | None,
    typer.Option(help="Edge of the voxels to align to, metres; default 0.03, of scans 0.15.", min=1e-3, max=10),
]


def localize(
    map_path: MapPath,
    sequence: RecordingPath,
    start_pose: StartPose = None,
    no_start_pose: NoStartPose = False,
    near: Near = None,
    full_map: FullMap = False,
    out: Out = None,
    radius: Radius = None,
    voxel: Voxel = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    scale: options.Scale = None,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    pose_convention: options.PoseConvention = None,
    camera: options.OwnCamera = None,
    intrinsics: options.Intrinsics = None,
    depth_camera: options.DepthCamera = None,
    depth_kind: options.DepthKind = None,
    depth_delay: options.DepthDelay = None,
    upright: options.Upright = False,
    columns: options.Columns = None,
    body: options.Body = None, body_frame: options.BodyFrame = None,
    skip_bad_frames: options.SkipBadFrames = False,
    threads: options.Threads = None,
    settings: options.Settings = None,
) -> None:  # fmt: skip
    """Locate each frame or scan of a recording in a map, of which only the surroundings are in memory."""
    from ggslam.jobs.localize.locate import LocalizeRequest
    from ggslam.jobs.localize.locate import localize as locate_all
    from ggslam.runs.recordings import SequenceRequest

    request = LocalizeRequest(
        map=map_path,
        sequence=SequenceRequest(
            sequence, format=format_name, start=start, stop=stop, stride=stride, scale=scale, depth_scale=depth_scale,
            on_bad_frame="skip" if skip_bad_frames else "error", pose_convention=pose_convention,
            camera=camera, intrinsics=intrinsics, depth_camera=depth_camera, depth_kind=depth_kind,
            depth_delay=depth_delay, upright=upright,
        ),
        start_pose=start_pose, no_start_pose=no_start_pose, near=near, full=full_map, out=out, radius=radius,
        voxel=voxel, columns=columns, body=body or (), body_frame=body_frame, threads=threads, overrides=settings or [],
    )  # fmt: skip
    with progress_bar() as bar:
        report = locate_all(request, ProgressObserver(bar))
    _print(report)
    folder = out or Path("localized") / sequence.resolve().name
    console.print(f"wrote {folder}", highlight=False, markup=False)


def _print(report: LocalizationReport) -> None:
    s = report.summary()
    ms = s["localization_ms"]

    def centimetres(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:.2f} cm"

    rows = [
        ["localisation time, mean", f"{ms['mean']:.1f} ms"],
        ["localisation time, 95 %", f"{ms['p95']:.1f} ms"],
        ["of which reading the map, mean", f"{s['map_ms_mean']:.1f} ms"],
        ["points in the reference map, mean", f"{s['map_points_mean']:.0f}"],
        ["RMSE against the given poses", centimetres(s["rmse_m"])],
        ["RMSE after rigid alignment", centimetres(s["rmse_aligned_m"])],
        ["frames located", f"{100 * s['located_share']:.1f} % of {s['frames']}"],
    ]
    console.print(table("full map" if report.full else "partial map", ["", ""], rows))
    rmse, aligned = s["rmse_m"], s["rmse_aligned_m"]
    if rmse is not None and aligned is not None and rmse > OtherWorldTuning.max_ratio * aligned:
        console.print(
            "the given poses are not in the world of this map (of a run: its first camera), so the RMSE after rigid "
            "alignment is the one to read", highlight=False,
        )  # fmt: skip
    lost = {name: count for name, count in s["statuses"].items() if name not in ("ok", "degenerate")}
    if lost:
        console.print("frames " + ", ".join(f"{name}: {count}" for name, count in lost.items()), highlight=False)
    for problem in report.damaged:
        console.print(f"left out: {problem}", highlight=False, markup=False)
