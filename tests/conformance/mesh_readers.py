# SPDX-License-Identifier: Apache-2.0
"""Meshes as a program reads them that knows the formats from their descriptions alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from splat_maps import GLTF_TYPES, GLTF_WIDTHS, glb_parts, ply_elements, stack


@dataclass(frozen=True)
class Mesh:
    """vertices [V, 3], triangles [F, 3], colors [V, 3] (0 to 255), normals [V, 3], and of each vertex the name of its
    node, where there are nodes."""

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    normals: np.ndarray
    names: np.ndarray


def from_ply(path: Path) -> Mesh:
    elements = ply_elements(path, lists=3)
    rows = elements["vertex"]
    (lengths, triangles) = (elements["face"][name] for name in elements["face"].dtype.names or ())
    assert (lengths == 3).all()
    return Mesh(stack(rows, *"xyz"), triangles, stack(rows, "red", "green", "blue"), stack(rows, "nx", "ny", "nz"),
                np.empty(0, str))  # fmt: skip


def from_obj(path: Path) -> Mesh:
    """Wavefront OBJ with colours behind the positions, as most programs write and read them."""
    found: dict[str, list[list[str]]] = {"v": [], "vn": [], "f": []}
    for line in path.read_text().splitlines():
        kind, _, rest = line.partition(" ")
        if kind in found:
            found[kind].append(rest.split())
    vertices = np.array(found["v"], float)
    faces = np.array([[corner.split("/") for corner in face] for face in found["f"]])
    triangles, of_normals = faces[..., 0].astype(int) - 1, faces[..., -1].astype(int) - 1
    normals = np.zeros((len(vertices), 3))
    normals[triangles] = np.array(found["vn"], float)[of_normals]
    return Mesh(vertices[:, :3], triangles, 255 * vertices[:, 3:6], normals, np.empty(0, str))


def on_screen(light: np.ndarray) -> np.ndarray:
    """sRGB numbers of linear light, 0 to 1 both, by IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def from_glb(path: Path) -> Mesh:
    """glTF 2.0: the triangles of all nodes, turned as their nodes say; their colours as a screen gets them."""
    gltf, binary = glb_parts(path)

    def column(number: int) -> np.ndarray:
        accessor = gltf["accessors"][number]
        view = gltf["bufferViews"][accessor["bufferView"]]
        kind = np.dtype({**GLTF_TYPES, 5125: "<u4"}[accessor["componentType"]])
        start, width = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), GLTF_WIDTHS[accessor["type"]]
        assert "byteStride" not in view and "sparse" not in accessor
        return np.frombuffer(binary, kind, width * accessor["count"], start).reshape(-1, width)

    parts: list[list[np.ndarray]] = []
    count = 0
    waiting = [(node, np.eye(4)) for node in gltf["scenes"][gltf.get("scene", 0)]["nodes"]]
    while waiting:
        number, above = waiting.pop()
        node = gltf["nodes"][number]
        assert not {"translation", "rotation", "scale"} & set(node)
        T = above @ np.array(node.get("matrix", np.eye(4).ravel()), float).reshape(4, 4).T
        waiting += [(child, T) for child in node.get("children", [])]
        for primitive in gltf["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            assert primitive.get("mode", 4) == 4
            at = primitive["attributes"]
            vertices = column(at["POSITION"]) @ T[:3, :3].T + T[:3, 3]
            triangles = column(primitive["indices"]).reshape(-1, 3).astype(np.int64) + count
            names = np.full(len(vertices), node.get("name", ""))
            accessor = gltf["accessors"][at["COLOR_0"]]
            assert accessor["normalized"] and accessor["componentType"] == 5123
            colors = 255 * on_screen(column(at["COLOR_0"])[:, :3] / 65535)
            parts.append([vertices, triangles, colors, column(at["NORMAL"]) @ T[:3, :3].T, names])
            count += len(vertices)
    return Mesh(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
