# SPDX-License-Identifier: Apache-2.0
"""SOG, packed, in a folder and streamed, as a program reads it that knows the format from its description alone."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
from splat_maps import Splats, with_largest


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
    quaternions = with_largest(three, quats[:, 3] - 252)
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
    ids = pixels("objects") @ [1, 1 << 8, 1 << 16, 0] if "objects" in meta else None
    return Splats(np.sign(logs) * np.expm1(np.abs(logs)), log_scales, quaternions, sh0[:, 3] / 255, sh, ids)


def from_streamed_sog(folder: Path) -> Splats:
    """The finest level of a streamed SOG: level 0 of its files."""
    index = json.loads((folder / "lod-meta.json").read_text())
    parts = [from_sog(folder / name) for name in index["filenames"] if name.startswith("0_")]
    assert sum(len(part.means) for part in parts) == index["counts"][0]
    columns = ("means", "log_scales", "quaternions", "opacities", "sh")
    ids = [part.object_ids for part in parts if part.object_ids is not None]
    return Splats(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns),
                  np.concatenate(ids) if ids else None)  # fmt: skip
