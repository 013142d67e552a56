# SPDX-License-Identifier: Apache-2.0
"""Writes meshes with normals, colours and objects: PLY by itself, OBJ and GLB (glTF 2.0) through trimesh.

Coordinates are written as they are: metres, in the map's frame or a frame with z upwards. Far from zero, where single
precision would move them by a tenth of a millimetre and more, a PLY has doubles, and a GLB vertices near its origin and
the way there in its nodes' matrices. glTF viewers take y for
upwards, and colours at vertices for linear light, see `linear_light`.

The material of a GLB is unlit (KHR_materials_unlit): colours of a scan were photographed and hold the room's light, so
a viewer that lights them again shows them darker, and how dark depends on its lamps. Programs without the extension
fall back to a surface that is no metal and wholly rough, as Khronos advises; glTF's default is a polished metal, black
where nothing is to be mirrored. Triangles show their front alone: from outside, one looks through the near wall into
the room.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.linear_light import vertex_colors
from ggslam.formats.optional_package import package_for
from ggslam.formats.ply import RowParts, write_ply_elements
from ggslam.formats.triangle_mesh import majority_labels
from ggslam.formats.writer import SurfaceMesh, Takes, Writer
from ggslam.scene.origin import local_origin, stored_positions
from ggslam.scene.poses import translation
from ggslam.system.atomic import write_bytes

GLTF_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the map's axes, those of the first camera (y down, z forward), to glTF's (y up, z towards the viewer)."""
GLTF_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From axes with z up to glTF's."""
MATERIAL: dict[str, Any] = {
    "name": "scan", "extensions": {"KHR_materials_unlit": {}},
    "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
}  # fmt: skip
"""Of all triangles of a GLB."""
_CUSTOM = "_COLOR_0"
"""As trimesh calls an attribute that it hands on as it is; its own colours have 8 bits."""
ENDINGS = (".ply", ".obj", ".glb")


def check_mesh_path(path: str | Path) -> None:
    """Tells before the work whether a mesh can be written to a file of this name.

    Raises:
        FormatError: an ending that is none of `ENDINGS`.
        MissingDependency: it needs trimesh, which is not installed.
    """
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise FormatError(f"{path}: meshes are written as {', '.join(ENDINGS)}, found the ending {ending!r}")
    if ending != ".ply":
        _trimesh(path)


def write_mesh(
    path: str | Path, vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray | None = None,
    colors: np.ndarray | None = None, labels: np.ndarray | None = None, names: Mapping[int, str] | None = None,
    z_up: bool = False,
) -> None:  # fmt: skip
    """Writes a mesh in the format that the file's ending names, whole or not at all.

    PLY: binary; x y z, and what is given of nx ny nz, red green blue, object_id (ushort). OBJ: one object with normals
    and colours (behind each vertex' position, as most programs read them), no object ids. GLB: with labels a node
    for each object, called "ID NAME" or "object ID" ("unlabelled" for 0), else a single one; vertices are stored as
    given, and the nodes turn them, see `GLTF_AXES`; colours are in linear light, 16 bits.

    Args:
        path: ends in one of `ENDINGS`.
        vertices: float [V, 3], metres.
        triangles: int [F, 3], rows of vertices.
        normals: float [V, 3], unit.
        colors: uint8 [V, 3].
        labels: uint16 [V], object of each vertex; a triangle belongs to that of most of its vertices.
        names: of objects, for GLB.
        z_up: whether z is upwards, not -y about as in the map's frame; of GLB alone this turns the nodes.

    Raises:
        FormatError: another ending; or an empty mesh, which OBJ and GLB files cannot hold.
        MissingDependency: OBJ or GLB without trimesh.
        RunFolderError: the file cannot be written.
    """
    check_mesh_path(path)
    if Path(path).suffix.lower() == ".ply":
        _write_ply(path, vertices, triangles, normals, colors, labels)
        return
    if not len(triangles):
        raise FormatError(f"{path}: the mesh has no triangles, and OBJ and GLB files cannot be empty; PLY files can")
    data = _of_trimesh(path, vertices, triangles, normals, colors, labels, names or {}, z_up)
    write_bytes(path, data)


def _write_ply(
    path: str | Path, vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray | None,
    colors: np.ndarray | None, labels: np.ndarray | None,
) -> None:  # fmt: skip
    part = PlyPart(vertices, triangles, normals, colors, labels)
    write_ply_mesh(path, lambda: iter([part]), len(vertices), len(triangles))


@dataclass(frozen=True)
class PlyPart:
    """Rows of a PLY file's mesh, see `write_mesh`: vertices that follow those of the part before, and triangles.

    Attributes:
        triangles: int [F, 3], rows of vertices among those of all parts.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    labels: np.ndarray | None = None


def write_ply_mesh(path: str | Path, parts: Callable[[], Iterator[PlyPart]], vertices: int, triangles: int) -> None:
    """Writes the PLY file of `write_mesh` part by part, so that the mesh is never all in memory.

    Args:
        path: of the file.
        parts: gives the parts, each with the same of normals, colours and labels; is called several times.
        vertices, triangles: of all parts together.

    Raises:
        RunFolderError: the file cannot be written.
    """
    stored = np.result_type(np.float32, *(stored_positions(part.vertices).dtype for part in parts()))
    first = next(parts(), PlyPart(np.zeros((0, 3)), np.zeros((0, 3), np.int32)))
    faces = np.dtype([("vertex_indices", np.int32, (3,))])
    elements = {
        "vertex": RowParts(vertices, _rows_of(first, stored).dtype, (_rows_of(part, stored) for part in parts())),
        "face": RowParts(triangles, faces, (_faces_of(part, faces) for part in parts())),
    }
    write_ply_elements(path, elements)


def _rows_of(part: PlyPart, stored: np.dtype) -> np.ndarray:
    columns: dict[str, np.ndarray] = dict(zip("xyz", part.vertices.T.astype(stored), strict=True))
    if part.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), part.normals.T.astype(np.float32), strict=True))
    if part.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), part.colors.T.astype(np.uint8), strict=True))
    if part.labels is not None:
        columns["object_id"] = part.labels.astype(np.uint16)
    rows = np.empty(len(part.vertices), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _faces_of(part: PlyPart, dtype: np.dtype) -> np.ndarray:
    faces = np.empty(len(part.triangles), dtype)
    faces["vertex_indices"] = part.triangles
    return faces


def _trimesh(path: str | Path) -> ModuleType:
    return package_for(path, "trimesh", "mesh", otherwise="write a .ply")


def _of_trimesh(
    path: str | Path, vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray | None,
    colors: np.ndarray | None, labels: np.ndarray | None, names: Mapping[int, str], z_up: bool,
) -> bytes:  # fmt: skip
    trimesh, is_glb = _trimesh(path), Path(path).suffix.lower() == ".glb"
    origin = local_origin(vertices[0]) if is_glb else np.zeros(3)
    if origin.any():
        vertices = vertices - origin

    def geometry(chosen: np.ndarray) -> Any:
        used, corners = np.unique(chosen, return_inverse=True)
        own = None if colors is None else colors[used]
        return trimesh.Trimesh(
            vertices=vertices[used], faces=corners.reshape(-1, 3), process=False,
            vertex_normals=None if normals is None else normals[used], vertex_colors=None if is_glb else own,
            vertex_attributes={_CUSTOM: vertex_colors(own / 255)} if is_glb and own is not None else None,
        )  # fmt: skip

    if not is_glb:
        text: str = geometry(triangles).export(file_type="obj", include_normals=normals is not None)
        return text.encode("utf-8")
    scene, of_triangle = trimesh.Scene(), np.zeros(len(triangles), np.uint16)
    if labels is not None:
        of_triangle = majority_labels(labels, triangles)
    for label in np.unique(of_triangle).tolist():
        name = _node_name(label, names) if labels is not None else "mesh"
        part = geometry(triangles[of_triangle == label])
        T_gltf_mesh = (GLTF_FROM_Z_UP if z_up else GLTF_AXES) @ translation(origin)
        scene.add_geometry(part, node_name=name, geom_name=name, transform=T_gltf_mesh)
    data: bytes = scene.export(file_type="glb", include_normals=normals is not None, tree_postprocessor=_finish_gltf)
    return data


def _finish_gltf(tree: dict[str, Any]) -> None:
    """Names the colours as glTF does, and gives all triangles their material."""
    tree["materials"] = [MATERIAL]
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), *MATERIAL["extensions"]})
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
            if _CUSTOM in primitive["attributes"]:
                number = primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop(_CUSTOM)
                tree["accessors"][number]["normalized"] = True


def _node_name(label: int, names: Mapping[int, str]) -> str:
    if label == 0:
        return "unlabelled"
    return f"{label} {names[label]}" if label in names else f"object {label}"


def _write(path: Path, mesh: SurfaceMesh) -> str:
    write_mesh(
        path, mesh.vertices, mesh.triangles, mesh.normals, mesh.colors, mesh.labels, mesh.names, mesh.z_up
    )  # fmt: skip
    return mesh.text(path)


WRITER = Writer(
    "mesh", (".glb", ".obj", ".ply"), Takes.MESH, "the surface as .glb, .obj or .ply", _write, by_object=True,
    check=check_mesh_path,
)  # fmt: skip
