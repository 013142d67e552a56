# SPDX-License-Identifier: Apache-2.0
"""A run in the form that other programs take, in one call."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.jobs.export.chosen import Prepare
from ggslam.jobs.export.formats import ExportFormat, choose_format
from ggslam.jobs.export.map_files import (
    export_objects,
    export_points,
    export_segmented,
    export_splats,
    export_trajectory,
)
from ggslam.jobs.export.meshes import MeshRequest, export_mesh
from ggslam.jobs.export.movers import export_movers
from ggslam.jobs.export.scenes import export_scene
from ggslam.jobs.export.splats import export_packed, export_pcd
from ggslam.jobs.export.streams import stream_run, stream_store
from ggslam.jobs.export.turning import upward_turn
from ggslam.jobs.export.views import export_colmap, export_nerfstudio
from ggslam.jobs.progress import Observer
from ggslam.jobs.submaps.stores import is_store
from ggslam.rendering.zoom import ZoomWidening
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import open_map
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.folder_lock import output_lock
from ggslam.volumes.output_frame import OutputFrame, output_frame

_SCENES = (ExportFormat.gltf, ExportFormat.sog, ExportFormat.usd)
_WITH_OBJECTS = (ExportFormat.ply, ExportFormat.segmented, ExportFormat.mesh, ExportFormat.streamed_sog, *_SCENES)
_WITH_VIEWS = (ExportFormat.colmap, ExportFormat.nerfstudio)
_WITHOUT_GAUSSIANS = (
    ExportFormat.mesh, ExportFormat.points, ExportFormat.pcd, ExportFormat.trajectory, *_WITH_VIEWS
)  # fmt: skip


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
        format: ply: 3DGS Gaussians; segmented: the same in the colours of their objects; compressed-ply, spz, spz4,
            splat, sog: the same in fewer bytes; streamed-sog: in pieces and levels of detail; gltf: .glb (a .glb
            without `format` is a mesh); usd: .usda, .usdc, .usdz; points, pcd: coloured clouds; mesh: .glb, .obj or
            .ply; trajectory: TUM; colmap, nerfstudio: images with poses and points. None: what the name of `out` says.
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
            at 320x240, 4 for a window of 1280x960). Widens them as far as renderers will then widen them less: seen at
            that size they are sharper and without seams, at the training views' size softer.
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
    kind = choose_format(None if format is None else _format_named(format), place, objects)
    wanted = output_frame(frame)
    _refuse_ignored(kind, objects, keyframes, recording, rendered, zoom, wanted, up)
    _check_discs(kind, discs, min_opacity)
    if not isinstance(run, RunFolder) and is_store(Path(run)):
        if up is not None:
            raise ConfigError(f"{run}: is a grid store, whose cells are not turned: leave out `up`")
        return _export_store(Path(run), place, kind, objects, min_opacity, zoom, observer)
    folder = run if isinstance(run, RunFolder) else open_map(run)
    if kind in (*_WITH_VIEWS, ExportFormat.mesh, ExportFormat.trajectory):
        _with_poses(folder, f"format {kind.value}")
    images = None if recording is None else Path(recording)
    widen = None if zoom == 1 else _widen_for(_with_poses(folder, "`zoom`"), zoom)
    turn = None if up is None else upward_turn(folder, up, kind)
    prepare = _both(widen, turn)
    mesh = MeshRequest(voxel, objects, rendered, images, wanted)
    wish = _Wish(place, kind, voxel, objects, min_opacity, plain, discs, keyframes, images, mesh)
    with output_lock(place):
        said = _write(folder, wish, prepare, observer)
    return said if turn is None else f"{said}; {turn.text}"


@dataclass(frozen=True)
class _Wish:
    """Arguments of `export_run`; `points` is the distance of points, `mesh` what of them is about a mesh."""

    place: Path
    kind: ExportFormat
    points: float | None
    objects: str | None
    min_opacity: float
    plain: bool
    discs: bool
    keyframes: bool
    images: Path | None
    mesh: MeshRequest


def _write(folder: RunFolder, wish: _Wish, prepare: Prepare | None, observer: Observer | None) -> str:
    place, kind, objects, opacity, plain = wish.place, wish.kind, wish.objects, wish.min_opacity, wish.plain
    if kind is ExportFormat.mesh:
        return export_mesh(folder, place, wish.mesh, observer)
    if kind in _WITH_VIEWS:
        write = export_colmap if kind is ExportFormat.colmap else export_nerfstudio
        return write(folder, place, wish.points, wish.keyframes, wish.images)
    if kind is ExportFormat.segmented:
        return export_segmented(folder, place, objects, opacity, plain, prepare)
    if kind in _SCENES:
        return export_scene(folder, place, kind.value, objects, opacity, plain, prepare)
    if kind is ExportFormat.streamed_sog:
        return stream_run(folder, place, objects, opacity, plain, observer, prepare)
    if kind is ExportFormat.ply and objects is not None:
        return export_objects(folder, place, objects, opacity, plain, prepare)
    if kind is ExportFormat.ply:
        return export_splats(folder, place, opacity, plain, prepare)
    if kind is ExportFormat.points:
        return export_points(folder, place, wish.points, wish.discs, opacity)
    if kind is ExportFormat.pcd:
        return export_pcd(folder, place, wish.points, wish.discs, opacity)
    if kind is ExportFormat.trajectory:
        return export_trajectory(folder, place)
    return export_packed(folder, place, kind.value, opacity, prepare)


def _export_store(
    path: Path, out: Path, kind: ExportFormat, objects: str | None, min_opacity: float, zoom: float,
    observer: Observer | None,
) -> str:  # fmt: skip
    if kind is not ExportFormat.streamed_sog:
        raise ConfigError(f"{path}: is a grid store, of which `format` streamed-sog can be written, not {kind.value}")
    if zoom != 1:
        raise ConfigError(f"{path}: is a grid store, which has no keyframes: leave out `zoom`")
    if objects is not None:
        raise ConfigError(f"{path}: is a grid store, which has no table of objects: leave out `objects`")
    with output_lock(out):
        return stream_store(path, out, min_opacity, observer)


def _both(first: Prepare | None, then: Prepare | None) -> Prepare | None:
    """One after the other, where there are both."""
    if first is None or then is None:
        return first or then

    def both(gaussians: GaussianMap) -> None:
        first(gaussians)
        then(gaussians)

    return both


def _with_poses(folder: RunFolder, what: str) -> RunFolder:
    """The run itself; raises ConfigError for a map without poses and recording."""
    if not (folder.has_poses and folder.has_recording):
        raise ConfigError(f"{folder.path}: is a map without a run's poses and recording, which {what} needs")
    return folder


def _widen_for(folder: RunFolder, zoom: float) -> ZoomWidening:
    record = folder.keyframes()
    poses, numbers = record.poses(), record.keyframe_numbers()
    chosen, recording = [i for i in sorted(poses) if i in numbers], folder.sequence()
    cameras = [recording.camera_of(i) for i in chosen]
    return ZoomWidening(recording.camera, [poses[i] for i in chosen], zoom, cameras)


def _format_named(name: str) -> ExportFormat:
    try:
        return ExportFormat(name)
    except ValueError:
        known = ", ".join(kind.value for kind in ExportFormat)
        raise ConfigError(f"`format`: expected one of {known}, found {name!r}") from None


def _refuse_beside_movers(place: Path, *others: object) -> None:
    """Raises ConfigError for what says something of the map."""
    if any(value not in (None, False, 0.0, 1.0) for value in others):
        raise ConfigError("`movers` writes points of movers as they were seen: of other arguments it takes only `out`")
    if place.suffix:
        raise ConfigError(f"`out` {place}: `movers` writes a folder, with a file for each")


def _check_discs(kind: ExportFormat, discs: bool, min_opacity: float) -> None:
    """Raises ConfigError for a choice of discs, or of their opacity, that has no effect."""
    of_points = kind in (ExportFormat.points, ExportFormat.pcd)
    if discs and not of_points:
        raise ConfigError(f"`discs` goes with `format` points or pcd, not {kind.value}")
    if of_points and min_opacity > 0 and not discs:
        raise ConfigError(f"`min_opacity` goes with `format` {kind.value} only with `discs`")


def _refuse_ignored(
    kind: ExportFormat, objects: str | None, keyframes: bool, recording: str | Path | None, rendered: bool, zoom: float,
    frame: OutputFrame, up: str | None,
) -> None:  # fmt: skip
    """Raises ConfigError for an argument that this format leaves without effect."""
    if objects is not None and kind not in _WITH_OBJECTS:
        with_objects = ", ".join(kind.value for kind in _WITH_OBJECTS)
        raise ConfigError(f"`objects` goes with `format` {with_objects}, not {kind.value}")
    if keyframes and kind not in _WITH_VIEWS:
        raise ConfigError(f"`keyframes` goes with `format` colmap or nerfstudio, not {kind.value}")
    if recording is not None and kind not in (*_WITH_VIEWS, ExportFormat.mesh):
        raise ConfigError(f"`recording` goes with `format` colmap, nerfstudio or mesh, not {kind.value}")
    if zoom != 1 and kind in _WITHOUT_GAUSSIANS:
        raise ConfigError(f"`zoom` goes with formats of Gaussians, not {kind.value}")
    if frame is not OutputFrame.map and kind is not ExportFormat.mesh:
        raise ConfigError(f"`frame` goes with `format` mesh, not {kind.value}")
    if up is not None and kind in _WITHOUT_GAUSSIANS:
        raise ConfigError(f"`up` goes with formats of Gaussians, not {kind.value}")
    if rendered and kind is not ExportFormat.mesh:
        raise ConfigError(f"`rendered` goes with `format` mesh, not {kind.value}")
