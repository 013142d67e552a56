# SPDX-License-Identifier: Apache-2.0
"""Streamed SOG: the tree as the format's description has it, every run of rows where it says, and every level as
PlayCanvas' splat-transform reads it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sog_reader import from_sog
from splat_maps import Splats, convert, from_ply, small_map

from ggslam.errors import FormatError
from ggslam.formats.point_sampling import MapPart
from ggslam.formats.streamed_sog import StreamedSogTuning, write_streamed_sog
from ggslam.system.tuning import overridden

COUNT = 3000


@pytest.fixture(autouse=True)
def small_leaves() -> Iterator[None]:
    """A small map with a tree, several files of a level, and three levels."""
    with overridden(StreamedSogTuning, leaf=500, leaf_min=100, chunk=900, coarsest=200):
        yield


def parts_of(degree: int) -> list[MapPart]:
    """Two halves of a map and an empty part."""
    def half(side: int) -> Any:
        gaussians = small_map(degree, COUNT)
        gaussians.keep((gaussians.means[:, 0] >= 0) == bool(side))
        return gaussians

    corner = np.ones(3)
    return [
        MapPart(-9 * corner, 0 * corner, lambda: half(0)), MapPart(0 * corner, 9 * corner, lambda: half(1)),
        MapPart(9 * corner, 10 * corner, lambda: small_map(degree, 0)),
    ]  # fmt: skip


def leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Those below a node, which are within its bounds, in a binary tree."""
    assert ("children" in node) != ("lods" in node)
    if "lods" in node:
        yield node
        return
    assert len(node["children"]) == 2
    for side, choose in (("min", np.min), ("max", np.max)):
        corners = [child["bound"][side] for child in node["children"]]
        np.testing.assert_array_equal(choose(corners, 0), node["bound"][side])
    for child in node["children"]:
        yield from leaves(child)


@pytest.mark.parametrize("degree", [0, 2])
def test_streamed_sog(degree: int, tmp_path: Path) -> None:
    told: list[int] = []
    size = write_streamed_sog(tmp_path, parts_of(degree), COUNT, {1: "mug"}, told.append)
    index = json.loads((tmp_path / "lod-meta.json").read_text())
    assert index["version"] == 1 and index["lodLevels"] == 3 and told == [1, 2, 3]
    assert index["counts"] == list(size.counts) and index["count"] == sum(size.counts) and size.counts[0] == COUNT
    for finer, coarser in zip(size.counts, size.counts[1:], strict=False):
        assert 0.2 * finer < coarser < 0.3 * finer
    assert size.bytes == sum(file.stat().st_size for file in tmp_path.rglob("*") if file.is_file())
    files = [from_sog(tmp_path / name) for name in index["filenames"]]
    assert len(files) == size.chunks > 4 and index["objects"] == {"1": "mug"}
    taken: dict[int, list[tuple[int, int]]] = {}
    for leaf in leaves(index["tree"]):
        assert list(leaf["lods"]) == ["0", "1", "2"]
        for level, place in leaf["lods"].items():
            assert index["filenames"][place["file"]].startswith(f"{level}_")
            taken.setdefault(place["file"], []).append((place["offset"], place["count"]))
            rows = slice(place["offset"], place["offset"] + place["count"])
            means = files[place["file"]].means[rows]
            slack = 1e-3  # positions are rounded in the SOG
            assert (means > np.array(leaf["bound"]["min"]) - slack).all()
            assert (means < np.array(leaf["bound"]["max"]) + slack).all()
    for number, runs in taken.items():  # one after the other, without gaps
        ends = np.cumsum([count for _, count in runs])
        assert [offset for offset, _ in runs] == [0, *ends[:-1]] and ends[-1] == len(files[number].means)
    named = zip(index["filenames"], files, strict=True)
    finest = np.concatenate([file.means for name, file in named if name.startswith("0_")])
    written = Splats.of(small_map(degree, COUNT)).means
    nearest = np.linalg.norm(finest[:, None] - written[None], axis=2)
    assert nearest.min(1).max() < 1e-3 and nearest.min(0).max() < 1e-3


def test_levels_by_splat_transform(tmp_path: Path, splat_transform: list[str]) -> None:
    write_streamed_sog(tmp_path / "out", parts_of(1), COUNT)
    index = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    for level, count in enumerate(index["counts"]):
        seen_path = tmp_path / f"seen{level}.ply"
        convert(splat_transform, tmp_path / "out" / "lod-meta.json", "-L", str(level), seen_path)
        seen = from_ply(seen_path)
        own = [from_sog(tmp_path / "out" / name) for name in index["filenames"] if name.startswith(f"{level}_")]
        assert len(seen.means) == count
        np.testing.assert_allclose(seen.means, np.concatenate([file.means for file in own]), atol=1e-5)
        np.testing.assert_allclose(seen.sh, np.concatenate([file.sh for file in own]), atol=1e-6)


def test_the_same_again(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_streamed_sog(tmp_path / name, parts_of(1), COUNT)
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert len(files) > 20
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_what_no_stream_can_hold(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="at least one Gaussian"):
        write_streamed_sog(tmp_path / "none", parts_of(0)[2:], 0)
    with pytest.raises(FormatError, match="parts of the map have 2 and 0"):
        write_streamed_sog(tmp_path / "mixed", [parts_of(2)[0], parts_of(0)[1]], COUNT)
    broken = small_map(0, 50)
    broken.opacity_logits[3] = torch.nan
    with pytest.raises(FormatError, match="opacity of Gaussian 3"):
        write_streamed_sog(tmp_path / "broken", [MapPart(np.zeros(3), np.ones(3), lambda: broken)], 50)
    assert not (tmp_path / "broken" / "lod-meta.json").exists()
