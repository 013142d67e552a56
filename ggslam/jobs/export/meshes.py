# SPDX-License-Identifier: Apache-2.0
"""A run's surface as a mesh: depth images of its recording, or rendered from its map, fused and contoured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ggslam.errors import RunFolderError, SequenceError
from ggslam.formats.mesh_files import WRITER, write_mesh
from ggslam.formats.writer import SurfaceMesh, Writer
from ggslam.geometry.scene_size import scene_scale
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.volumes.frames import PosedFrame, frames_of_run
from ggslam.jobs.volumes.outputs import Surface
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.rendered_views import RenderedViews
from ggslam.scene.frame import Frame
from ggslam.scene.object_names import object_file_name
from ggslam.system.atomic import make_folder
from ggslam.system.plurals import quantity
from ggslam.volumes.floor_frame import FLOOR_FILE, FloorTuning, write_floor_file
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.mesh import Mesh
from ggslam.volumes.output_frame import OutputFrame


@dataclass(frozen=True)
class MeshRequest:
    """A request for a mesh.

    Attributes:
        voxel: edge of the voxels, metres; None: as the run's settings say; where they say nothing, as goes with the
            scene's size.
        objects: names or ids, "mug,7", or "all": only these; None: the whole surface.
        rendered: take depth from the map in any case.
        recording: where the recording is now, if it was moved.
        frame: of the mesh, see `volumes.floor_frame`; with the floor's, FLOOR_FILE is written beside it.
    """

    voxel: float | None = None
    objects: str | None = None
    rendered: bool = False
    recording: Path | None = None
    frame: OutputFrame = OutputFrame.map


@dataclass
class _Views:
    """Frames to fuse: how many, where from (for people), and what a user should know."""

    frames: Iterator[PosedFrame]
    count: int
    origin: str
    notes: list[str] = field(default_factory=list)


def export_mesh(
    folder: RunFolder, out: Path, request: MeshRequest | None = None, observer: Observer | None = None,
    writer: Writer = WRITER,
) -> str:  # fmt: skip
    """Writes the surface in a format of meshes; returns a line that says so.

    Depth is that of the recording at the run's poses. It is rendered from the map at the keyframes' poses instead if
    the recording is not there any more, if the run was edited (the recording shows the room as it was), or on request.

    Args:
        folder: of the run.
        out: file; or, with `request.objects`, a folder, for a PLY of each object.
        request: see `MeshRequest`.
        observer: receives progress updates.
        writer: of the format.

    Raises:
        ConfigError: impossible voxel, unknown object, or an object without any surface.
        FormatError: an ending that is not the format's.
        MissingDependency: OBJ or GLB without trimesh.
        RunFolderError: no frame was located, or there is no surface.
    """
    request, observer = request or MeshRequest(), observer or SilentObserver()
    into_folder = request.objects is not None and not out.suffix
    if not into_folder:
        writer.check_path(out)
    table = folder.object_table() if folder.has_objects() or request.objects is not None else None
    ids = None if request.objects is None or table is None else table.select(request.objects)
    views = _views(folder, request)
    for note in views.notes:
        observer.note(note)
    surface = _fuse(folder, views, request.voxel, observer)
    is_level = request.frame is OutputFrame.floor
    mesh = surface.mesh.in_frame(surface.T_floor_map) if is_level else surface.mesh
    names = {} if table is None else {o.id: o.name for o in table.objects if o.name}
    place = out if into_folder else out.parent
    if ids is None:
        return _write(writer, out, mesh, names, views.origin, is_level) + _write_floor(place, surface, is_level)
    labels = mesh.triangle_labels()
    if not np.isin(labels, ids).any():
        raise RunFolderError(f"{folder.path}: no surface of {request.objects} was found; smaller voxels may help")
    if into_folder:
        assert table is not None
        return _write_each(out, mesh, labels, table, ids, views.origin) + _write_floor(place, surface, is_level)
    part = mesh.part(np.isin(labels, ids))
    return _write(writer, out, part, names, views.origin, is_level) + _write_floor(place, surface, is_level)


def _fuse(folder: RunFolder, views: _Views, voxel: float | None, observer: Observer) -> Surface:
    settings = folder.config().volumes
    if voxel is not None:
        settings = replace(settings, tsdf=replace(settings.tsdf, voxel=voxel))
    maps = VolumeMaps(settings)
    observer.begin("fuse", views.count)
    poses: list[np.ndarray] = []
    for done, view in enumerate(views.frames):
        if not done:
            maps.fit(scene_scale(view.frame.depth), voxel is None)
        maps.add(view.frame, view.T_world_camera, view.labels)
        poses.append(view.T_world_camera)
        observer.advance(done + 1, views.count)
    maps.finish()
    surface = Surface.of(maps, poses)
    if not len(surface.mesh.triangles):
        raise RunFolderError(f"{folder.path}: no surface was found; voxels may be too large, or depth seen too rarely")
    return surface


# --- depth and colour ------------------------------------------------------------------------------------------------


def _views(folder: RunFolder, request: MeshRequest) -> _Views:
    if request.rendered:
        return _map_views(folder)
    if folder.mark().edits:
        views = _map_views(folder)
        views.notes.append("the run was edited: depth is rendered from the edited map")
        return views
    try:
        source = frames_of_run(folder, request.recording)
    except (SequenceError, RunFolderError) as missing:
        if request.recording is not None:
            raise
        views = _map_views(folder)
        views.notes.append(f"depth is rendered from the map: {missing}")
        return views
    return _Views(iter(source), len(source), f"{len(source)} depth images of the recording", source.notes)


def _map_views(folder: RunFolder) -> _Views:
    """The map as the keyframes see it."""
    views = RenderedViews.of_files(folder.path, folder.map_in_parts())
    if not len(views):
        raise RunFolderError(f"{folder.path}: no frame of this run was located")
    return _Views(_renders(views), len(views), f"depth rendered at {quantity(len(views), 'keyframe')}")


def _renders(views: RenderedViews) -> Iterator[PosedFrame]:
    for k in range(len(views)):
        view = views.view(k)
        assert view.color is not None
        frame = Frame(k, k, float(k), view.color, view.depth, view.camera)
        yield PosedFrame(frame, view.T_world_camera, view.labels)


# --- files -----------------------------------------------------------------------------------------------------------


def _write(writer: Writer, path: Path, mesh: Mesh, names: dict[int, str], origin: str, z_up: bool) -> str:
    make_folder(path.parent)
    objects = mesh.objects()
    labels = mesh.labels if objects else None
    surface = SurfaceMesh(
        mesh.vertices, mesh.triangles, mesh.normals, mesh.colors, labels, names, z_up, len(objects), origin
    )  # fmt: skip
    return writer.write(path, surface)


def _write_floor(folder: Path, surface: Surface, is_level: bool) -> str:
    """Where the floor is, in a file; a second line for people. Nothing, if the mesh is in the map's frame."""
    if not is_level:
        return ""
    seen = surface.upright.floor is not None
    command = write_floor_file(folder / FLOOR_FILE, surface.T_floor_map, OutputFrame.floor, seen)
    guess = "" if seen else f" (no floor was found: z = 0 is {FloorTuning.below_cameras_m:g} m below the lowest camera)"
    return f"\n{folder / FLOOR_FILE}{guess}: {command}"


def _write_each(out: Path, mesh: Mesh, labels: np.ndarray, table: ObjectTable, ids: list[int], origin: str) -> str:
    make_folder(out)
    written = []
    for record in map(table.record, ids):
        part = mesh.part(labels == record.id)
        if len(part.triangles):
            path = out / object_file_name(record.id, record.name)
            write_mesh(path, part.vertices, part.triangles, part.normals, part.colors, part.labels)
            written.append(part)
    without = len(ids) - len(written)
    lacking = f" ({without} have no surface at this voxel)" if without else ""
    total = sum(len(part.triangles) for part in written)
    wrote = f"wrote {quantity(len(written), 'object')} to {out}{lacking}"
    return f"{wrote}: {quantity(total, 'triangle')}, from {origin}"
