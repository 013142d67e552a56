# SPDX-License-Identifier: Apache-2.0
"""Maps to be written, and splat files as a program reads them that knows the formats from their descriptions alone."""

from __future__ import annotations

import json
import struct
import subprocess
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from ggslam.scene.gaussian_map import GaussianMap

C0 = 0.28209479177387814
DIRECTIONS = np.array([[0.3, -0.5, 0.8], [-0.7, 0.2, -0.1], [0.1, 0.9, 0.4]])
PLY_TYPES = {"float": "<f4", "uint": "<u4", "int": "<i4", "uchar": "u1"}
GLTF_TYPES = {5121: "u1", 5123: "<u2", 5126: "<f4"}
GLTF_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Splats:
    """What a file says of its Gaussians: means, log_scales [N, 3], quaternions wxyz [N, 4], opacities [N] from 0 to 1,
    sh [N, K, 3]."""

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    @staticmethod
    def of(gaussians: GaussianMap) -> Splats:
        return Splats(gaussians.means.numpy(), gaussians.log_scales.numpy(), gaussians.quaternions.numpy(),
                      gaussians.opacities.numpy(), gaussians.sh.numpy())  # fmt: skip

    def take(self, order: np.ndarray) -> Splats:
        return Splats(self.means[order], self.log_scales[order], self.quaternions[order], self.opacities[order],
                      self.sh[order])  # fmt: skip

    def covariances(self) -> np.ndarray:
        w, x, y, z = (self.quaternions / np.linalg.norm(self.quaternions, axis=1, keepdims=True)).T.astype(float)
        rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
        R = np.array(rows).transpose(2, 0, 1)
        return (R * np.exp(2 * self.log_scales.astype(float))[:, None, :]) @ R.transpose(0, 2, 1)

    def colors(self, direction: np.ndarray) -> np.ndarray:
        """[N, 3], seen along a direction."""
        x, y, z = direction / np.linalg.norm(direction)
        basis = np.array([
            C0, -0.4886025119 * y, 0.4886025119 * z, -0.4886025119 * x,
            1.0925484306 * x * y, -1.0925484306 * y * z, 0.3153915652 * (2 * z * z - x * x - y * y),
            -1.0925484306 * x * z, 0.5462742153 * (x * x - y * y),
            -0.5900435899 * y * (3 * x * x - y * y), 2.8906114426 * x * y * z,
            -0.4570457995 * y * (4 * z * z - x * x - y * y), 0.3731763326 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457995 * x * (4 * z * z - x * x - y * y), 1.4453057213 * z * (x * x - y * y),
            -0.5900435899 * x * (x * x - 3 * y * y),
        ])  # fmt: skip
        return 0.5 + np.einsum("k,nkc->nc", basis[: self.sh.shape[1]], self.sh)


def convert(command: list[str], *words: str | Path) -> None:
    """Runs splat-transform."""
    done = subprocess.run([*command, "-w", *map(str, words)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def small_map(degree: int, count: int = 600) -> GaussianMap:
    """A room of small Gaussians, each with its own shape, turn, colours, opacity and one of four objects (or none)."""
    generator = torch.Generator().manual_seed(11 + degree)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    out = GaussianMap(degree, 0, with_moments=False)
    rows = out.insert(
        2 * normal(count, 3), normal(count, 4), -4 + 0.7 * normal(count, 3), 1.5 * normal(count),
        torch.rand(count, 3, generator=generator),
        object_id=torch.randint(0, 5, (count,), generator=generator, dtype=torch.int32),
    )  # fmt: skip
    out.sh[rows, 1:] = 0.3 * normal(count, (degree + 1) ** 2 - 1, 3)
    return out


def ply_elements(path: Path) -> dict[str, np.ndarray]:
    """The elements of a binary PLY file without lists."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    counts: dict[str, int] = {}
    fields: dict[str, list[tuple[str, str]]] = {}
    for words in (line.split() for line in head.decode("ascii").splitlines()):
        if words[0] == "element":
            counts[words[1]], fields[words[1]] = int(words[2]), []
            name = words[1]
        elif words[0] == "property":
            fields[name].append((words[2], PLY_TYPES[words[1]]))
    out, start = {}, 0
    for name, count in counts.items():
        out[name] = np.frombuffer(body, np.dtype(fields[name]), count, start)
        start += out[name].nbytes
    assert start == len(body)
    return out


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
    return Splats(
        stack(rows, "x", "y", "z"), stack(rows, *(f"scale_{i}" for i in range(3))), quaternions, opacities, sh
    )  # fmt: skip


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

    quaternions = np.zeros((len(words), 4))
    largest = words["packed_rotation"] >> 30
    for row in range(len(words)):
        three = [(share("packed_rotation", 10, shift)[row] - 0.5) * np.sqrt(2) for shift in (20, 10, 0)]
        others = [i for i in range(4) if i != largest[row]]
        quaternions[row, others] = three
        quaternions[row, largest[row]] = np.sqrt(1 - np.square(three).sum())
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
    return Splats(found["POSITION"], log_scales, np.stack([w, x, y, z], 1), found[f"{prefix}OPACITY"][:, 0], sh)


def sog_files(path: Path) -> dict[str, bytes]:
    """The files of a packed SOG, or of the folder of a meta.json."""
    if path.suffix == ".sog":
        with zipfile.ZipFile(path) as archive:
            assert archive.testzip() is None
            return {name: archive.read(name) for name in archive.namelist()}
    return {file.name: file.read_bytes() for file in path.parent.iterdir()}


def sog_pixels(data: bytes, count: int) -> np.ndarray:
    """The first pixels of a WebP image, row by row, RGBA [count, 4]."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    rgba = cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGBA)
    assert rgba.shape[0] * rgba.shape[1] >= count
    return rgba.reshape(-1, 4)[:count].astype(np.int64)


def from_sog(path: Path) -> Splats:
    """SOG, version 2, as its description says, but quaternions in the order wxyz, and logarithms of sizes in the table,
    as the programs of those who wrote it have them."""
    files = sog_files(path)
    meta = json.loads(files["meta.json"])
    assert meta["version"] == 2
    count = meta["count"]

    def pixels(part: str, number: int = 0, size: int = count) -> np.ndarray:
        return sog_pixels(files[meta[part]["files"][number]], size)

    steps = (pixels("means", 1) << 8 | pixels("means"))[:, :3] / 65535
    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    logs = low + (high - low) * steps
    quats = pixels("quats")
    three = (quats[:, :3] / 255 - 0.5) * np.sqrt(2)
    assert (quats[:, 3] >= 252).all()
    quaternions = np.zeros((count, 4))
    for row, largest in enumerate(quats[:, 3] - 252):
        quaternions[row, [i for i in range(4) if i != largest]] = three[row]
        quaternions[row, largest] = np.sqrt(max(0, 1 - np.square(three[row]).sum()))
    sh0, table = pixels("sh0"), np.array(meta["sh0"]["codebook"])
    assert len(table) == len(meta["scales"]["codebook"]) == 256
    sh = table[sh0[:, :3]][:, None]
    if "shN" in meta:
        coefficients = [3, 8, 15][meta["shN"]["bands"] - 1]
        entries = pixels("shN", 0, 64 * coefficients * -(-meta["shN"]["count"] // 64))[:, :3]
        palette = np.array(meta["shN"]["codebook"])[entries].reshape(-1, coefficients, 3)
        labels = pixels("shN", 1)
        label = labels[:, 0] | labels[:, 1] << 8
        assert label.max() < meta["shN"]["count"] <= 65536
        sh = np.concatenate([sh, palette[label]], 1)
    log_scales = np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]]
    return Splats(np.sign(logs) * np.expm1(np.abs(logs)), log_scales, quaternions, sh0[:, 3] / 255, sh)
