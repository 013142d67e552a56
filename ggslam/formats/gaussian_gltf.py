# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as binary glTF 2.0 with KHR_gaussian_splatting, the Khronos Group's extension.

One primitive of POINTS with float32 attributes: position, standard deviations (metres), quaternion xyzw, opacity, and
spherical harmonics by degree and order; COLOR_0 (linear, 16 bits) is what programs without the extension show. glTF
takes y for upwards, so the map (y down, z forward at the first camera) is turned by 180 degrees about x on the way,
spherical harmonics included, and lies on the mesh of the same map. Object ids are the first set of feature ids of
EXT_mesh_features, 0 for none; their names are in `extras.objects` of the mesh.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.linear_light import vertex_colors
from ggslam.formats.splat_columns import MAX_FLOAT_ID, SplatColumns
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.system.atomic import atomic_write

_EXTENSION = "KHR_gaussian_splatting"
_FLOAT: Final = 5126
"""OpenGL's number of float32."""
_USHORT: Final = 5123
"""OpenGL's number of uint16."""
_ARRAY_BUFFER: Final = 34962
"""OpenGL's number of a buffer of vertex attributes."""
_POINTS: Final = 0
"""glTF's drawing mode for points."""
_WIDEST_CORNER = [[-1.2345678901234567e-308] * 3] * 2
"""As long as corners get in JSON."""
_LARGEST_FILE: Final = 2**32 - 1
"""Largest file in bytes: GLB counts them in 32 bits."""


@dataclass(frozen=True)
class _Attribute:
    """A column of the file: what glTF calls it, numbers a Gaussian, their type, and where it begins."""

    name: str
    width: int
    dtype: np.dtype
    start: int

    def accessor(self, view: int, count: int) -> dict[str, Any]:
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[self.width]
        whole = self.dtype.kind == "u"
        component = {"componentType": _USHORT, "normalized": True} if whole else {"componentType": _FLOAT}
        return {"bufferView": view, **component, "count": count, "type": kind}

    def view(self, count: int) -> dict[str, Any]:
        length = count * self.width * self.dtype.itemsize
        return {"buffer": 0, "byteOffset": self.start, "byteLength": length, "target": _ARRAY_BUFFER}


def write_gaussian_gltf(
    path: str | Path, count: int, parts: Iterable[GaussianMap], sh_degree: int,
    objects: Mapping[int, str] | None = None,
) -> None:  # fmt: skip
    """Writes a map that comes in parts, of which one is in memory at a time; whole or not at all.

    Args:
        path: the file to write; ends in .glb.
        count: Gaussians of all parts together, at least one.
        parts: in the order of the file.
        sh_degree: of all parts, 0 to 3.
        objects: names by object id, empty where an object has none; None: no object ids are written.

    Raises:
        FormatError: there is no Gaussian, a number is not finite, an object id is too large, or the file would be
            larger than a GLB can be (4 GB).
        ValueError: another number of Gaussians than `count`.
        RunFolderError: the file cannot be written.
    """
    if not count:
        raise FormatError(f"{path}: glTF needs at least one Gaussian")
    attributes, size = _layout(count, sh_degree, objects is not None)
    room = len(_text(attributes, count, size, objects, _WIDEST_CORNER))
    total = 28 + room + size
    if total > _LARGEST_FILE:
        raise FormatError(f"{path}: {count} Gaussians take {total / 1e9:.1f} GB, GLB holds 4; write a PLY")
    low, high, done = np.full(3, np.inf), np.full(3, -np.inf), 0
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        for part in parts:
            columns = _columns(path, part, objects is not None)
            if done + len(part) <= count:
                _put(file, attributes, columns, done, 28 + room)
            low, high = np.fmin(low, columns["POSITION"].min(0)), np.fmax(high, columns["POSITION"].max(0))
            done += len(part)
        if done != count:
            raise ValueError(f"{path}: {done} Gaussians were given, {count} were announced")
        text = _text(attributes, count, size, objects, [low.tolist(), high.tolist()]).ljust(room)
        file.seek(0)
        file.write(struct.pack("<4sIII4s", b"glTF", 2, total, room, b"JSON") + text)
        file.write(struct.pack("<I4s", size, b"BIN\0"))
        file.truncate(total)


def _layout(count: int, sh_degree: int, with_objects: bool) -> tuple[list[_Attribute], int]:
    """The attributes, and the bytes that they take. All begin at multiples of four."""
    shapes = [("POSITION", 3, "<f4"), ("COLOR_0", 4, "<u2")]
    shapes += [(f"{_EXTENSION}:{name}", k, "<f4") for name, k in (("ROTATION", 4), ("SCALE", 3), ("OPACITY", 1))]
    shapes += [(name, 3, "<f4") for name in _harmonics(sh_degree)]
    shapes += [("_FEATURE_ID_0", 1, "<f4")] if with_objects else []
    out, start = [], 0
    for name, width, kind in shapes:
        out.append(_Attribute(name, width, np.dtype(kind), start))
        start += count * width * np.dtype(kind).itemsize
    return out, start


def _harmonics(sh_degree: int) -> list[str]:
    return [f"{_EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(sh_degree + 1) for n in range(2 * d + 1)]


def _text(
    attributes: list[_Attribute], count: int, size: int, objects: Mapping[int, str] | None, corners: list[list[float]]
) -> bytes:
    """The JSON part, a multiple of four bytes; positions lie between the corners."""
    accessors = [attribute.accessor(view, count) for view, attribute in enumerate(attributes)]
    accessors[0] |= {"min": corners[0], "max": corners[1]}
    extensions: dict[str, Any] = {_EXTENSION: {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }}  # fmt: skip
    mesh: dict[str, Any] = {}
    if objects is not None:
        ids = {"featureCount": max(objects, default=0) + 1, "attribute": 0, "nullFeatureId": 0, "label": "object_id"}
        extensions["EXT_mesh_features"] = {"featureIds": [ids]}
        mesh["extras"] = {"objects": {str(number): name for number, name in objects.items()}}
    named = {attribute.name: number for number, attribute in enumerate(attributes)}
    mesh["primitives"] = [{"attributes": named, "mode": _POINTS, "extensions": extensions}]
    text = json.dumps({
        "asset": {"version": "2.0", "generator": "ggslam"}, "extensionsUsed": list(extensions), "scene": 0,
        "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "map"}], "meshes": [mesh],
        "buffers": [{"byteLength": size}], "bufferViews": [attribute.view(count) for attribute in attributes],
        "accessors": accessors,
    }, separators=(",", ":"), allow_nan=False).encode()  # fmt: skip
    return text + b" " * (-len(text) % 4)


def _columns(path: str | Path, gaussians: GaussianMap, with_objects: bool) -> dict[str, np.ndarray]:
    """What is stored of some Gaussians, by attribute."""
    columns = SplatColumns.of(path, gaussians)
    columns.turn_upright()
    opacity = 0.5 + 0.5 * np.tanh(0.5 * columns.logits.astype(np.float64))
    scales = np.exp(columns.log_scales.astype(np.float64))
    if scales.max() > np.finfo(np.float32).max:
        raise FormatError(f"{path}: a Gaussian is too large for float32")
    rgb = (0.5 + SH_C0 * columns.sh[:, 0].astype(np.float64)).clip(0, 1)
    out = {
        "POSITION": columns.means, "COLOR_0": vertex_colors(rgb, opacity),
        f"{_EXTENSION}:ROTATION": np.roll(columns.quaternions, -1, axis=1), f"{_EXTENSION}:SCALE": scales,
        f"{_EXTENSION}:OPACITY": opacity,
    }  # fmt: skip
    out |= dict(zip(_harmonics(gaussians.sh_degree), columns.sh.transpose(1, 0, 2), strict=True))
    if with_objects:
        ids = columns.object_id
        if len(ids) and (ids.min() < 0 or ids.max() > MAX_FLOAT_ID):
            raise FormatError(f"{path}: object ids are 0 to {MAX_FLOAT_ID} in glTF, found {ids.min()} to {ids.max()}")
        out["_FEATURE_ID_0"] = ids
    return out


def _put(
    file: BinaryIO, attributes: list[_Attribute], columns: Mapping[str, np.ndarray], first: int, start: int
) -> None:
    """Writes some Gaussians to their places, those of row `first` on; the first attribute begins at `start`."""
    for attribute in attributes:
        file.seek(start + attribute.start + first * attribute.width * attribute.dtype.itemsize)
        file.write(columns[attribute.name].astype(attribute.dtype).tobytes())


def _write(path: Path, splats: Splats) -> str:
    write_gaussian_gltf(path, splats.count, splats.parts(), splats.like.sh_degree, splats.names)
    return splats.text(path, with_ids=True)


WRITER = Writer(
    "gltf", (".glb",), Takes.GAUSSIANS, "the same as glTF, .glb (without this option a .glb is a mesh)", _write,
    by_object=True, y_up=True,
)  # fmt: skip
