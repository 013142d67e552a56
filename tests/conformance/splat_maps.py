# SPDX-License-Identifier: Apache-2.0
"""Maps to be written, and splat files as a program reads them that knows the formats from their descriptions alone."""

from __future__ import annotations

import gzip
import json
import re
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.scene.gaussian_map import GaussianMap

C0 = 0.28209479177387814
DIRECTIONS = np.array([[0.3, -0.5, 0.8], [-0.7, 0.2, -0.1], [0.1, 0.9, 0.4]])
PLY_TYPES = {"float": "<f4", "float32": "<f4", "uint": "<u4", "int": "<i4", "int32": "<i4", "uchar": "u1",
             "uint8": "u1", "ushort": "<u2"}  # fmt: skip
GLTF_TYPES = {5121: "u1", 5123: "<u2", 5126: "<f4"}
GLTF_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Splats:
    """What a file says of its Gaussians: means, log_scales [N, 3], quaternions wxyz [N, 4], opacities [N] from 0 to 1,
    sh [N, K, 3]; object_ids [N], where it has any."""

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    object_ids: np.ndarray | None = None

    @staticmethod
    def of(gaussians: GaussianMap) -> Splats:
        return Splats(gaussians.means.numpy(), gaussians.log_scales.numpy(), gaussians.quaternions.numpy(),
                      gaussians.opacities.numpy(), gaussians.sh.numpy(), gaussians.object_id.numpy())  # fmt: skip

    def take(self, order: np.ndarray) -> Splats:
        ids = None if self.object_ids is None else self.object_ids[order]
        return Splats(self.means[order], self.log_scales[order], self.quaternions[order], self.opacities[order],
                      self.sh[order], ids)  # fmt: skip

    def covariances(self) -> np.ndarray:
        w, x, y, z = (self.quaternions / np.linalg.norm(self.quaternions, axis=1, keepdims=True)).T.astype(float)
        rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
        R = np.array(rows).transpose(2, 0, 1)
        return (R * np.exp(2 * self.log_scales.astype(float))[:, None, :]) @ R.transpose(0, 2, 1)

    def colors(self, directions: np.ndarray) -> np.ndarray:
        """[N, 3], seen along a direction [3], or each along its own [N, 3]; of any length."""
        x, y, z = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).T
        basis = np.broadcast_arrays(
            C0, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
            1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
            -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        )[: self.sh.shape[1]]  # fmt: skip
        return 0.5 + np.einsum("k...,...kc->...c", np.stack(basis), self.sh)


def convert(command: list[str], *words: str | Path) -> None:
    """Runs splat-transform."""
    done = subprocess.run([*command, "-w", *map(str, words)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def small_map(degree: int, count: int = 600, size: float = -4.0, channels: int = 0) -> GaussianMap:
    """A room of Gaussians, each with its own shape (`size`: logarithm, metres), turn, colours, opacity, one of four
    objects (or none) and, if there are channels, identity vector."""
    generator = torch.Generator().manual_seed(11 + degree)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    out = GaussianMap(degree, channels, with_moments=False)
    rows = out.insert(
        2 * normal(count, 3), normal(count, 4), size + 0.7 * normal(count, 3), 1.5 * normal(count),
        torch.rand(count, 3, generator=generator),
        object_id=torch.randint(0, 5, (count,), generator=generator, dtype=torch.int32),
    )  # fmt: skip
    out.sh[rows, 1:] = 0.3 * normal(count, (degree + 1) ** 2 - 1, 3)
    out.features[rows] = normal(count, channels)
    return out


def ply_elements(path: Path, lists: int = 0) -> dict[str, np.ndarray]:
    """The elements of a binary PLY file whose lists, if there are any, all have so many members."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    counts: dict[str, int] = {}
    fields: dict[str, list[tuple[Any, ...]]] = {}
    for words in (line.split() for line in head.decode("ascii").splitlines()):
        if words[0] == "element":
            counts[words[1]], fields[words[1]] = int(words[2]), []
            name = words[1]
        elif words[:2] == ["property", "list"]:
            fields[name] += [("length", PLY_TYPES[words[2]]), (words[4], PLY_TYPES[words[3]], lists)]
        elif words[0] == "property":
            fields[name].append((words[2], PLY_TYPES[words[1]]))
    out, start = {}, 0
    for name, count in counts.items():
        out[name] = np.frombuffer(body, np.dtype(fields[name]), count, start)
        start += out[name].nbytes
    assert start == len(body)
    return out


def ply_comments(path: Path) -> list[str]:
    """The comments of a PLY file."""
    head = path.read_bytes().split(b"end_header\n", 1)[0].decode()
    return [line.removeprefix("comment ") for line in head.splitlines() if line.startswith("comment ")]


def pcd_rows(path: Path) -> np.ndarray:
    """The points of a PCD file, text or binary, whose fields have one number each."""
    head, body = re.split(rb"(?<=\n)(?=DATA )", path.read_bytes(), maxsplit=1)
    encoding, body = body.split(b"\n", 1)
    words = {line.split()[0]: line.split()[1:] for line in head.decode("ascii").splitlines() if line[0] != "#"}
    assert set(words.get("COUNT", ["1"])) == {"1"}
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(words["TYPE"], words["SIZE"], strict=True)]
    dtype = np.dtype(list(zip(words["FIELDS"], kinds, strict=True)))
    count = int(words["POINTS"][0])
    if encoding == b"DATA ascii":
        return np.array([tuple(line.split()) for line in body.decode().splitlines()], dtype)
    assert encoding == b"DATA binary" and len(body) == count * dtype.itemsize
    return np.frombuffer(body, dtype)


def stack(rows: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([rows[name] for name in names], 1).astype(np.float64)


def from_ply(path: Path) -> Splats:
    """A 3DGS PLY."""
    rows = ply_elements(path)["vertex"]
    rest = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    base = stack(rows, "f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    higher = stack(rows, *(f"f_rest_{i}" for i in range(rest))) if rest else np.zeros((len(rows), 0))
    sh = np.concatenate([base, higher.reshape(len(rows), 3, -1).transpose(0, 2, 1)], 1)
    opacities = 1 / (1 + np.exp(-rows["opacity"].astype(float)))
    quaternions = stack(rows, *(f"rot_{i}" for i in range(4)))
    ids = rows["object_id"] if "object_id" in (rows.dtype.names or ()) else None
    return Splats(
        stack(rows, "x", "y", "z"), stack(rows, *(f"scale_{i}" for i in range(3))), quaternions, opacities, sh, ids
    )  # fmt: skip


def with_largest(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] of their three smaller numbers, in order, and the place of the largest, which is not
    negative."""
    out = np.zeros((len(three), 4))
    for place in range(4):
        rows = largest == place
        out[np.ix_(rows, [i for i in range(4) if i != place])] = three[rows]
        out[rows, place] = np.sqrt(np.maximum(0, 1 - np.square(three[rows]).sum(1)))
    return out


def from_compressed_ply(path: Path) -> Splats:
    """A compressed PLY."""
    elements = ply_elements(path)
    words, chunk = elements["vertex"], elements["chunk"][np.arange(len(elements["vertex"])) // 256]

    def share(name: str, bits: int, shift: int) -> np.ndarray:
        return (words[name] >> shift & (2**bits - 1)) / (2**bits - 1)

    def between(name: str, least: str, widths: tuple[int, int, int], shifts: tuple[int, int, int]) -> np.ndarray:
        columns = []
        for axis, bits, shift in zip(least.split(), widths, shifts, strict=True):
            low, high = chunk[f"min_{axis}"].astype(float), chunk[f"max_{axis}"].astype(float)
            columns.append(low + share(name, bits, shift) * (high - low))
        return np.stack(columns, 1)

    three = np.stack([(share("packed_rotation", 10, shift) - 0.5) * np.sqrt(2) for shift in (20, 10, 0)], 1)
    quaternions = with_largest(three, words["packed_rotation"] >> 30)
    colors = between("packed_color", "r g b", (8, 8, 8), (24, 16, 8))
    higher = np.zeros((len(words), 0, 3))
    if "sh" in elements:
        numbers = stack(elements["sh"], *(f"f_rest_{i}" for i in range(len(elements["sh"].dtype.names or ()))))
        levels = np.where(numbers == 0, 0, np.where(numbers == 255, 1, (numbers + 0.5) / 256))
        higher = ((levels - 0.5) * 8).reshape(len(words), 3, -1).transpose(0, 2, 1)
    return Splats(between("packed_position", "x y z", (11, 10, 11), (21, 11, 0)),
                  between("packed_scale", "scale_x scale_y scale_z", (11, 10, 11), (21, 11, 0)), quaternions,
                  share("packed_color", 8, 0), np.concatenate([((colors - 0.5) / C0)[:, None], higher], 1))  # fmt: skip


def glb_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and binary part of a GLB file, whose lengths fit."""
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
    size, what = struct.unpack_from("<I4s", data, 20 + length)
    assert what == b"BIN\0" and 28 + length + size == len(data) and length % 4 == size % 4 == 0
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def glb_attributes(path: Path) -> dict[str, np.ndarray]:
    """The attributes of the first primitive, as they are stored."""
    gltf, binary = glb_parts(path)
    out = {}
    for name, number in gltf["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = gltf["accessors"][number]
        view = gltf["bufferViews"][accessor["bufferView"]]
        assert "byteStride" not in view
        start, width = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), GLTF_WIDTHS[accessor["type"]]
        kind = np.dtype(GLTF_TYPES[accessor["componentType"]])
        assert start % 4 == 0 and kind.itemsize * width * accessor["count"] <= view["byteLength"]
        out[name] = np.frombuffer(binary, kind, width * accessor["count"], start).reshape(-1, width)
    return out


def from_glb(path: Path) -> Splats:
    """KHR_gaussian_splatting."""
    found = glb_attributes(path)
    prefix = "KHR_gaussian_splatting:"
    names = [f"{prefix}SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
    sh = np.stack([found[name] for name in names if name in found], 1)
    x, y, z, w = found[f"{prefix}ROTATION"].T
    with np.errstate(divide="ignore"):
        log_scales = np.log(found[f"{prefix}SCALE"])
    ids = found["_FEATURE_ID_0"][:, 0] if "_FEATURE_ID_0" in found else None
    opacities = found[f"{prefix}OPACITY"][:, 0]
    return Splats(found["POSITION"], log_scales, np.stack([w, x, y, z], 1), opacities, sh, ids)


def from_splat(path: Path) -> Splats:
    """A `.splat`: colours are the same from all sides."""
    row = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    rows = np.frombuffer(path.read_bytes(), row)
    with np.errstate(divide="ignore"):
        log_scales = np.log(rows["scale"])
    rgba = rows["rgba"] / 255
    sh = (rgba[:, None, :3] - 0.5) / C0
    return Splats(rows["position"], log_scales, (rows["rotation"] - 128.0) / 128, rgba[:, 3], sh)


def spz_streams(path: Path) -> list[bytes]:
    """The attributes of an SPZ file of version 3 or 4: positions, opacities, colours, sizes, quaternions and, if there
    are any, higher spherical harmonics."""
    data = path.read_bytes()
    if data[:4] != b"NGSP":
        data = gzip.decompress(data)
        assert struct.unpack_from("<4sI", data) == (b"NGSP", 3)
        count, degree = struct.unpack_from("<IB", data, 8)
        ends = np.cumsum([16, *(count * width for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if width)])
        assert ends[-1] == len(data)
        return [data[one:other] for one, other in zip(ends[:-1], ends[1:], strict=True)]
    zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed (extra [splats])")
    version, streams, start = *struct.unpack_from("<4xI", data), data[15], *struct.unpack_from("<I", data, 16)
    assert version == 4
    out, place = [], start + 16 * streams
    for number in range(streams):
        packed, size = struct.unpack_from("<QQ", data, start + 16 * number)
        out.append(zstandard.ZstdDecompressor().decompress(data[place : place + packed]))
        assert len(out[-1]) == size
        place += packed
    assert place == len(data)
    return out


def from_spz(path: Path) -> Splats:
    """SPZ, versions 3 and 4; fractions of positions have 12 bits."""
    positions, opacities, colors, sizes, rotations, *higher = (np.frombuffer(s, "u1") for s in spz_streams(path))
    count = len(opacities)
    parts = positions.reshape(-1, 3).astype(np.int32)
    means = (((parts[:, 2] << 24 | parts[:, 1] << 16 | parts[:, 0] << 8) >> 8) / 4096).reshape(-1, 3)
    words = rotations.view("<u4")
    three = np.stack([(words >> shift & 511) / 511 * np.sqrt(0.5) * np.where(words >> shift + 9 & 1, -1, 1)
                      for shift in (20, 10, 0)], 1)  # fmt: skip
    x, y, z, w = with_largest(three, words >> 30).T
    sh = [((colors.reshape(-1, 1, 3) / 255 - 0.5) / 0.15)]
    sh += [(values.reshape(count, -1, 3) - 128.0) / 128 for values in higher]
    log_scales = sizes.reshape(-1, 3) / 16 - 10
    return Splats(means, log_scales, np.stack([w, x, y, z], 1), opacities / 255, np.concatenate(sh, 1))
