# SPDX-License-Identifier: Apache-2.0
"""A run's surface as a mesh: depth images of its recording, or rendered from its map, fused and contoured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ggslam.errors import RunFolderError, SequenceError
from ggslam.formats.mesh_files import check_mesh_path, write_mesh
from ggslam.jobs.export.map_files import object_file_name
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.volumes.frames import PosedFrame, frames_of_run
from ggslam.jobs.volumes.outputs import SMALLEST_PIECE
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.rendered_views import RenderedViews
from ggslam.scene.frame import Frame
from ggslam.system.atomic import make_folder
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.mesh import Mesh, extract_mesh


@dataclass(frozen=True)
class MeshRequest:
    """Which mesh is wanted.

    Attributes:
        voxel: edge of the voxels, metres; None: as the run's settings say.
        objects: names or ids, "mug,7", or "all": only these; None: the whole surface.
        rendered: take depth from the map in any case.
        recording: where the recording is now, if it was moved.
    """

    voxel: float | None = None
    objects: str | None = None
    rendered: bool = False
    recording: Path | None = None


@dataclass
class _Views:
    """Frames to fuse: how many, where from (for people), and what a user should know."""

    frames: Iterator[PosedFrame]
    count: int
    origin: str
    notes: list[str] = field(default_factory=list)


def export_mesh(
    folder: RunFolder, out: Path, request: MeshRequest | None = None, observer: Observer | None = None
) -> str:
    """Writes the surface as PLY, OBJ or GLB (one node an object); returns a line that says so.

    Depth is that of the recording at the run's poses. It is rendered from the map at the keyframes' poses instead if
    the recording is not there any more, if the run was edited (the recording shows the room as it was), or on request.

    Args:
        folder: of the run.
        out: file; or, with `request.objects`, a folder, for a PLY of each object.
        request: see `MeshRequest`.
        observer: receives progress updates.

    Raises:
        ConfigError: impossible voxel, unknown object, or an object without any surface.
        FormatError: an ending that is no mesh's.
        MissingDependency: OBJ or GLB without trimesh.
        RunFolderError: no frame was located, or there is no surface.
    """
    request, observer = request or MeshRequest(), observer or SilentObserver()
    into_folder = request.objects is not None and not out.suffix
    if not into_folder:
        check_mesh_path(out)
    table = folder.object_table() if folder.has_objects() or request.objects is not None else None
    ids = None if request.objects is None or table is None else table.select(request.objects)
    views = _views(folder, request)
    for note in views.notes:
        observer.note(note)
    mesh = _fuse(folder, views, request.voxel, observer)
    names = {} if table is None else {o.id: o.name for o in table.objects if o.name}
    if ids is None:
        return _write(out, mesh, names, views.origin)
    labels = mesh.triangle_labels()
    if not np.isin(labels, ids).any():
        raise RunFolderError(f"{folder.path}: no surface of {request.objects} was found; smaller voxels may help")
    if into_folder:
        assert table is not None
        return _write_each(out, mesh, labels, table, ids, views.origin)
    return _write(out, mesh.part(np.isin(labels, ids)), names, views.origin)


def _fuse(folder: RunFolder, views: _Views, voxel: float | None, observer: Observer) -> Mesh:
    settings = folder.config().volumes
    if voxel is not None:
        settings = replace(settings, tsdf=replace(settings.tsdf, voxel=voxel))
    maps = VolumeMaps(settings)
    observer.begin("fuse", views.count)
    for done, view in enumerate(views.frames):
        maps.add(view.frame, view.T_world_camera, view.labels)
        observer.advance(done + 1, views.count)
    maps.finish()
    mesh = extract_mesh(maps.tsdf, min_triangles=SMALLEST_PIECE)
    if not len(mesh.triangles):
        raise RunFolderError(f"{folder.path}: no surface was found; voxels may be too large, or depth seen too rarely")
    return mesh


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
    views = RenderedViews.of_files(folder.path)
    if not len(views):
        raise RunFolderError(f"{folder.path}: no frame of this run was located")
    return _Views(_renders(views), len(views), f"depth rendered at {len(views)} keyframes")


def _renders(views: RenderedViews) -> Iterator[PosedFrame]:
    for k in range(len(views)):
        view = views.view(k)
        assert view.color is not None
        frame = Frame(k, k, float(k), view.color, view.depth, view.camera)
        yield PosedFrame(frame, view.T_world_camera, view.labels)


# --- files -----------------------------------------------------------------------------------------------------------


def _write(path: Path, mesh: Mesh, names: dict[int, str], origin: str) -> str:
    make_folder(path.parent)
    objects = mesh.objects()
    labels = mesh.labels if objects else None
    write_mesh(path, mesh.vertices, mesh.triangles, mesh.normals, mesh.colors, labels, names)
    return f"wrote {path}: {_size(mesh)}, {len(objects)} objects, from {origin}"


def _write_each(out: Path, mesh: Mesh, labels: np.ndarray, table: ObjectTable, ids: list[int], origin: str) -> str:
    make_folder(out)
    written = []
    for record in map(table.record, ids):
        part = mesh.part(labels == record.id)
        if len(part.triangles):
            path = out / object_file_name(record)
            write_mesh(path, part.vertices, part.triangles, part.normals, part.colors, part.labels)
            written.append(part)
    without = len(ids) - len(written)
    lacking = f" ({without} have no surface at this voxel)" if without else ""
    total = sum(len(part.triangles) for part in written)
    return f"wrote {len(written)} object{'s' * (len(written) != 1)} to {out}{lacking}: {total} triangles, from {origin}"


def _size(mesh: Mesh) -> str:
    return f"{len(mesh.vertices)} vertices, {len(mesh.triangles)} triangles"
