# SPDX-License-Identifier: Apache-2.0
"""More streams of the reference encoder decode exactly: a room of a million points, and a stream of every tool."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from ggslam.coding import decode_cloud
from ggslam.coding.stream import read_stream

LARGE = ["room_1m_qp22", "room_1m_qp10_4slices", "dense_noise_qp22"]
TOOLS = ["axis_order_zyx", "bypass", "coding_scale_half", "colour_matrix_ycgco", "ctc_raht", "entropy_continuation",
         "entropy_streams", "geometry_qp", "idcm1", "idcm3", "lifting", "planar", "pred_transform", "predgeom", "qtbt",
         "reference_defaults", "tiles"]  # fmt: skip
CLOUDS = ["angel10", "lidar_mm_neg"]


def digest_of(data: bytes) -> str:
    """SHA-256 of the decoded rows x y z r g b, sorted by all columns."""
    cloud = decode_cloud(data)
    columns = [np.rint(cloud.points), *(values.reshape(len(cloud), -1) for values in cloud.attributes.values())]
    rows = np.concatenate([np.asarray(column, "<i4") for column in columns], 1)
    return hashlib.sha256(rows[np.lexsort(rows.T[::-1])].tobytes()).hexdigest()


@pytest.mark.parametrize("name", [*LARGE, *(f"{tool}__{cloud}" for tool in TOOLS for cloud in CLOUDS)])
def test_the_reference_encoders_streams_decode_exactly(gpcc_data: Path, name: str) -> None:
    folder = gpcc_data / "golden_more"
    if not folder.is_dir():
        pytest.skip(f"no streams at {folder}")
    expected = json.loads((folder / "manifest.json").read_text())[name]
    assert digest_of((folder / f"{name}.bin").read_bytes()) == expected["sha256"]


@pytest.mark.parametrize(("name", "digest"), [
    ("random", "0409be22650c2838b35a8f16e127db5cc2f738bd587db2f308902e67aa5a11b9"),
    ("by_density", "c035b5c0e24de58e253979819d57804d87b443c3869bfe575ebdfecd04f8dbfb"),
])  # fmt: skip
def test_quantisers_of_single_nodes_are_read(name: str, digest: str) -> None:
    """Of the reference encoder: nodes of 16 voxels a side with quantisers of their own; by density with planes."""
    assert digest_of((Path(__file__).parent / "data" / f"geometry_qp_{name}.bin").read_bytes()) == digest


def test_streams_of_the_first_version_are_still_read() -> None:
    """One slice of 96,000 points with ids, its place in the world in private data."""
    data = (Path(__file__).parent / "data" / "first_version.bin").read_bytes()
    cloud = decode_cloud(data)
    assert cloud.quantization.voxel_size == 0.02
    columns = [np.rint(1000 * cloud.points), cloud.attributes["color"], cloud.attributes["object_id"][:, None]]
    digest = hashlib.sha256(np.concatenate(columns, 1).astype("<i4").tobytes()).hexdigest()
    assert digest == "d5ec7f5728c2d2e5997b3d2c66796775187c1aae36dbc02d50c6627eacf6b22d"
    assert read_stream(data).first_version and not read_stream(data.replace(b"ggslam-1", b"ggslam-2")).first_version
