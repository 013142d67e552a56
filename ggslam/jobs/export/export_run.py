# SPDX-License-Identifier: Apache-2.0
"""A run in the form that other programs take, in one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.formats.table import choose_writer, names_of, writers
from ggslam.formats.writer import Takes, Writer
from ggslam.jobs.export.map_files import export_objects, points_to_export
from ggslam.jobs.export.map_rotation import upward_turn
from ggslam.jobs.export.meshes import MeshRequest, export_mesh
from ggslam.jobs.export.movers import export_movers
from ggslam.jobs.export.splats import SplatRequest, in_turn, splats_of, splats_of_store
from ggslam.jobs.export.views import posed_views
from ggslam.jobs.progress import Observer
from ggslam.jobs.submaps.stores import is_store
from ggslam.rendering.zoom import ZoomFit
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import open_map
from ggslam.system.atomic import make_folder
from ggslam.system.folder_lock import output_lock
from ggslam.volumes.output_frame import OutputFrame, output_frame

_GAUSSIANS = (Takes.GAUSSIANS, Takes.OBJECT_COLORS)
_OF_A_RUN = (Takes.VIEWS, Takes.MESH, Takes.TRAJECTORY)
"""What needs poses and a recording."""


def export_run(
    run: str | Path | RunFolder,
    out: str | Path,
    format: str | None = None,
    *,
    voxel: float | None = None,
    objects: str | None = None,
    movers: bool = False,
    min_opacity: float = 0.0,
    plain: bool = False,
    discs: bool = False,
    keyframes: bool = False,
    recording: str | Path | None = None,
    rendered: bool = False,
    zoom: float = 1.0,
    frame: str = "map",
    up: str | None = None,
    observer: Observer | None = None,
) -> str:
    """Writes a run in a form that other programs take, as `ggslam export` does; returns a line that says what was
    written. Two that write to one place wait for one another.

    Args:
        run: the run, or its folder; a file of Gaussians, see `runs.map_file.open_map`; for streamed-sog also the folder
            of a grid store.
        out: file or, for points, colmap, nerfstudio and for several objects with ply, folder to write.
        format: name of one in `formats.table`, as `ggslam export --help` lists them; None: what the name of `out` says.
        voxel: metres: distance of points (default 0.01), or the edge of a mesh's voxels (default: as the run's
            settings say); both defaults are larger in scenes larger than rooms.
        objects: names or ids, "mug,7", or "all", for ply, segmented, mesh, sog, streamed-sog, gltf, usd: only these.
        movers: instead of the map, the points of each thing that moved, as a PLY file for each in the folder `out`.
        min_opacity: leave out fainter Gaussians (not of trajectory, mesh, colmap, nerfstudio; of points and pcd only
            with `discs`).
        discs: points, pcd: the discs of all Gaussians, seen by a keyframe or not, instead of the surface that the
            keyframes see.
        plain: ply, segmented, sog, streamed-sog, gltf, usd: only the fields of 3DGS.
        keyframes: colmap, nerfstudio: only keyframes and held-out frames.
        recording: where the recording is now, if it was moved (colmap, nerfstudio, mesh).
        rendered: mesh: from depth rendered from the map, even if the recording is there.
        zoom: formats of Gaussians: how many times larger than the training views they will be drawn (of a map trained
            at 320x240, 4 for a window of 1280x960; below 1: smaller). Makes up for what renderers, whose pixels stay
            the same, then widen them less or more: seen at that size they look as trained, at others softer or fainter.
        frame: mesh: "map", or "floor" (z up, 0 on the floor; floor.yaml beside it tells where that is in the map).
        up: formats of Gaussians: "y", "-y" or "z": turn the map so that this axis of the file points up, away from the
            map's floor. SPZ, glTF and OpenUSD have y upwards.
        observer: receives progress updates of meshes and streamed SOG.

    Raises:
        ConfigError: an unknown format or object, or arguments that do not go together.
        MissingDependency: a package is needed for this format.
        RunFolderError: no run, a damaged one, or nothing to write.
        SequenceError: the recording cannot be read.
    """
    place = Path(out)
    if movers:
        others = (format, voxel, objects, plain, discs, keyframes, recording, rendered, zoom, min_opacity, up)
        _refuse_beside_movers(place, *others, frame != "map")
        folder = _with_poses(run if isinstance(run, RunFolder) else open_map(run), "`movers`")
        with output_lock(place):
            return export_movers(folder, place)
    writer = choose_writer(format, place, objects)
    wanted = output_frame(frame)
    _refuse_ignored(writer, objects, keyframes, recording, rendered, zoom, wanted, up)
    _check_discs(writer, discs, min_opacity)
    if not isinstance(run, RunFolder) and is_store(Path(run)):
        if up is not None:
            raise ConfigError(f"{run}: is a grid store, whose cells are not turned: leave out `up`")
        return _export_store(Path(run), place, writer, objects, min_opacity, zoom, observer)
    folder = run if isinstance(run, RunFolder) else open_map(run)
    if writer.takes in _OF_A_RUN:
        _with_poses(folder, f"format {writer.name}")
    images = None if recording is None else Path(recording)
    fit = None if zoom == 1 else _fit_for(_with_poses(folder, "`zoom`"), zoom)
    turn = None if up is None else upward_turn(folder, up, writer)
    splats = SplatRequest(objects, min_opacity, plain, in_turn(fit, turn))
    mesh = MeshRequest(voxel, objects, rendered, images, wanted)
    wish = _Wish(writer, place, splats, mesh, voxel, discs, keyframes, images)
    with output_lock(place):
        said = _write(folder, wish, observer)
    return said if turn is None else f"{said}; {turn.text}"


@dataclass(frozen=True)
class _Wish:
    """Arguments of `export_run`; `points` is the distance of points."""

    writer: Writer
    place: Path
    splats: SplatRequest
    mesh: MeshRequest
    points: float | None
    discs: bool
    keyframes: bool
    images: Path | None


def _write(folder: RunFolder, wish: _Wish, observer: Observer | None) -> str:
    writer, place, splats = wish.writer, wish.place, wish.splats
    if writer.takes is Takes.MESH:
        return export_mesh(folder, place, wish.mesh, observer, writer)
    if writer.name == "ply" and splats.objects is not None:
        return export_objects(folder, place, splats.objects, splats.min_opacity, splats.plain, splats.prepare)
    writer.check_path(place)
    make_content: dict[Takes, Callable[[], object]] = {
        Takes.GAUSSIANS: lambda: splats_of(folder, writer, splats, observer),
        Takes.OBJECT_COLORS: lambda: splats_of(folder, writer, splats, observer),
        Takes.POINTS: lambda: points_to_export(folder, wish.points, wish.discs, splats.min_opacity),
        Takes.TRAJECTORY: folder.trajectory,
        Takes.VIEWS: lambda: posed_views(folder, wish.points, wish.keyframes, wish.images),
    }
    content = make_content[writer.takes]()
    make_folder(place.parent)
    return writer.write(place, content)


def _export_store(
    path: Path, out: Path, writer: Writer, objects: str | None, min_opacity: float, zoom: float,
    observer: Observer | None,
) -> str:  # fmt: skip
    if not writer.in_cells:
        able = names_of([known for known in writers() if known.in_cells])
        raise ConfigError(f"{path}: is a grid store, of which `format` {able} can be written, not {writer.name}")
    if zoom != 1:
        raise ConfigError(f"{path}: is a grid store, which has no keyframes: leave out `zoom`")
    if objects is not None:
        raise ConfigError(f"{path}: is a grid store, which has no table of objects: leave out `objects`")
    with output_lock(out), splats_of_store(path, min_opacity, observer) as splats:
        return writer.write(out, splats)


def _with_poses(folder: RunFolder, what: str) -> RunFolder:
    """The run itself; raises ConfigError for a map without poses and recording."""
    if not (folder.has_poses and folder.has_recording):
        raise ConfigError(f"{folder.path}: is a map without a run's poses and recording, which {what} needs")
    return folder


def _fit_for(folder: RunFolder, zoom: float) -> ZoomFit:
    record = folder.keyframes()
    poses, numbers = record.poses(), record.keyframe_numbers()
    chosen, recording = [i for i in sorted(poses) if i in numbers], folder.sequence()
    cameras = [recording.camera_of(i) for i in chosen]
    return ZoomFit(recording.camera, [poses[i] for i in chosen], zoom, cameras)


def _refuse_beside_movers(place: Path, *others: object) -> None:
    """Raises ConfigError for what says something of the map."""
    if any(value not in (None, False, 0.0, 1.0) for value in others):
        raise ConfigError("`movers` writes points of movers as they were seen: of other arguments it takes only `out`")
    if place.suffix:
        raise ConfigError(f"`out` {place}: `movers` writes a folder, with a file for each")


def _check_discs(writer: Writer, discs: bool, min_opacity: float) -> None:
    """Raises ConfigError for a choice of discs, or of their opacity, that has no effect."""
    if discs:
        _refuse_unless(writer, "discs", Takes.POINTS)
    elif writer.takes is Takes.POINTS and min_opacity > 0:
        raise ConfigError(f"`min_opacity` goes with `format` {writer.name} only with `discs`")


def _refuse_ignored(
    writer: Writer, objects: str | None, keyframes: bool, recording: str | Path | None, rendered: bool, zoom: float,
    frame: OutputFrame, up: str | None,
) -> None:  # fmt: skip
    """Raises ConfigError for an argument that this format leaves without effect."""
    if objects is not None and not writer.by_object:
        by_object = names_of([known for known in writers() if known.by_object])
        raise ConfigError(f"`objects` goes with `format` {by_object}, not {writer.name}")
    if keyframes:
        _refuse_unless(writer, "keyframes", Takes.VIEWS)
    if recording is not None:
        _refuse_unless(writer, "recording", Takes.VIEWS, Takes.MESH)
    if rendered:
        _refuse_unless(writer, "rendered", Takes.MESH)
    if frame is not OutputFrame.map:
        _refuse_unless(writer, "frame", Takes.MESH)
    for name, given in (("zoom", zoom != 1), ("up", up is not None)):
        if given and writer.takes not in _GAUSSIANS:
            raise ConfigError(f"`{name}` goes with formats of Gaussians, not {writer.name}")


def _refuse_unless(writer: Writer, argument: str, *takes: Takes) -> None:
    if writer.takes not in takes:
        able = names_of([known for known in writers() if known.takes in takes])
        raise ConfigError(f"`{argument}` goes with `format` {able}, not {writer.name}")
