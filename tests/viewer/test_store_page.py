# SPDX-License-Identifier: Apache-2.0
"""A store of submaps on a page: cells, levels, objects."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.errors import ConfigError, FormatError
from ggslam.jobs.view.serve import serve_store
from ggslam.jobs.view.store_page import StorePage
from ggslam.runs.folder import RunFolder


@pytest.fixture(scope="module")
def store(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stores") / "room.grid"
    succeed("submaps", run.path, "--out", path)
    return path


@pytest.fixture
def page(store: Path) -> Iterator[StorePage]:
    yield StorePage(store, "room")


def header_of(data: bytes) -> dict[str, object]:
    size = struct.unpack("<I", data[:4])[0]
    return json.loads(data[4 : 4 + size])


def test_cells_hold_all_of_the_map_and_levels_a_quarter_each(page: StorePage, run: RunFolder) -> None:
    scene = page.scene()
    total = len(run.gaussians())
    assert sum(chunk["count"] for chunk in scene["chunks"]) == total == sum(page.counts.values())
    largest = max(scene["chunks"], key=lambda chunk: chunk["count"])
    counts = largest["levels"]
    quarters = [max(200, count // 4) for count in counts[:-1]]
    assert counts[0] == largest["count"] and counts[1:] == quarters
    for level, count in enumerate(counts):
        header = header_of(page.splats(largest["id"], level))
        assert 0.95 * count <= header["count"] <= count  # without those that are too faint to be seen
        low, high = np.array(header["low"]), np.array(header["high"])
        assert (low >= np.array(largest["low"]) - 0.5).all() and (high <= np.array(largest["high"]) + 0.5).all()
    assert {o["id"] for o in scene["objects"]} == set(run.object_table().ids())
    assert set(scene["views"]) == {"Start", "Top"}


@pytest.mark.parametrize("chunk", ["", "map", "0_0", "9_9_9", "../x", "0_0_0; drop", "1e3_0_0"])
def test_what_is_no_cell_is_told(page: StorePage, chunk: str) -> None:
    with pytest.raises(ConfigError, match="no cell"):
        page.splats(chunk, 0)
    with pytest.raises(ConfigError, match="no level"):
        page.splats(next(iter(page.scene()["chunks"]))["id"], 99)


def test_it_is_only_looked_at(page: StorePage, store: Path) -> None:
    with pytest.raises(ConfigError, match="only looked at"):
        page.answer("edit", {})
    refuse(ggslam("view", store, "--html", "x.html"), "--html", "served only")
    server, served = serve_store(store, port=0)
    server.close()
    assert served.describe().endswith("shown near what is looked at")


def test_a_damaged_cell_is_told_and_the_others_are_shown(store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "damaged.grid"))
    page = StorePage(copy, "damaged")
    first, second = (chunk["id"] for chunk in page.scene()["chunks"][:2])
    for path in (copy / "cells" / first).rglob("gaussians.npz"):
        path.write_bytes(b"x")
    with pytest.raises(FormatError, match="gaussians.npz|cell"):
        StorePage(copy, "damaged").splats(first, 0)
    assert StorePage(copy, "damaged").splats(second, 0)
