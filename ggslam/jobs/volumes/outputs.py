# SPDX-License-Identifier: Apache-2.0
"""Files and pictures of a recording's volumes.

    tsdf.npz                   the signed distances, to go on in
    mesh.ply, mesh.png         the surface, with colours and object ids; the picture from where the camera was and above
    objects.png, object_*.ply  the same in colours of objects; a mesh of each of them
    esdf.png                   the distance field at one height
    map.pgm, map.yaml          obstacles between two heights, as ROS's map_server reads them, in the floor's frame
    map_NAME.pgm, .yaml        the same of a robot's heights; costmap_NAME.png, .yaml: what driving there costs it;
                               robot_NAME.png: a picture of it
    occupancy.bt, .ot, .png    the occupancy map, as OctoMap reads it
    floor.yaml                 where the floor's frame is in the map's
    volumes.json               where all this is from, sizes and times

Meshes and the occupancy map are in the frame that is asked for, the map's or the floor's; tsdf.npz is in the map's.
Where the map's coordinates are large, as in UTM, meshes have double precision, and what cannot have it (tsdf.npz,
occupancy.bt and .ot) is counted from an origin that the files tell; the floor's frame then lies below that.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.driving.inflation import Inflation
from ggslam.driving.map_files import write_map
from ggslam.driving.robot import Robot
from ggslam.errors import RunFolderError
from ggslam.formats.mesh_files import PlyPart, write_mesh, write_ply_mesh
from ggslam.jobs.progress import Observer
from ggslam.jobs.volumes.pictures import mesh_picture, occupancy_picture
from ggslam.jobs.volumes.robot_maps import floor_layers, write_robot_maps
from ggslam.reporting.pictures import write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.publishing import change_in_run
from ggslam.runs.records.volumes import VolumesRecord
from ggslam.scene.origin import moved_pose
from ggslam.scene.poses import translation
from ggslam.system.json_files import write_json
from ggslam.system.plurals import quantity
from ggslam.system.staging import finish_saving, make_staging, publish
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import is_plain_name
from ggslam.volumes.cell_field import AnyField, CellField
from ggslam.volumes.floor_frame import FLOOR_FILE, FloorTuning, floor_from_map, floor_height, write_floor_file
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.mesh import Mesh
from ggslam.volumes.mesh_parts import MeshParts
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.octomap_files import write_octomap
from ggslam.volumes.output_frame import OutputFrame
from ggslam.volumes.slices import FieldSlice, plane_at_height, slice_field, slice_picture
from ggslam.volumes.upright import Upright, estimate_up

RECORD = VolumesRecord.FILE
"""Is there if and only if a folder holds volumes."""
_FILES = (
    "tsdf.npz", "mesh.ply", "mesh.png", "objects.png", "esdf.png", "map.pgm", "map.yaml", "occupancy.bt",
    "occupancy.ot", "occupancy.png", FLOOR_FILE,
)  # fmt: skip


class VolumeOutputTuning(Tuning):
    """Limits of files of volumes."""

    max_slice_cells = 20_000_000
    """Most cells of a slice."""
    min_piece_triangles = 50
    """Pieces of the mesh with fewer triangles are left out: specks of noise in the air."""
    upright_vertices = 500_000
    """Most vertices that the direction up is found from."""


@dataclass(frozen=True)
class OutputRequest:
    """Optional outputs.

    Attributes:
        mesh: file of the mesh; None: mesh.ply beside the rest.
        object_meshes: whether each object gets a mesh of its own.
        slice_height: metres above the floor; None: as high as the camera was.
        band: lowest and highest obstacle of the ROS map, metres above the floor.
        names: of object ids.
        frame: of meshes and occupancy.
        robots: that get maps of their own, with names.
        inflation: how costs fall off in their costmaps.
    """

    mesh: Path | None
    object_meshes: bool
    slice_height: float | None
    band: tuple[float, float]
    names: dict[int, str]
    frame: OutputFrame = OutputFrame.map
    robots: Sequence[Robot] = ()
    inflation: Inflation = Inflation()


@dataclass(frozen=True)
class Surface:
    """What there is to see, and how it lies.

    Attributes:
        parts: of the mesh, in the map's frame.
        upright: which way is up, and where the floor is, seen from `origin`.
        poses: T_map_camera [N, 4, 4] of the frames that were fused.
        T_floor_map: float64 [4, 4], see `floor_frame`; the floor's frame lies below `origin`.
        origin: of the TSDF in the map's frame, [3] metres: zero, but for maps far from it.
    """

    parts: MeshParts
    upright: Upright
    poses: np.ndarray
    T_floor_map: np.ndarray
    origin: np.ndarray

    @property
    def near_poses(self) -> np.ndarray:
        """The poses relative to `origin`."""
        return moved_pose(self.poses, -self.origin)

    @property
    def mesh(self) -> Mesh:
        """All of the mesh in memory."""
        return self.parts.whole()

    @property
    def near_mesh(self) -> MeshParts:
        """The mesh relative to `origin`."""
        if not self.origin.any():
            return self.parts
        return self.parts.apply(lambda part: replace(part, vertices=(part.vertices - self.origin).astype(np.float32)))

    @staticmethod
    def of(maps: VolumeMaps, poses: Sequence[np.ndarray]) -> Surface:
        """The surface of finished maps."""
        parts, origin = maps.mesh_parts(VolumeOutputTuning.min_piece_triangles), maps.tsdf.origin
        stacked = np.array(poses)
        near = moved_pose(stacked, -origin)
        # Marching cubes' vertices are spread evenly enough over surfaces to stand for their area.
        vertices, normals = parts.sample(VolumeOutputTuning.upright_vertices)
        upright = estimate_up(near, vertices - origin if origin.any() else vertices, normals)
        T_floor_map = floor_from_map(upright, near) @ translation(-origin)
        return Surface(parts, upright, stacked, T_floor_map, origin)


@dataclass
class Outputs:
    """Files that were written.

    Attributes:
        files: all of them.
        lines: facts for people.
        record: content of volumes.json.
    """

    files: list[Path] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    record: dict[str, Any] = field(default_factory=dict)


class _Writer:
    """Writes into a hidden folder, from which all files go to `out` together."""

    def __init__(self, out: Path, request: OutputRequest, surface: Surface) -> None:
        self.out, self.request, self.surface = out, request, surface
        self.poses = surface.near_poses
        self.T_out_map = surface.T_floor_map if request.frame is OutputFrame.floor else np.eye(4)
        self.staged = make_staging(out)
        self.outputs = Outputs()

    def path(self, name: str) -> Path:
        """Where to write a file of the folder; it is noted as written."""
        self.outputs.files.append(self.out / name)
        return self.staged / name

    def tell(self, line: str, **facts: Any) -> None:
        """A line for people, and the same for the record."""
        self.outputs.lines.append(line)
        self.outputs.record |= facts

    # --- the parts ---------------------------------------------------------------------------------------------------

    def tsdf(self, maps: VolumeMaps) -> None:
        """The signed distances."""
        maps.save_tsdf(self.path("tsdf.npz"))
        (blocks, dense), held = maps.block_counts(), maps.tsdf.memory_bytes / 1e6
        self.tell(
            f"TSDF: {quantity(blocks, 'block')} of 8^3 voxels, {dense} near surfaces, {held:.0f} MB",
            tsdf={"blocks": blocks, "dense_blocks": dense, "memory_mb": held},
        )

    def mesh(self) -> None:
        """The surface."""
        parts, is_level = self.surface.parts, self.request.frame is OutputFrame.floor
        if is_level:
            parts = parts.apply(lambda part: part.in_frame(self.T_out_map))
        path = self.request.mesh or self.path("mesh.ply")
        if self.request.mesh is not None:
            self.outputs.files.append(path)
        objects = parts.objects
        _write_mesh(path, parts, self.request.names, is_level)
        facts = {"vertices": parts.vertices, "triangles": parts.triangles, "objects": objects}
        none = "" if facts["triangles"] else "; no surface was found: voxels may be too large, or depth seen too rarely"
        self.tell(f"mesh: {facts['vertices']} vertices, {facts['triangles']} triangles{none}", mesh=facts)
        if self.request.object_meshes:
            self._object_meshes(parts, objects)

    def _object_meshes(self, parts: MeshParts, objects: list[int]) -> None:
        for number in objects:
            part, name = parts.of_object(number), self.request.names.get(number, "object")
            safe = "".join(c if c.isalnum() else "_" for c in name)
            path = self.path(f"object_{number}_{safe}.ply")
            write_mesh(path, part.vertices, part.triangles, part.normals, part.colors, part.labels)
        self.tell(f"wrote meshes of {quantity(len(objects), 'object')}: {self.out / 'object_*.ply'}")

    def floor(self) -> None:
        """Which way is up, and where the floor is."""
        found = self.surface.upright
        floor = "no floor was found" if found.floor is None else f"the floor is at {found.floor:.2f} m along it"
        self.tell(
            f"up is ({', '.join(f'{v:.3f}' for v in found.up)}) in the world's frame, {found.support:.0%} of the "
            f"surfaces agree; {floor}", up=asdict(found)
        )  # fmt: skip
        if self.surface.origin.any():
            self.tell(
                f"the map is far from zero: heights, slices and the floor's frame are counted from "
                f"{_words(self.surface.origin)}", origin=self.surface.origin
            )  # fmt: skip
        frame, seen = self.request.frame, found.floor is not None
        command = write_floor_file(self.path(FLOOR_FILE), self.surface.T_floor_map, frame, seen)
        lying = "all ROS files are in the floor's frame"
        if frame is OutputFrame.map:
            lying = "mesh and occupancy are in the map's frame, map.pgm is in the floor's"
        guess = "" if seen else f" (z = 0 is {FloorTuning.below_cameras_m:g} m below the lowest camera)"
        self.tell(f"{lying}{guess}: {command}", frame=frame.value, T_floor_map=self.surface.T_floor_map)

    def field(self, field_: AnyField, seconds: float) -> None:
        """A slice of the distance field, whose last update took `seconds`, and the ROS map."""
        upright = self.surface.upright
        heights, base = self.poses[:, :3, 3] @ upright.up, floor_height(upright, self.poses)
        wanted = self.request.slice_height
        height = float(np.median(heights)) if wanted is None else base + wanted
        cut = _slice(field_, upright.up, height)
        write_picture(self.path("esdf.png"), slice_picture(cut, _full_scale(cut.distance[cut.known])))
        if not cut.known.any():
            self.outputs.lines.append(f"note: nothing is known {height - base:.2f} m up: esdf.png is empty")
        layers = floor_layers(field_, plane_at_height(field_, upright.up, base), VolumeOutputTuning.max_slice_cells,
                              upright.floor is not None)  # fmt: skip
        plan = layers.between(*self.request.band)
        written, robots = write_robot_maps(layers, self.request.robots, self.request.inflation, self.staged)
        self.outputs.files += [self.out / file.name for file in (*write_map(plan, self.staged / "map"), *written)]
        axes = {"origin": plan.plane.origin, "x_axis": plan.plane.x_axis, "y_axis": plan.plane.y_axis}
        held = field_.memory_bytes / 1e6
        ground = "the floor" if upright.floor is not None else "a metre below the camera"
        taken = f"{held:.0f} MB, last update {1e3 * seconds:.0f} ms"
        if isinstance(field_, CellField):
            taken = f"{held:.0f} MB at most, a few cells at a time"
        self.tell(
            f"distance field: {quantity(len(field_), 'block')}, {taken}; "
            f"slice {height - base:.2f} m above {ground}",
            esdf={"blocks": len(field_), "memory_mb": held, "last_update_ms": 1e3 * seconds,
                  "slice_height": height - base, "band": plan.heights, "map_frame": axes, "robots": robots},
        )  # fmt: skip
        for name, facts in robots.items():
            drops = f", the floor falls away on {facts['drops_m2']:.1f} m2" if facts["drops_m2"] else ""
            self.outputs.lines.append(
                f"{name}: {facts['free_m2']:.1f} m2 are free, its centre has {facts['for_its_centre_m2']:.1f} m2"
                f"{drops}: {self.out / f'robot_{name}.png'}"
            )

    def occupancy(self, occupancy: OccupancyMap) -> None:
        """The occupancy map, which is in the frame that is asked for already."""
        for ending in (".bt", ".ot"):
            write_octomap(occupancy, self.path("occupancy" + ending))
        up = self.T_out_map[:3, :3] @ self.surface.upright.up
        poses = self.T_out_map @ self.surface.poses
        write_picture(self.path("occupancy.png"), occupancy_picture(occupancy, poses, up))
        if occupancy.origin.any():
            self.outputs.lines.append(
                f"occupancy.bt and .ot are counted from {_words(occupancy.origin)}, as their headers say: OctoMap's "
                "grid does not reach so far"
            )
        found = occupancy.summary()
        self.tell(
            f"occupancy: {found.occupied} occupied and {found.free} free voxels of {100 * occupancy.resolution:g} cm, "
            f"{found.memory_bytes / 1e6:.1f} MB",
            occupancy={"occupied": found.occupied, "free": found.free, "memory_mb": found.memory_bytes / 1e6},
        )  # fmt: skip


def _write_mesh(path: Path, parts: MeshParts, names: dict[int, str], is_level: bool) -> None:
    """A PLY part by part; other formats need all of the mesh in memory."""

    def rows() -> Iterator[PlyPart]:
        for part in parts:
            mesh, new = part.mesh, part.first
            labels = mesh.labels[new] if parts.objects else None
            triangles = part.numbers[mesh.triangles]
            yield PlyPart(mesh.vertices[new], triangles, mesh.normals[new], mesh.colors[new], labels)

    if path.suffix.lower() == ".ply":
        write_ply_mesh(path, rows, parts.vertices, parts.triangles)
        return
    mesh = parts.whole()
    labels = mesh.labels if parts.objects else None
    write_mesh(path, mesh.vertices, mesh.triangles, mesh.normals, mesh.colors, labels, names, is_level)


def _words(position: np.ndarray) -> str:
    return f"({', '.join(f'{value:g}' for value in position)})"


def _slice(field_: AnyField, up: np.ndarray, height: float) -> FieldSlice:
    """A slice, coarser than the field's voxels where that would be too many cells."""
    plane = plane_at_height(field_, up, height)
    area = (plane.high[0] - plane.low[0]) * (plane.high[1] - plane.low[1])
    return slice_field(field_, plane, max(field_.voxel, math.sqrt(area / VolumeOutputTuning.max_slice_cells)))


def _full_scale(distances: np.ndarray) -> float:
    """A round number of metres above nearly all of the distances."""
    return max(0.25, math.ceil(4 * float(np.percentile(distances, 99))) / 4) if len(distances) else 1.0


def write_outputs(
    maps: VolumeMaps, surface: Surface, out: Path, request: OutputRequest, record: dict[str, Any], observer: Observer
) -> Outputs:  # fmt: skip
    """Writes everything; when all of it is on the disk, it takes the place of earlier volumes in the folder.

    Args:
        maps: what was made; the occupancy map in the frame that is asked for.
        surface: of the maps.
        out: the folder, see `prepare_folder`.
        request: what is wanted.
        record: for volumes.json, where the volumes are from.
        observer: receives progress updates.
    """
    earlier = _earlier_files(out)
    writer = _Writer(out, request, surface)
    try:
        _write_all(writer, maps, record, observer)
    except BaseException:
        shutil.rmtree(writer.staged, ignore_errors=True)
        raise
    with change_in_run(out):
        publish(writer.staged, out, RECORD, earlier, {"complete": False})
    return writer.outputs


def prepare_folder(out: Path) -> None:
    """Finds out before the work whether volumes can be written to a folder, and finishes a writing that was
    interrupted.

    Raises:
        RunFolderError: they cannot.
    """
    RunFolder(out).check_writable()
    for name in _FILES:
        if (out / name).is_dir():
            raise RunFolderError(f"{out / name}: is a folder; a file of this name is to be written")
    finish_saving(out, RECORD)


def _earlier_files(out: Path) -> list[str]:
    """Names of the files that earlier volumes left in the folder, and that later ones replace."""
    try:
        names = VolumesRecord.read(out).files
        return [name for name in names if is_plain_name(name) and name != RECORD and (out / name).is_file()]
    except RunFolderError:
        return []


def _write_all(writer: _Writer, maps: VolumeMaps, record: dict[str, Any], observer: Observer) -> None:
    observer.begin("mesh, pictures, files", 4)
    writer.tsdf(maps)
    observer.advance(1, 4)
    writer.mesh()
    writer.floor()
    mesh, upright = writer.surface.near_mesh, writer.surface.upright
    if mesh.triangles:
        write_picture(writer.path("mesh.png"), mesh_picture(mesh, writer.poses, upright.up))
        if writer.outputs.record["mesh"]["objects"]:
            write_picture(writer.path("objects.png"), mesh_picture(mesh, writer.poses, upright.up, by_object=True))
    observer.advance(2, 4)
    if (field_ := maps.finished_field) is not None:
        writer.field(field_, maps.times.last_update)
    observer.advance(3, 4)
    if maps.occupancy is not None:
        writer.occupancy(maps.occupancy)
    observer.advance(4, 4)
    names = [path.name for path in writer.outputs.files if path.parent == writer.out]
    writer.outputs.record = {"complete": True, **record, **writer.outputs.record, "files": names}
    write_json(writer.path(RECORD), writer.outputs.record)
