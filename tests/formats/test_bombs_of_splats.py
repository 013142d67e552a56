# SPDX-License-Identifier: Apache-2.0
"""Small files that claim, or repeat, more Gaussians than they can hold: refused before memory is taken."""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from little_memory import with_little_memory

from ggslam.errors import FormatError
from ggslam.formats.gaussian_gltf import write_gaussian_gltf
from ggslam.formats.sog import write_sog
from ggslam.formats.splat_formats import read_splats
from ggslam.scene.gaussian_map import GaussianMap

COUNT = 5000


@pytest.fixture
def gaussians() -> GaussianMap:
    random = torch.Generator().manual_seed(2)
    out = GaussianMap(0, with_moments=False)
    means, quaternions = (torch.randn((COUNT, width), generator=random) for width in (3, 4))
    out.insert(means, quaternions, torch.full((COUNT, 3), -4.0), 0.5, torch.rand((COUNT, 3), generator=random))
    return out


def test_a_sog_of_one_color(tmp_path: Path) -> None:
    """64 million Gaussians in five images of 2.6 kB each: some GB in memory."""
    side = 8000
    image = np.full((side, side, 4), 255, np.uint8)
    data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    assert len(data) < 10_000
    table = np.linspace(0, 1, 256).tolist()
    meta = {
        "version": 2, "count": side * side, "means": {"mins": [0] * 3, "maxs": [1] * 3, "files": ["a.webp", "b.webp"]},
        "scales": {"codebook": table, "files": ["c.webp"]}, "quats": {"files": ["d.webp"]},
        "sh0": {"codebook": table, "files": ["e.webp"]},
    }  # fmt: skip
    path = tmp_path / "bomb.sog"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name in "abcde":
            archive.writestr(f"{name}.webp", data)
    ended = with_little_memory(
        "from ggslam.formats.sog_reading import read_sog", "read_sog(path)", path, 300 << 20
    )
    assert ended.kind == "FormatError" and "it claims 64,000,000 Gaussians, which" in ended.message
    assert ended.taken < 20 << 20


def test_a_gltf_whose_nodes_share_a_mesh(gaussians: GaussianMap, tmp_path: Path) -> None:
    """A mesh of 5000 Gaussians at 2000 places: 10 million in a file of 300 kB; at 20 places they are read."""
    write_gaussian_gltf(tmp_path / "map.glb", COUNT, [gaussians], 0)
    data = (tmp_path / "map.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    gltf = json.loads(data[20 : 20 + length])
    (tmp_path / "map.bin").write_bytes(data[20 + length + 8 :])
    gltf["buffers"][0]["uri"] = "map.bin"
    for places in (20, 2000):
        gltf["nodes"] = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(places)]
        gltf["scenes"], gltf["scene"] = [{"nodes": list(range(places))}], 0
        (tmp_path / f"{places}.gltf").write_text(json.dumps(gltf))
    assert len(read_splats(tmp_path / "20.gltf")) == 20 * COUNT
    with pytest.raises(FormatError, match=r"2000\.gltf.* 1,05\d,\d{3} "):
        read_splats(tmp_path / "2000.gltf")


@pytest.mark.parametrize("kind", ["overlapping pieces", "one file many times"])
def test_a_streamed_sog_that_repeats_itself(kind: str, gaussians: GaussianMap, tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", gaussians)
    many = kind == "one file many times"
    nodes = [{"lods": {"0": {"file": k if many else 0, "offset": 0 if many else k, "count": COUNT - k}}}
             for k in range(100)]  # fmt: skip
    index = {"tree": {"children": nodes}, "filenames": ["a.sog"] * (100 if many else 1)}
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    with pytest.raises(FormatError, match="twice" if many else "more Gaussians than"):
        read_splats(tmp_path / "lod-meta.json")
    index["tree"]["children"] = nodes[:1]
    index["filenames"] = ["a.sog"]
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    assert len(read_splats(tmp_path / "lod-meta.json")) == COUNT
