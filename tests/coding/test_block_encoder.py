# SPDX-License-Identifier: Apache-2.0
"""Clouds that are coded block by block: the stream is that of the whole cloud."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ggslam.coding import AttributeSettings, CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.block_encoder import Block, BlockTuning, encode_blocks
from ggslam.coding.decoder import decode_in_parts
from ggslam.errors import ConfigError, FormatError
from ggslam.system.tuning import overridden

IDS = {"id": AttributeSettings(lossless=True)}


def cloud(count: int = 6000, integers: bool = False) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A curved surface and a plane across its longest side, with colours and ids; some points twice."""
    random = np.random.default_rng(3)
    u, v = random.random(count) * 4, random.random(count)
    points = np.stack([u, v, 0.2 * np.sin(5 * u)], 1)
    points[: count // 3, 0] = 1.5
    points[-20:] = points[:20]
    if integers:
        points = np.rint(500 * points).astype(np.int32)
    colors = (255 * np.stack([v, 1 - v, u / 4], 1)).astype(np.uint8)
    return points, {"color": colors, "id": (10 * u).astype(np.uint16) * 7}


def blocks(points: np.ndarray, attributes: dict[str, np.ndarray], size: int) -> Iterator[Block]:
    for begin in range(0, len(points), size):
        part = slice(begin, begin + size)
        yield points[part], {name: values[part] for name, values in attributes.items()}


@pytest.fixture(autouse=True)
def _small_blocks() -> Iterator[None]:
    with overridden(BlockTuning, rows_at_once=700):
        yield


@pytest.mark.parametrize(
    "settings",
    [
        CodecSettings(),
        CodecSettings(slices=7),
        CodecSettings(slices=200),
        CodecSettings(max_points=500, threads=1),
        CodecSettings(slices=5, split="interval", threads=3),
        CodecSettings(slices=40, split="interval", geometry_bits=4),  # some are empty
        CodecSettings(slices=3, split="interval", max_points=900),
        CodecSettings(slices=6, split="cube"),
        CodecSettings(slices=4, duplicates="keep", geometry_scale=0.3),
        CodecSettings(slices=4, box=((0.2, 0.1, -1), (3.0, 0.9, 1))),
    ],
)
def test_the_bytes_are_those_of_the_whole_cloud(settings: CodecSettings, tmp_path: Path) -> None:
    for integers in (False, True):
        points, attributes = cloud(integers=integers)
        settings = CodecSettings(**{**vars(settings), "attributes": IDS})
        whole = encode_cloud(points, attributes, settings)
        report = encode_blocks(blocks(points, attributes, 1234), settings, tmp_path / "cloud.bin")
        assert (tmp_path / "cloud.bin").read_bytes() == whole.data
        assert (report.input_points, report.points, report.total_bytes) == (6000, whole.report.points, len(whole.data))
        assert report.attribute_bytes == whole.report.attribute_bytes
        assert [path.name for path in tmp_path.iterdir()] == ["cloud.bin"]


def test_parts_of_a_stream_are_the_cloud() -> None:
    points, attributes = cloud()
    data = encode_cloud(points, attributes, CodecSettings(slices=5, attributes=IDS, metadata={"a": 1})).data
    whole, parts = decode_cloud(data), decode_in_parts(data, threads=2)
    found = list(parts.parts)
    assert len(found) == 5 and parts.count == len(whole) and len(parts.like) == 0
    assert np.array_equal(np.concatenate([part.points for part in found]), whole.points)
    for name, values in whole.attributes.items():
        assert np.array_equal(np.concatenate([part.attributes[name] for part in found]), values)
        assert parts.like.attributes[name].dtype == values.dtype
    assert parts.like.metadata == found[3].metadata == {"a": 1}


def test_what_cannot_be_coded(tmp_path: Path) -> None:
    points, attributes = cloud()
    out = tmp_path / "cloud.bin"
    with pytest.raises(FormatError, match="without points"):
        encode_blocks(iter([]), CodecSettings(), out)
    points[4000] = np.nan
    with pytest.raises(FormatError, match="finite"):
        encode_blocks(blocks(points, attributes, 1000), CodecSettings(slices=3), out)
    wide = {"far": np.arange(6000, dtype=np.int64) * 20}
    with pytest.raises(ConfigError, match="0 to 119980 do not fit in 16 bits"):
        encode_blocks(blocks(cloud()[0], wide, 1000), CodecSettings(slices=3), out)
    assert not list(tmp_path.iterdir())
