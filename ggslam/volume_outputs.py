# SPDX-License-Identifier: Apache-2.0
"""Files and pictures of a recording's volumes.

    tsdf.npz                   the signed distances, to go on in
    mesh.ply, mesh.png         the surface, with colours and object ids; the picture from where the camera was and above
    objects.png, objects/      the same in colours of objects; a mesh of each of them
    esdf.png                   the distance field at one height
    map.pgm, map.yaml          obstacles between two heights, as ROS's map_server reads them
    occupancy.bt, .ot, .png    the occupancy map, as OctoMap reads it
    volumes.json               where all this is from, sizes and times
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.formats.atomic import make_folder, write_text
from ggslam.formats.mesh_files import write_mesh
from ggslam.progress import Observer
from ggslam.reporting.pictures import write_picture
from ggslam.run_folder import json_ready
from ggslam.volume_maps import VolumeMaps
from ggslam.volume_pictures import mesh_picture, occupancy_picture
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.mesh import Mesh, extract_mesh
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.octomap_files import write_octomap
from ggslam.volumes.slices import plane_at_height, slice_field, write_ros_map, write_slice_picture
from ggslam.volumes.tsdf_file import save_tsdf
from ggslam.volumes.upright import Upright, estimate_up

RECORD = "volumes.json"
"""Is there if and only if a folder holds volumes."""
_FILES = (
    "tsdf.npz", "mesh.ply", "mesh.png", "objects.png", "esdf.png", "map.pgm", "map.yaml", "occupancy.bt",
    "occupancy.ot", "occupancy.png",
)  # fmt: skip
SMALLEST_PIECE = 50
"""Triangles; smaller pieces of the mesh, specks of noise in the air, are left out."""


@dataclass(frozen=True)
class OutputRequest:
    """What is written, beside what there always is.

    Attributes:
        mesh: file of the mesh; None: mesh.ply beside the rest.
        object_meshes: whether each object gets a mesh of its own.
        slice_height: metres above the floor; None: as high as the camera was.
        band: lowest and highest obstacle of the ROS map, metres above the floor.
        names: of object ids.
    """

    mesh: Path | None
    object_meshes: bool
    slice_height: float | None
    band: tuple[float, float]
    names: dict[int, str]


@dataclass
class Outputs:
    """What was written.

    Attributes:
        files: all of them.
        lines: facts for people.
        record: content of volumes.json.
    """

    files: list[Path] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    record: dict[str, Any] = field(default_factory=dict)


class _Writer:
    """Writes into one folder and remembers what was written."""

    def __init__(self, out: Path, request: OutputRequest, poses: np.ndarray) -> None:
        self.out, self.request, self.poses = out, request, poses
        self.outputs = Outputs()

    def path(self, name: str) -> Path:
        """A file of the folder, noted as written."""
        self.outputs.files.append(self.out / name)
        return self.outputs.files[-1]

    def tell(self, line: str, **facts: Any) -> None:
        """A line for people, and the same for the record."""
        self.outputs.lines.append(line)
        self.outputs.record |= facts

    # --- the parts ---------------------------------------------------------------------------------------------------

    def tsdf(self, maps: VolumeMaps) -> None:
        """The signed distances."""
        tsdf = maps.tsdf
        save_tsdf(self.path("tsdf.npz"), tsdf)
        held = tsdf.memory_bytes / 1e6
        self.tell(
            f"TSDF: {len(tsdf)} blocks of 8^3 voxels, {tsdf.dense_blocks} near surfaces, {held:.0f} MB",
            tsdf={"blocks": len(tsdf), "dense_blocks": tsdf.dense_blocks, "memory_mb": held},
        )

    def mesh(self, maps: VolumeMaps) -> Mesh:
        """The surface."""
        mesh = extract_mesh(maps.tsdf, min_triangles=SMALLEST_PIECE)
        if self.request.mesh is None:
            path = self.path("mesh.ply")
        else:
            path = self.request.mesh
            make_folder(path.parent)
            self.outputs.files.append(path)
        labels = mesh.labels if mesh.objects() else None
        arrays = (mesh.vertices, mesh.triangles, mesh.normals, mesh.colors)
        write_mesh(path, *arrays, labels, self.request.names)
        facts = {"vertices": len(mesh.vertices), "triangles": len(mesh.triangles), "objects": mesh.objects()}
        self.tell(f"mesh: {facts['vertices']} vertices, {facts['triangles']} triangles: {path}", mesh=facts)
        if self.request.object_meshes:
            self._object_meshes(mesh)
        return mesh

    def _object_meshes(self, mesh: Mesh) -> None:
        make_folder(self.out / "objects")
        for number in mesh.objects():
            part, name = mesh.of_object(number), self.request.names.get(number, "object")
            safe = "".join(c if c.isalnum() else "_" for c in name)
            path = self.path(f"objects/{number}_{safe}.ply")
            write_mesh(path, part.vertices, part.triangles, part.normals, part.colors, part.labels)
        self.tell(f"{len(mesh.objects())} objects have a mesh of their own in {self.out / 'objects'}")

    def upright(self, mesh: Mesh) -> Upright:
        """Which way is up, and where the floor is."""
        # Marching cubes' vertices are spread evenly enough over surfaces to stand for their area.
        found = estimate_up(self.poses, mesh.vertices, mesh.normals)
        floor = "no floor was found" if found.floor is None else f"the floor is at {found.floor:.2f} m along it"
        self.tell(
            f"up is ({', '.join(f'{v:.3f}' for v in found.up)}) in the world's frame, {found.support:.0%} of the "
            f"surfaces agree; {floor}", up=asdict(found)
        )  # fmt: skip
        return found

    def field(self, field_: DistanceField, upright: Upright, seconds: float) -> None:
        """A slice of the distance field, whose last update took `seconds`, and the ROS map."""
        heights = self.poses[:, :3, 3] @ upright.up
        base = upright.floor if upright.floor is not None else float(heights.min()) - 1.0
        wanted = self.request.slice_height
        height = float(np.median(heights)) if wanted is None else base + wanted
        cut = slice_field(field_, plane_at_height(field_, upright.up, height), field_.voxel)
        write_slice_picture(cut, self.path("esdf.png"), _full_scale(cut.distance[cut.known]))
        low, high = self.request.band
        plane = plane_at_height(field_, upright.up, base)
        image, description = write_ros_map(
            slice_field(field_, plane, max(0.05, field_.voxel), (low, high)), self.out / "map"
        )
        self.outputs.files += [image, description]
        axes = {"origin": plane.origin, "x_axis": plane.x_axis, "y_axis": plane.y_axis}
        held = field_.memory_bytes / 1e6
        ground = "the floor" if upright.floor is not None else "a metre below the camera"
        self.tell(
            f"distance field: {len(field_)} blocks, {held:.0f} MB, last update {1e3 * seconds:.0f} ms; slice "
            f"{height - base:.2f} m above {ground}",
            esdf={"blocks": len(field_), "memory_mb": held, "last_update_ms": 1e3 * seconds,
                  "slice_height": height - base, "band": [low, high], "map_frame": axes},
        )  # fmt: skip

    def occupancy(self, occupancy: OccupancyMap, upright: Upright) -> None:
        """The occupancy map."""
        for ending in (".bt", ".ot"):
            write_octomap(occupancy, self.path("occupancy" + ending))
        write_picture(self.path("occupancy.png"), occupancy_picture(occupancy, self.poses, upright.up))
        found = occupancy.summary()
        self.tell(
            f"occupancy: {found.occupied} occupied and {found.free} free voxels of {100 * occupancy.resolution:g} cm, "
            f"{found.memory_bytes / 1e6:.1f} MB",
            occupancy={"occupied": found.occupied, "free": found.free, "memory_mb": found.memory_bytes / 1e6},
        )  # fmt: skip


def _full_scale(distances: np.ndarray) -> float:
    """A round number of metres above nearly all of the distances."""
    return max(0.25, math.ceil(4 * float(np.percentile(distances, 99))) / 4) if len(distances) else 1.0


def write_outputs(
    maps: VolumeMaps, out: Path, request: OutputRequest, poses: Sequence[np.ndarray], record: dict[str, Any],
    observer: Observer,
) -> Outputs:  # fmt: skip
    """Writes everything; files of earlier volumes in the folder go first.

    Args:
        maps: what was made.
        out: the folder; there.
        request: what is wanted.
        poses: T_world_camera of the frames that were fused.
        record: for volumes.json, where the volumes are from.
        observer: is told how it goes on.
    """
    write_text(out / RECORD, json.dumps({"complete": False}) + "\n")
    for stale in _FILES:
        (out / stale).unlink(missing_ok=True)
    shutil.rmtree(out / "objects", ignore_errors=True)
    writer = _Writer(out, request, np.array(poses))
    observer.begin("mesh, pictures, files", 4)
    writer.tsdf(maps)
    observer.advance(1, 4)
    mesh = writer.mesh(maps)
    upright = writer.upright(mesh)
    if len(mesh.triangles):
        write_picture(writer.path("mesh.png"), mesh_picture(mesh, writer.poses, upright.up))
        if mesh.objects():
            write_picture(writer.path("objects.png"), mesh_picture(mesh, writer.poses, upright.up, by_object=True))
    observer.advance(2, 4)
    if maps.field is not None:
        writer.field(maps.field, upright, maps.times.last_update)
    observer.advance(3, 4)
    if maps.occupancy is not None:
        writer.occupancy(maps.occupancy, upright)
    observer.advance(4, 4)
    writer.outputs.record = {"complete": True, **record, **writer.outputs.record}
    write_text(writer.path(RECORD), json.dumps(json_ready(writer.outputs.record), indent=1) + "\n")
    return writer.outputs
