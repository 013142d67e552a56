# SPDX-License-Identifier: Apache-2.0
"""What `ggslam volumes` does, usable from Python: frames with poses in; volumes, files and pictures out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.driving.body import Body
from ggslam.driving.body_options import read_body
from ggslam.driving.inflation import parse_inflation
from ggslam.errors import ConfigError, RunFolderError, SequenceError
from ggslam.formats.mesh_files import check_mesh_path
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.jobs.volumes.frames import FrameSource, PosedFrame, body_of, frames_of_recording, frames_of_run
from ggslam.jobs.volumes.fused import Fused, fuse_source, level_occupancy
from ggslam.jobs.volumes.live import LiveVolumes
from ggslam.jobs.volumes.memory import cells_on_disk, lines_of_cells
from ggslam.jobs.volumes.outputs import RECORD, OutputRequest, Outputs, Surface, prepare_folder, write_outputs
from ggslam.jobs.volumes.point_rates import PointRates
from ggslam.jobs.volumes.robot_maps import parse_robots
from ggslam.jobs.volumes.scans import ScanSource, scans_of_recording
from ggslam.localization.scans import refuse_unread_scans, scan_files
from ggslam.runs.folder import MARKER, RunFolder
from ggslam.runs.output_files import lies_among
from ggslam.runs.recordings import SequenceRequest
from ggslam.slam.config import Config, config_to_dict, load_config, settings_notes
from ggslam.system.atomic import make_folder
from ggslam.system.interrupts import delay_interrupts
from ggslam.system.opencv import opencv_errors
from ggslam.volumes.maps import VolumeMaps, VolumeTimesTuning
from ggslam.volumes.output_frame import OutputFrame, output_frame
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf_file import load_tsdf
from ggslam.volumes.volume_settings import VolumeSettings


@dataclass(frozen=True)
class VolumesRequest:
    """A request for volumes of a run or a recording.

    Attributes:
        source: folder of a run or a recording.
        sequence: how to read a recording.
        scale: of the images of a run's recording; None: as the run did.
        recording: where a run's recording is now, if it was moved.
        poses: trajectory file of a recording; None: its own poses.
        columns: numbers of a point in .bin scans; None: as they tell themselves.
        out: folder of the results; None: `RUN/volumes`, or `volumes/NAME` of a recording.
        voxel: of the TSDF, metres; None: as the settings say; where they say nothing, as goes with the scene's size.
        esdf: whether a distance field is wanted.
        occupancy: voxel of the occupancy map in metres; None: none is wanted.
        mesh: file of the mesh; None: mesh.ply in `out`.
        object_meshes: whether each object gets a mesh of its own.
        objects: whether object ids are voted for.
        live: track the recording and fuse its frames on the way; `out` is the folder of the run.
        realtime: with `live`, frames a second.
        onto: file of a TSDF to go on in.
        slice_height: metres above the floor of the slice through the distance field; None: as high as the camera was.
        band: lowest and highest obstacle of the ROS map, metres above the floor.
        robots: that get maps of their own, see `driving.robot.parse_robot`.
        inflation: how costs fall off in their costmaps, see `driving.inflation.parse_inflation`.
        body: of the robot in view, see `driving.body_options.read_body`.
        body_frame: the camera's link in a URDF file.
        frame: of meshes and occupancy: "map", or "floor" (z up, 0 on the floor); see `volumes.floor_frame`.
        latency: whether it is to be known how long all maps take with a frame.
        device: of torch, for the TSDF, e.g. cuda; None: the compiled core.
        config, overrides: settings, as for a run; for volumes their part `volumes` counts.
        overwrite: with `live`, replace an earlier run.
    """

    source: Path
    sequence: SequenceRequest
    scale: float | None = None
    recording: Path | None = None
    poses: Path | None = None
    columns: int | None = None
    out: Path | None = None
    voxel: float | None = None
    esdf: bool = False
    occupancy: float | None = None
    mesh: Path | None = None
    object_meshes: bool = False
    objects: bool = True
    live: bool = False
    realtime: float | None = None
    onto: Path | None = None
    slice_height: float | None = None
    band: tuple[float, float] = (0.1, 1.5)
    robots: tuple[str, ...] = ()
    inflation: str = "0.55,10"
    body: tuple[str, ...] = ()
    body_frame: str | None = None
    frame: str = "map"
    latency: bool = False
    device: str | None = None
    config: str | None = None
    overrides: list[str] = field(default_factory=list)
    overwrite: bool = False


@dataclass
class VolumesOutcome:
    """Result of making volumes.

    Attributes:
        out: folder of the results.
        files: that were written.
        lines: facts for people.
        times: milliseconds a `unit`, see `VolumeTimes.summary`.
        window: frames that a mean of `by_window_ms` is over.
        map_latency_s: 95 % of the frames were in all maps after this many seconds.
        depth_range_m: 95 % of the depth was nearer.
        error: why fusing stopped early, if it did.
        unit: of the times: "frame", or "instant" of a rig.
    """

    out: Path
    files: list[Path]
    lines: list[str]
    times: dict[str, dict[str, Any]]
    window: int
    map_latency_s: float
    depth_range_m: float
    error: BaseException | None = None
    unit: str = "frame"


@opencv_errors("volumes")
def make_volumes(request: VolumesRequest, observer: Observer | None = None) -> VolumesOutcome:
    """Makes volumes of a run or a recording. If it stops in the middle (damaged frame, interrupt), what was fused is
    written all the same and the outcome carries the error.

    Raises:
        GgslamError: nothing could be done at all: settings, source or output folder at fault.
    """
    observer = observer or SilentObserver()
    is_run = (request.source / MARKER).is_file()
    _check(request, is_run)
    body, config = read_body(request.body, request.body_frame), _config(request)
    _check_memory(request, config)
    for note in [] if request.live else settings_notes(_without_options(config), request.config, request.overrides):
        observer.note(note)  # a live run tells of them itself
    onto = None if request.onto is None else load_tsdf(request.onto)
    if onto is not None:
        _check_same_fusion(request.overrides, config.volumes.tsdf, onto.settings)
    maps = VolumeMaps(_set_pace(config.volumes, request), request.esdf, request.occupancy, onto, request.device)
    source = None if request.live else _source(request, is_run, body)
    out = None if request.live else _folder(request, is_run)
    with cells_on_disk(config, out) as maps.paging:
        if source is None or out is None:
            fused = _live(request, maps, body, observer)
            out = Path(fused.name) / "volumes"
            make_folder(out)
            prepare_folder(out)
        else:
            for note in [*source.warnings, *source.notes]:
                observer.note(note)
            fused = fuse_source(source, maps, observer, request.voxel is None)
        if not fused.poses:
            raise fused.error or SequenceError(f"{request.source}: no frame could be fused")
        with delay_interrupts():
            outputs = _write(request, config, fused, source, out, observer)
    return _outcome(out, fused, outputs)


def _write(
    request: VolumesRequest, config: Config, fused: Fused, source: FrameSource | ScanSource | None, out: Path,
    observer: Observer,
) -> Outputs:  # fmt: skip
    """Brings all maps up to date and writes them."""
    maps = fused.maps
    maps.finish()
    if not maps.block_counts()[0] or (request.onto is None and not fused.depth_ranges):  # free space alone has no floor
        limits, but = maps.settings.tsdf, " that `body` leaves" if request.body else ""
        raise SequenceError(
            f"{request.source}: no depth from {limits.min_depth:g} to {limits.max_depth:g} m in any frame{but}"
        )
    surface, frame = Surface.of(maps, fused.poses), output_frame(request.frame)
    if frame is OutputFrame.floor and source is not None:
        level_occupancy(maps, source, len(fused.poses), surface.T_floor_map, observer)
    wanted = OutputRequest(
        request.mesh, request.object_meshes, request.slice_height, request.band, fused.names, frame,
        parse_robots(request.robots), parse_inflation(request.inflation),
    )  # fmt: skip
    return write_outputs(maps, surface, out, wanted, _record(request, config, fused), observer)


def _config(request: VolumesRequest) -> Config:
    config = load_config(request.config, request.overrides)
    if request.voxel is None:
        return config
    if request.onto is not None:
        raise ConfigError("`voxel`: with `onto` the voxels are those of the file")
    tsdf = replace(config.volumes.tsdf, voxel=request.voxel)
    return replace(config, volumes=replace(config.volumes, tsdf=tsdf))


def _check_same_fusion(overrides: Sequence[str], asked: TsdfSettings, of_file: TsdfSettings) -> None:
    """Raises ConfigError for a setting of the fusion that was given and is not the file's, which counts."""
    for text in overrides:
        setting = text.partition("=")[0]
        name = setting.removeprefix("volumes.tsdf.")
        if name != setting and getattr(asked, name, None) != getattr(of_file, name, None):
            raise ConfigError(f"{setting}: with `onto` depth is fused as in the file, {getattr(of_file, name)}")


def _without_options(config: Config) -> Config:
    """The settings but those that `ggslam volumes` has options for, which are nothing to be warned of."""
    plain = type(config.volumes)()
    own = {name: getattr(plain, name) for name in ("min_weight", "budget_ms")}
    return replace(config, volumes=replace(config.volumes, **own))


def _set_pace(settings: VolumeSettings, request: VolumesRequest) -> VolumeSettings:
    """The settings with the pace of the distance field."""
    with_each = (request.live or request.latency) and settings.esdf_every == 0
    return replace(settings, esdf_every=1) if with_each else settings


def _check(request: VolumesRequest, is_run: bool) -> None:
    """Raises GgslamError for wishes that do not go together."""
    if request.live and is_run:
        raise ConfigError(f"`live` tracks a recording, and {request.source} is a run: leave `live` out")
    if request.live and request.onto is not None:
        raise ConfigError("`onto` needs poses in the frame of that file: of a run or recording, not of `live`")
    if output_frame(request.frame) is OutputFrame.floor and request.live and request.occupancy is not None:
        raise ConfigError(
            "`frame` floor: with `live` the floor is known after the last frame, too late for `occupancy`; make the "
            "volumes of the run afterwards"
        )
    if request.realtime is not None and not request.live:
        raise ConfigError("`realtime` needs `live`")
    if request.overwrite and not request.live:
        raise ConfigError("`overwrite` is for the run that `live` makes; volumes are replaced without it")
    if request.latency and request.device is not None and request.esdf:
        raise ConfigError("`latency`: with `device` nobody waits for the distance field, so its latency is not known")
    if request.occupancy is not None and not 1e-3 <= request.occupancy <= 10:
        raise ConfigError(f"`occupancy`: expected a voxel of 0.001 to 10 m, found {request.occupancy:g}")
    if request.slice_height is not None:
        if not request.esdf:
            raise ConfigError("`slice_height` needs `esdf`")
        if not abs(request.slice_height) < 1e4:
            raise ConfigError(f"`slice_height`: expected a height in metres, found {request.slice_height:g}")
    parse_inflation(request.inflation)
    if parse_robots(request.robots) and not request.esdf:
        raise ConfigError("`robot` needs `esdf`")
    if request.recording is not None and not is_run:
        raise ConfigError(f"`recording` says where the recording of a run is; {request.source} is no run")
    if is_run and request.sequence != SequenceRequest(request.source, scale=request.sequence.scale):
        raise ConfigError(
            f"{request.source} is a run, read as it was made: `start`, `stop`, `stride`, `format`, `depth_scale`, "
            "`pose_convention`, `camera`, `intrinsics`, `depth_camera`, `depth_kind`, `depth_delay`, `upright` and "
            "`on_bad_frame` are for recordings"
        )
    if request.poses is not None and (is_run or request.live):
        raise ConfigError("`poses` is for recordings whose poses are known, not for runs or `live`")
    if request.mesh is not None:
        _check_mesh(request.mesh, request.source)


def _check_memory(request: VolumesRequest, config: Config) -> None:
    limited = config.memory_limit_mb or config.volumes.budget_mb
    if limited and (request.onto is not None or request.device is not None):
        raise ConfigError("memory_limit_mb and volumes.budget_mb go neither with `onto` nor with `device`")


def _check_mesh(path: Path, source: Path) -> None:
    check_mesh_path(path)
    if path.exists() and lies_among(path, [source]) and path.parent.name != "volumes":
        raise ConfigError(f"`mesh` {path}: is a file of a run or recording; choose another name")
    make_folder(path.parent)
    RunFolder(path.parent).check_writable()


def _folder(request: VolumesRequest, is_run: bool) -> Path:
    """The folder of the results, made or already ours."""
    if request.out is not None:
        out = request.out
    else:
        out = request.source / "volumes" if is_run else Path("volumes") / request.source.resolve().name
    if out.is_dir() and any(out.iterdir()) and not (out / RECORD).is_file():
        raise RunFolderError(f"{out}: not empty and not made by `ggslam volumes`; choose another folder with `out`")
    make_folder(out)
    prepare_folder(out)
    return out


def _source(request: VolumesRequest, is_run: bool, body: Body | None) -> FrameSource | ScanSource:
    if not is_run and scan_files(request.source):
        return replace(scans_of_recording(request.sequence, request.poses, request.columns), body=body)
    if is_run:
        source = frames_of_run(RunFolder.open(request.source), request.recording, request.scale, request.objects)
    else:
        refuse_unread_scans(request.source)
        source = frames_of_recording(request.sequence, request.objects, request.poses)
    return replace(source, body=body_of(body, source.sequence))


def _live(request: VolumesRequest, maps: VolumeMaps, body: Body | None, observer: Observer) -> Fused:
    """Tracks the recording into a run folder and fuses on the way."""
    fused = Fused(maps, str(request.source))
    follower = LiveVolumes(
        maps, lambda frame, T: fused.saw(PosedFrame(frame, T)), request.objects, request.voxel is None, body,
        lambda slam, frame: slam.movers.pixels.without(frame),
    )  # fmt: skip
    pace = [] if request.realtime is None else [f"realtime_fps={request.realtime}"]
    run = RunRequest(
        request.sequence, request.out, request.config, [*request.overrides, *pace], evaluate=False,
        overwrite=request.overwrite,
    )  # fmt: skip
    outcome = execute(run, observer, follower)
    fused.name, fused.error = str(outcome.folder.path), outcome.error
    if follower.follow_parts(outcome.result):  # of which some lay at arbitrary places
        fused.poses = [T for T in outcome.result.trajectory() if np.isfinite(T).all()]
    if outcome.folder.has_objects():
        objects = outcome.folder.object_table()
        follower.settle(objects.ids())
        fused.names = {o.id: o.name for o in objects.objects if o.name}
    observer.note(f"{outcome.folder.path}: {outcome.headline()}")
    return fused


def _record(request: VolumesRequest, config: Config, fused: Fused) -> dict[str, Any]:
    """What volumes.json says of where the volumes come from."""
    return {
        "source": fused.name, "live": request.live, "frames": len(fused.poses), "onto": request.onto,
        "settings": config_to_dict(replace(config, volumes=fused.maps.settings))["volumes"],
        "times": fused.maps.times.summary(), "points": PointRates.of(fused.maps).to_dict(),
        "frames_a_window": VolumeTimesTuning.window,
        "blocks_by_window": fused.maps.times.blocks[VolumeTimesTuning.window - 1 :: VolumeTimesTuning.window],
        "rebuilds_s": fused.maps.times.rebuilds,
        "stopped_by": None if fused.error is None else repr(fused.error),
    }  # fmt: skip


def _outcome(out: Path, fused: Fused, outputs: Outputs) -> VolumesOutcome:
    times, lines = fused.maps.times, [PointRates.of(fused.maps).line(), *lines_of_cells(fused.maps), *outputs.lines]
    return VolumesOutcome(
        out, outputs.files, lines, times.summary(), VolumeTimesTuning.window, fused.latency(),
        float(np.median(fused.depth_ranges)) if fused.depth_ranges else 0.0, fused.error,
        "frame" if fused.instant is None else "instant",
    )  # fmt: skip
