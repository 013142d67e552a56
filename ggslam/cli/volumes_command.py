# SPDX-License-Identifier: Apache-2.0
"""`ggslam volumes`: TSDF, mesh, distance field and occupancy of a run or a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar, table
from ggslam.cli.observer import ProgressObserver
from ggslam.errors import ConfigError

if TYPE_CHECKING:
    from ggslam.jobs.volumes.fuse import VolumesOutcome
    from ggslam.volumes.safety import Braking

EPILOG = """
[bold]Examples[/]

  ggslam volumes runs/kitchen

  ggslam volumes runs/kitchen --voxel 0.04 --esdf --occupancy 0.08 --mesh kitchen.glb --report

  ggslam volumes data/livingroom --esdf --slice 0.5        (poses of the recording itself)

  ggslam volumes data/redkitchen --scale 0.5 --live --esdf      (tracked and fused frame by frame)
"""

SourcePath = Annotated[
    Path, typer.Argument(metavar="RUN_OR_SEQUENCE", help="Folder that `ggslam run` wrote, or folder of a recording.")
]


def volumes(
    source: SourcePath,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results; default RUN/volumes, or volumes/NAME of a recording.")
    ] = None,
    voxel: Annotated[float | None, typer.Option(help="Edge of the TSDF's voxels, metres (default 0.02).")] = None,
    esdf: Annotated[bool, typer.Option("--esdf", help="Distance field with slice and ROS map.")]
    = False,
    occupancy: Annotated[
        float | None, typer.Option(metavar="VOXEL", help="Occupancy map with voxels of this edge in metres: .bt, .ot.")
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="Mesh file, .ply, .obj or .glb; default mesh.ply in the folder of the results.")
    ] = None,
    object_meshes: Annotated[bool, typer.Option("--object-meshes", help="Also one mesh an object.")] = False,
    objects: Annotated[bool, typer.Option("--objects/--no-objects", help="Vote for object ids (default: yes).")] = True,
    live: Annotated[
        bool, typer.Option("--live", help="Track the recording as `ggslam run` does and fuse frames as they come.")
    ] = False,
    realtime: Annotated[
        float | None, typer.Option(metavar="FPS", help="With --live: frames arrive at this rate.")
    ] = None,
    onto: Annotated[
        Path | None, typer.Option(metavar="TSDF", help="Go on in this tsdf.npz; decay leaves what is in it alone.")
    ] = None,
    slice_height: Annotated[
        float | None, typer.Option("--slice", metavar="HEIGHT", help="Metres above the floor of the slice through the "
                                   "distance field; default: where the camera was.")
    ] = None,
    band: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Metres above the floor in which obstacles count in the ROS map.")
    ] = "0.1,1.5",
    report: Annotated[bool, typer.Option("--report", help="Print how fast a robot may drive with this map.")] = False,
    speeds: Annotated[str, typer.Option(help="With --report: m/s.")] = "0.5,1,2,4",
    friction: Annotated[float, typer.Option(help="With --report: between wheels and ground.")] = 0.5,
    sensor_ms: Annotated[float, typer.Option(help="With --report: delay of the sensor.")] = 33.0,
    plan_ms: Annotated[float, typer.Option(help="With --report: time that the planner takes.")] = 50.0,
    network_ms: Annotated[float, typer.Option(help="With --report: on the way between machines.")] = 0.0,
    config: Annotated[str | None, typer.Option(help="Preset name or YAML file with settings.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Override one setting (volumes.tsdf.max_depth=4); repeatable.")
    ] = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    scale: Annotated[
        float | None, typer.Option(help="Resize the images by this factor; default: as the run did, or not at all.")
    ] = None,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    pose_convention: options.PoseConvention = None,
    sequence: Annotated[Path | None, typer.Option(help="Where the recording of the run is now, if it was moved.")]
    = None,
    skip_bad_frames: Annotated[bool, typer.Option(help="Skip damaged frames instead of stopping at them.")] = False,
    device: Annotated[
        str | None, typer.Option(help="Torch device to fuse the TSDF on, e.g. cuda; default: the compiled core.")
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="With --live: replace a finished run in the output folder.")] = False,
) -> None:  # fmt: skip
    """Maps that planners read: TSDF with mesh, distance field, occupancy; each with a picture."""
    from ggslam.jobs.volumes.fuse import VolumesRequest, make_volumes
    from ggslam.runs.recordings import SequenceRequest
    from ggslam.volumes.safety import Braking, Latencies

    wanted_speeds = _numbers("--speeds", speeds)
    braking = Braking(Latencies(sensor_ms / 1e3, 0.0, plan_ms / 1e3, network_ms / 1e3), friction)
    request = VolumesRequest(
        source=source,
        sequence=SequenceRequest(
            source, format=format_name, start=start, stop=stop, stride=stride, scale=1.0 if scale is None else scale,
            depth_scale=depth_scale, on_bad_frame="skip" if skip_bad_frames else "error",
            pose_convention=pose_convention,
        ),
        scale=scale, recording=sequence, out=out, voxel=voxel, esdf=esdf, occupancy=occupancy, mesh=mesh,
        object_meshes=object_meshes, objects=objects, live=live, realtime=realtime, onto=onto,
        slice_height=slice_height, band=_band(band), latency=report, device=device, config=config,
        overrides=settings or [], overwrite=overwrite,
    )  # fmt: skip
    with progress_bar() as bar:
        outcome = make_volumes(request, ProgressObserver(bar))
    _print(outcome)
    if report:
        _print_safety(outcome, braking, wanted_speeds)
    if outcome.error is not None:
        raise outcome.error


def _numbers(option: str, text: str) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(abs(value) < 1e6 for value in values):
        raise ConfigError(f'{option}: expected numbers like "0.1,1.5", found {text!r}')
    return values


def _band(text: str) -> tuple[float, float]:
    values = _numbers("--band", text)
    if len(values) != 2 or values[0] >= values[1]:
        raise ConfigError(f'--band: expected two heights like "0.1,1.5", the lower first, found {text!r}')
    return values[0], values[1]


def _print(outcome: VolumesOutcome) -> None:
    rows = [
        [name, *(f"{part[key]:.1f}" for key in ("mean_ms", "p95_ms", "max_ms")),
         ", ".join(f"{ms:.1f}" for ms in part["by_window_ms"][:8])]
        for name, part in outcome.times.items()
    ]  # fmt: skip
    console.print(table("ms a frame", ["", "mean", "95 %", "largest", f"by {outcome.window} frames"], rows))
    for line in outcome.lines:
        console.print(line, highlight=False, markup=False)
    console.print(f"wrote {len(outcome.files)} files to {outcome.out}", highlight=False, markup=False)


def _print_safety(outcome: VolumesOutcome, braking: Braking, speeds: list[float]) -> None:
    from dataclasses import replace

    latencies = replace(braking.latencies, map=outcome.map_latency_s)
    posed = "" if "slam" in outcome.times else " with its pose"
    braking = replace(braking, latencies=latencies)
    console.print(
        f"the maps know of a frame {1e3 * latencies.map:.1f} ms after it came{posed} (95 % of the frames); with sensor "
        f"{1e3 * latencies.sensor:g}, plan {1e3 * latencies.plan:g}, network {1e3 * latencies.network:g} ms a robot is "
        f"blind for {1e3 * latencies.total:.0f} ms", highlight=False
    )  # fmt: skip
    rows = [[f"{v:g} m/s", f"{braking.blind_distance(v):.2f} m", f"{braking.stopping_distance(v):.2f} m"]
            for v in speeds]  # fmt: skip
    console.print(table(f"driving, friction {braking.friction:g}", ["speed", "blind", "stopping distance"], rows))
    far = outcome.depth_range_m
    console.print(
        f"seeing {far:.1f} m far (95 % of the depth), it stops in time up to {braking.largest_speed(far):.1f} m/s",
        highlight=False,
    )  # fmt: skip
