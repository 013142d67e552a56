# SPDX-License-Identifier: Apache-2.0
"""Reads Gaussians of glTF 2.0 with KHR_gaussian_splatting, `.glb` and `.gltf`; `gaussian_gltf` writes them.

Every primitive with the extension is taken, moved as the nodes above it say. Attributes are float32, or whole numbers
that stand for 0 to 1 or -1 to 1, as the extension allows. Primitives that KHR_gaussian_splatting_compression_spz
packs are read as SPZ.
"""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.splat_columns import SplatColumns, check_count
from ggslam.formats.splat_reader import read_whole
from ggslam.formats.splat_repair import columns_of, logarithms_of, logits_of
from ggslam.formats.spz_reading import spz_columns
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, member, open_untrusted, read_untrusted

EXTENSION = "KHR_gaussian_splatting"
_SPZ = "KHR_gaussian_splatting_compression_spz_2"
_SPZ_NAMES = (_SPZ, "KHR_gaussian_splatting_compression_spz", "KHR_spz_gaussian_splats_compression")
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class GltfTuning(Tuning):
    """A limit on damaged files."""

    max_nodes = 100_000
    """Most nodes of a scene."""


_DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError, struct.error)


@dataclass(frozen=True)
class _Document:
    """The JSON part and the bytes of the buffers."""

    path: Path
    gltf: dict[str, Any]
    buffers: list[bytes]

    def view(self, number: int) -> tuple[bytes, int]:
        """The bytes of a view, and its stride; 0: there is none."""
        view = self.gltf["bufferViews"][number]
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        data = self.buffers[view["buffer"]][start : start + length]
        if start < 0 or length < 0 or len(data) < length:
            raise ValueError("a view reaches beyond its buffer")
        return data, int(view.get("byteStride", 0))

    def numbers(self, accessor: int) -> np.ndarray:
        """float64 [N, k] of an accessor."""
        found = self.gltf["accessors"][accessor]
        if "sparse" in found:
            raise ValueError("sparse accessors are not read")
        dtype, width, count = np.dtype(_TYPES[found["componentType"]]), _WIDTHS[found["type"]], int(found["count"])
        data, stride = self.view(found["bufferView"])
        start, step = int(found.get("byteOffset", 0)), stride or width * dtype.itemsize
        if count < 0 or start < 0 or (count and start + (count - 1) * step + width * dtype.itemsize > len(data)):
            raise ValueError("an accessor reaches beyond its view")
        with np.errstate(invalid="ignore"):  # of signalling NaN
            rows = np.ndarray((count, width), dtype, data, start, (step, dtype.itemsize)).astype(np.float64)
        if dtype.kind != "f" and found.get("normalized"):
            rows = np.maximum(rows / np.iinfo(dtype).max, -1.0)
        return rows


def read_gaussian_gltf(path: Path) -> tuple[SplatColumns, dict[int, str] | None]:
    """The Gaussians of a file, y down and z forward, and the names of objects by id (None: there are no ids).

    Raises:
        FormatError: it is damaged, or holds no Gaussians.
    """
    try:
        document = _open(path)
        parts, names, count = [], dict[int, str](), 0
        held = sum(map(len, document.buffers))
        for T, primitive, mesh in _primitives(document.gltf):
            columns = _columns(document, primitive)
            count += len(columns)
            check_count(count, held)
            columns.move_by(T)
            parts.append(columns)
            names |= {int(k): str(v) for k, v in mesh.get("extras", {}).get("objects", {}).items()}
        if not parts:
            raise ValueError(f"it holds no Gaussians ({EXTENSION}); meshes are not read as maps")
        if len({part.sh.shape[1] for part in parts}) > 1:
            parts = [_with_coefficients(part, max(p.sh.shape[1] for p in parts)) for part in parts]
        columns = SplatColumns.join(parts)
    except FormatError as error:
        raise (error if str(path) in str(error) else FormatError(f"{path}: {error}")) from None
    except _DAMAGE as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else f"{error}"
        raise FormatError(f"{path}: not a glTF of Gaussians that can be read: {reason}") from None
    columns.turn_upright()
    return columns, names if names or columns.object_id.any() else None


def _open(path: Path) -> _Document:
    data = read_untrusted(path)
    binary = b""
    if data[:4] == b"glTF":
        version, total, length, kind = struct.unpack_from("<4xIII4s", data)
        if version != 2 or kind != b"JSON" or total > len(data):
            raise ValueError("no whole GLB of version 2")
        text, start = data[20 : 20 + length], 20 + length
        if start + 8 <= total:
            size, kind = struct.unpack_from("<I4s", data, start)
            binary = data[start + 8 : start + 8 + size] if kind == b"BIN\0" else b""
    else:
        text = data
    if len(text) > FileTuning.max_text_bytes:
        raise ValueError("its JSON part is too large")
    gltf = json.loads(text)
    buffers = [_buffer(path, buffer, binary) for buffer in gltf.get("buffers", [])]
    return _Document(path, gltf, buffers)


def _buffer(path: Path, buffer: dict[str, Any], binary: bytes) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        return binary
    if str(uri).startswith("data:"):
        return base64.b64decode(str(uri).partition(",")[2], validate=True)
    return read_untrusted(member(path.parent, str(uri)))


def _primitives(gltf: dict[str, Any]) -> list[tuple[np.ndarray, dict[str, Any], dict[str, Any]]]:
    """T_scene_mesh [4, 4], primitive and mesh of all Gaussians of the scene."""
    nodes, found = gltf.get("nodes", []), list[tuple[np.ndarray, dict[str, Any], dict[str, Any]]]()
    scenes = gltf.get("scenes") or [{"nodes": list(range(len(nodes)))}]
    waiting = [(np.eye(4), number) for number in scenes[gltf.get("scene", 0)].get("nodes", [])]
    for _ in range(GltfTuning.max_nodes):
        if not waiting:
            return found
        T, number = waiting.pop()
        node = nodes[number]
        T = T @ _matrix(node)
        waiting += [(T, child) for child in node.get("children", [])]
        if "mesh" in node:
            mesh = gltf["meshes"][node["mesh"]]
            found += [(T, p, mesh) for p in mesh["primitives"] if EXTENSION in p.get("extensions", {})]
    raise ValueError("its nodes go in a circle")


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """A node's own transform [4, 4]."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    T = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    scale = np.array(node.get("scale", (1, 1, 1)), np.float64)
    T[:3, :3] = quaternion_to_matrix(np.array([[w, x, y, z]], np.float64))[0] * scale
    T[:3, 3] = node.get("translation", (0, 0, 0))
    return T


def _columns(document: _Document, primitive: dict[str, Any]) -> SplatColumns:
    """The Gaussians of a primitive in its own axes."""
    extension, attributes = primitive["extensions"][EXTENSION], primitive["attributes"]
    for name in _SPZ_NAMES:
        for holder in (extension.get("extensions", {}), primitive["extensions"]):
            if name in holder:
                columns = spz_columns(document.path, document.view(holder[name]["bufferView"])[0])
                columns.turn_upright()
                return columns

    def of(name: str, width: int) -> np.ndarray:
        values = document.numbers(attributes[name if name in attributes else f"{EXTENSION}:{name}"])
        if values.shape[1] != width:
            raise ValueError(f"{name} has {values.shape[1]} numbers a Gaussian, expected {width}")
        return values

    means = of("POSITION", 3)
    known = [name for name in attributes if "SH_DEGREE_" in name]
    degree = max((int(name.partition("SH_DEGREE_")[2][0]) for name in known), default=-1)
    if degree > 3:
        degree = 3
    names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    sh = [of(name, 3) for name in names] or [np.zeros((len(means), 3))]
    ids = of("_FEATURE_ID_0", 1)[:, 0] if "_FEATURE_ID_0" in attributes else None
    parts = (means, of("SCALE", 3), of("ROTATION", 4), of("OPACITY", 1), *sh)
    if len({len(part) for part in parts}) != 1 or (ids is not None and len(ids) != len(means)):
        raise ValueError("its attributes are not all of the same Gaussians")
    return columns_of(
        means, logarithms_of(parts[1]), np.roll(parts[2], 1, axis=1), logits_of(parts[3][:, 0]), np.stack(sh, 1), ids
    )


def _with_coefficients(columns: SplatColumns, count: int) -> SplatColumns:
    sh = np.zeros((len(columns), count, 3), np.float32)
    sh[:, : columns.sh.shape[1]] = columns.sh
    return SplatColumns(
        columns.means, columns.log_scales, columns.quaternions, columns.logits, sh, columns.object_id
    )


def _is_gltf_of_splats(path: Path, head: bytes) -> bool:
    """Whether the JSON part of a glTF names the extension: one without it is a mesh."""
    if head[:4] != b"glTF" and path.suffix.lower() != ".gltf":
        return False
    try:
        with open_untrusted(path) as file:
            length = struct.unpack_from("<I", file.read(20), 12)[0] if head[:4] == b"glTF" else 0
            file.seek(20 if head[:4] == b"glTF" else 0)
            text = file.read(min(length, 64 << 20) if length else 64 << 20)
        return EXTENSION in json.loads(text).get("extensionsUsed", []) or EXTENSION.encode() in text
    except (OSError, ValueError, AttributeError, struct.error, RecursionError, FormatError):
        return False


READER = read_whole("glTF", _is_gltf_of_splats, read_gaussian_gltf)
