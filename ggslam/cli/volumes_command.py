# SPDX-License-Identifier: Apache-2.0
"""`ggslam volumes`: TSDF, mesh, distance field and occupancy of a run or a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar, table
from ggslam.cli.observer import ProgressObserver
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity
from ggslam.volumes.output_frame import OutputFrame

if TYPE_CHECKING:
    from ggslam.jobs.volumes.fuse import VolumesOutcome, VolumesRequest
    from ggslam.volumes.safety import Braking

EPILOG = """
[bold]Examples[/]

  ggslam volumes runs/kitchen

  ggslam volumes runs/kitchen --voxel 0.04 --esdf --occupancy 0.08 --mesh kitchen.ply --driving

  ggslam volumes data/livingroom --esdf --slice 0.5        (poses of the recording itself)

  ggslam volumes runs/kitchen --esdf --robot 0.4,0.18 --robot tall:1.2,0.3      (a map and a costmap for each)

  ggslam volumes data/redkitchen --scale 0.5 --live --esdf      (tracked and fused frame by frame)

  ggslam volumes scans/walk --poses localized/walk/trajectory.txt --occupancy 0.2      (laser scans)

  ggslam volumes house.grid --esdf --workers 4      (a grid store, cell by cell)
"""

SourcePath = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="Folder that `ggslam run` wrote, of a recording or of laser scans, or a grid store made of runs; with "
        "--live also a camera, named as for `ggslam run`.",
    ),
]


Out = Annotated[
    Path | None,
    typer.Option(help="Folder for the results; default RUN/volumes, STORE/volumes, or volumes/NAME of a recording."),
]
Voxel = Annotated[
    float | None,
    typer.Option(help="Edge of the TSDF's voxels, metres (default 0.02, larger in large scenes).", min=0.001, max=1),
]
Esdf = Annotated[bool, typer.Option("--esdf", help="Also make a distance field, with a slice and a ROS map.")]
Occupancy = Annotated[
    float | None,
    typer.Option(metavar="VOXEL", help="Also make an occupancy map (.bt, .ot) with voxels of this edge, metres."),
]
MinWeight = Annotated[
    float | None,
    typer.Option(min=0, max=1000, help="Least weight of voxels that the mesh is made of, in looks from 1 m; default: "
                 "half a look from the farthest depth fused (0.01 at 7 m). More leaves out what was hardly seen."),
]  # fmt: skip
BudgetMs = Annotated[
    float | None,
    typer.Option(min=1, max=1e6, help="With --esdf: milliseconds a frame may take for TSDF and distance field; what is "
                 "far from the camera waits for a later frame. Default: as long as it takes."),
]  # fmt: skip
Mesh = Annotated[
    Path | None, typer.Option(help="Mesh file, .ply, .obj or .glb; default mesh.ply in the folder of the results.")
]
ObjectMeshes = Annotated[bool, typer.Option("--object-meshes", help="Also write a mesh of each object.")]
Objects = Annotated[bool, typer.Option("--objects/--no-objects", help="Vote for object ids (default: yes).")]
Live = Annotated[
    bool, typer.Option("--live", help="Track the recording as `ggslam run` does and fuse frames as they come.")
]
Realtime = Annotated[float | None, typer.Option(metavar="FPS", help="With --live: deliver frames at this rate.")]
Onto = Annotated[
    Path | None, typer.Option(metavar="TSDF", help="Add to this tsdf.npz; decay does not change what is in it.")
]
SliceHeight = Annotated[
    float | None,
    typer.Option("--slice", metavar="HEIGHT", help="Height of the slice through the distance field, metres above the "
                 "floor; default: where the camera was."),
]  # fmt: skip
Band = Annotated[
    str, typer.Option(metavar="LOW,HIGH", help="Heights, metres above the floor, between which the ROS map looks for "
                      "obstacles."),
]  # fmt: skip
Robots = Annotated[
    list[str] | None,
    typer.Option("--robot", metavar="[NAME:]HEIGHT,RADIUS", help="Robot, metres: with --esdf it gets a map of what it "
                 "meets (map_NAME.pgm) and a costmap (costmap_NAME.png), for map_server. A third number is the height "
                 "of the lowest obstacle (default 0.05). May be repeated."),
]  # fmt: skip
Inflation = Annotated[
    str, typer.Option("--inflation", metavar="RADIUS,FACTOR", help="With --robot: inflation_radius (m) and "
                      "cost_scaling_factor of nav2's inflation layer."),
]  # fmt: skip
Frame = Annotated[
    OutputFrame,
    typer.Option(help="Frame of meshes and occupancy: map, that of the run; floor: z up, z = 0 on the floor, in which "
                 "the ROS map is in any case. floor.yaml tells where the one is in the other."),
]  # fmt: skip
Poses = Annotated[
    Path | None, typer.Option(help="Trajectory file of a recording or of laser scans, instead of its own poses.")
]
Driving = Annotated[bool, typer.Option("--driving", help="Print how fast a robot may drive with these maps.")]
Speeds = Annotated[str, typer.Option(help="With --driving: speeds to list, m/s.")]
Friction = Annotated[float, typer.Option(min=0.01, max=2, help="With --driving: friction between wheels and ground.")]
SensorMs = Annotated[float, typer.Option(min=0, max=60_000, help="With --driving: delay of the sensor, ms.")]
PlanMs = Annotated[float, typer.Option(min=0, max=60_000, help="With --driving: time that the planner takes, ms.")]
NetworkMs = Annotated[float, typer.Option(min=0, max=60_000, help="With --driving: time between machines, ms.")]
FrameMs = Annotated[
    float,
    typer.Option(min=0, max=60_000, help="With --driving: time from one frame of the sensor to the next, ms."),
]
ControlMs = Annotated[
    float, typer.Option(min=0, max=60_000, help="With --driving: time between commands of the controller, ms.")
]
Scale = Annotated[
    float | None, typer.Option(help="Resize the images by this factor; default: as the run did, or not at all.")
]
Device = Annotated[
    str | None, typer.Option(help="Torch device to fuse the TSDF on, e.g. cuda; default: the compiled core.")
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="With --live: replace a finished run in the output folder.")
]


def volumes(
    source: SourcePath, out: Out = None,
    voxel: Voxel = None, esdf: Esdf = False, budget_ms: BudgetMs = None, occupancy: Occupancy = None,
    mesh: Mesh = None, min_weight: MinWeight = None, object_meshes: ObjectMeshes = False, objects: Objects = True,
    live: Live = False, realtime: Realtime = None,
    onto: Onto = None,
    slice_height: SliceHeight = None, band: Band = "0.1,1.5", robot: Robots = None, inflation: Inflation = "0.55,10",
    body: options.Body = None, body_frame: options.BodyFrame = None,
    frame: Frame = OutputFrame.map,
    driving: Driving = False, speeds: Speeds = "0.5,1,2,4", friction: Friction = 0.5,
    sensor_ms: SensorMs = 33.0, plan_ms: PlanMs = 50.0, network_ms: NetworkMs = 0.0,
    frame_ms: FrameMs = 33.3, control_ms: ControlMs = 50.0,
    config: options.ConfigName = None, settings: options.Settings = None,
    start: options.Start = 0, stop: options.Stop = None, stride: options.Stride = 1, scale: Scale = None,
    format_name: options.Format = None, depth_scale: options.DepthScale = None,
    pose_convention: options.PoseConvention = None,
    camera: options.OwnCamera = None, intrinsics: options.Intrinsics = None,
    depth_camera: options.DepthCamera = None,
    depth_kind: options.DepthKind = None, depth_delay: options.DepthDelay = None, upright: options.Upright = False,
    sequence: options.MovedSequence = None, poses: Poses = None, columns: options.Columns = None,
    skip_bad_frames: options.SkipBadFrames = False,
    device: Device = None, overwrite: Overwrite = False,
    engine: options.CellEngine = options.EngineName.local,
    workers: options.CellWorkers = None, address: options.CellAddress = None,
) -> None:  # fmt: skip
    """Make maps that planners read, each with a picture: TSDF with mesh, distance field, occupancy."""
    from ggslam.jobs.volumes.fuse import VolumesRequest
    from ggslam.runs.recordings import LiveRequest, SequenceRequest
    from ggslam.sequences.live import is_live

    reading = (LiveRequest if live and is_live(source) else SequenceRequest)(
        source, format=format_name, start=start, stop=stop, stride=stride, scale=scale,
        depth_scale=depth_scale, on_bad_frame="skip" if skip_bad_frames else "error", pose_convention=pose_convention,
        camera=camera, intrinsics=intrinsics, depth_camera=depth_camera, depth_kind=depth_kind,
        depth_delay=depth_delay, upright=upright,
    )  # fmt: skip
    request = VolumesRequest(
        source=source, sequence=reading, scale=scale, recording=sequence, poses=poses, columns=columns, out=out,
        voxel=voxel, esdf=esdf, occupancy=occupancy, mesh=mesh, object_meshes=object_meshes, objects=objects, live=live,
        realtime=realtime, onto=onto, slice_height=slice_height, band=_band(band), robots=tuple(robot or ()),
        inflation=inflation, body=tuple(body or ()), body_frame=body_frame, frame=frame.value, latency=driving,
        device=device, config=config, overwrite=overwrite,
        overrides=_overrides(settings, esdf, min_weight=min_weight, budget_ms=budget_ms),
    )  # fmt: skip
    braking = _make_braking(sensor_ms, plan_ms, network_ms, frame_ms, control_ms, friction)
    _make_of_source(request, _Cells(engine, workers, address), _speeds(speeds), braking)


class _Cells(NamedTuple):
    """Where the cells of a grid store are made."""

    engine: options.EngineName
    workers: int | None
    address: str | None


def _make_of_source(request: VolumesRequest, cells: _Cells, speeds: list[float], braking: Braking) -> None:
    """Makes the volumes of a grid store, or of a run or recording, and prints what came of it."""
    from ggslam.jobs.submaps.stores import is_store

    if is_store(request.source):
        return _make_of_store(request, cells)
    if cells != _Cells(options.EngineName.local, None, None):
        raise ConfigError("--engine, --workers and --address are for grid stores, and this is none")
    return _make_and_show(request, speeds, braking)


def _overrides(settings: list[str] | None, esdf: bool, **given: float | None) -> list[str]:
    """The settings, and those of volumes that have options of their own."""
    if given["budget_ms"] is not None and not esdf:
        raise ConfigError("--budget-ms needs --esdf")
    return [*(settings or []), *(f"volumes.{name}={value}" for name, value in given.items() if value is not None)]


def _make_braking(
    sensor_ms: float, plan_ms: float, network_ms: float, frame_ms: float, control_ms: float, friction: float
) -> Braking:
    """A robot in places that the map has seen free."""
    from ggslam.volumes.safety import FRAMES_UNTIL_OCCUPIED, Braking, Latencies

    latencies = Latencies(
        sensor_ms / 1e3, 0.0, plan_ms / 1e3, network_ms / 1e3, frame_ms / 1e3, FRAMES_UNTIL_OCCUPIED, control_ms / 1e3
    )
    return Braking(latencies, friction)


def _make_of_store(request: VolumesRequest, cells: _Cells) -> None:
    """Makes the volumes of a store and prints what came of it."""
    from dataclasses import replace

    from ggslam.jobs.tasks.engines import Engine
    from ggslam.jobs.volumes.fuse import VolumesRequest
    from ggslam.jobs.volumes.store_volumes import make_store_volumes
    from ggslam.slam.config import load_config

    plain = VolumesRequest(
        request.source, request.sequence, out=request.out, voxel=request.voxel, esdf=request.esdf,
        objects=request.objects, config=request.config, overrides=request.overrides,
    )  # fmt: skip
    if request != plain or request.sequence != type(request.sequence)(request.source):
        chosen = "--out, --voxel, --esdf, --min-weight, --config, --set"
        raise ConfigError(f"of a grid store {chosen} and the workers can be chosen")
    if cells.address is not None and cells.engine is not options.EngineName.ray:
        raise ConfigError("--address is for --engine ray")
    settings = load_config(request.config, request.overrides).volumes
    if request.voxel is not None:
        settings = replace(settings, tsdf=replace(settings.tsdf, voxel=request.voxel))
    where = Engine(cells.engine.value, cells.workers, cells.address)
    with progress_bar() as bar:
        outcome = make_store_volumes(
            request.source, request.out, settings=settings, esdf=request.esdf, engine=where,
            observer=ProgressObserver(bar),
        )  # fmt: skip
    took = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.seconds.items())
    for line in (
        f"{quantity(outcome.cells, 'cell')}, {quantity(outcome.blocks, 'block')} of 8^3 voxels, "
        f"{quantity(outcome.triangles, 'triangle')} ({took})",
        f"wrote {outcome.out}", *(f"not made: {line}" for line in outcome.failures.values()),
    ):  # fmt: skip
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if outcome.failures:  # of the store: those of ggslam or the machine are raised
        raise typer.Exit(2)


def _make_and_show(request: VolumesRequest, speeds: list[float], braking: Braking) -> None:
    """Makes the maps and prints times, files and, where it was asked for, how fast a robot may drive."""
    from ggslam.jobs.volumes.fuse import make_volumes

    with progress_bar() as bar:
        outcome = make_volumes(request, ProgressObserver(bar))
    _print(outcome)
    if request.latency:
        _print_safety(outcome, braking, speeds)
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


def _speeds(text: str) -> list[float]:
    values = _numbers("--speeds", text)
    if min(values) < 0:
        raise ConfigError(f'--speeds: expected numbers of 0 and more like "0.5,1,2", found {text!r}')
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
    unit = f"{'an' if outcome.unit == 'instant' else 'a'} {outcome.unit}"
    console.print(table(f"ms {unit}", ["", "mean", "95 %", "largest", f"by {outcome.window} {outcome.unit}s"], rows))
    for line in outcome.lines:  # a command in them is copied whole
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(f"wrote {quantity(len(outcome.files), 'file')} to {outcome.out}", highlight=False, markup=False)


def _print_safety(outcome: VolumesOutcome, braking: Braking, speeds: list[float]) -> None:
    from dataclasses import replace

    latencies = replace(braking.latencies, map=outcome.map_latency_s)
    posed = "" if "slam" in outcome.times else " with its pose"
    braking = replace(braking, latencies=latencies)
    console.print(
        f"the maps know of a frame {1e3 * latencies.map:.1f} ms after it came{posed} (95 % of the frames); with sensor "
        f"{1e3 * latencies.sensor:g}, plan {1e3 * latencies.plan:g}, network {1e3 * latencies.network:g} ms, and at "
        f"worst {1e3 * latencies.wait:.0f} ms until {latencies.frames} frames show an obstacle and the controller "
        f"has its turn, a robot is blind for {1e3 * latencies.total:.0f} ms", highlight=False
    )  # fmt: skip
    rows = [[f"{v:g} m/s", f"{braking.blind_distance(v):.2f} m", f"{braking.stopping_distance(v):.2f} m"]
            for v in speeds]  # fmt: skip
    console.print(table(f"driving, friction {braking.friction:g}", ["speed", "blind", "stopping distance"], rows))
    far = outcome.depth_range_m
    console.print(
        f"seeing {far:.1f} m far (95 % of the depth), it stops in time up to {braking.largest_speed(far):.1f} m/s, if "
        "it keeps a voxel away from what the map has", highlight=False,
    )  # fmt: skip
