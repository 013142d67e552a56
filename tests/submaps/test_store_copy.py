# SPDX-License-Identifier: Apache-2.0
"""Copies of stores hold what the index names, and no more than it says."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ggslam.errors import FormatError
from ggslam.submaps import store_copy
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store
from ggslam.submaps.store_objects import OBJECTS_FILE
from ggslam.submaps.visit_files import VISITS, read_visit, visit_file, write_visit

HUGE = 50 << 30
"""Bytes of a file of holes, which takes no room until it is copied."""


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "map.grid"
    with GridStore.create(path) as made:
        made.begin_visit("first")
        write_visit(made, b"{}")
        for x in range(3):
            made.put((x, 0, 0), {"points.pcd": bytes([x]) * 100, "gaussians.npz": b"g"})
    return path


def part(store: Path, x: int) -> Path:
    return next((store / "cells" / f"{x}_0_0").glob("*/points.pcd"))


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_what_the_index_does_not_name_is_not_copied(store: Path, tmp_path: Path) -> None:
    others = ["junk", "cells/junk", "cells/0_0_0/99/points.pcd", "visits/more.json", "refining/x", "volumes/mesh.ply"]
    for name in others:
        (store / name).parent.mkdir(parents=True, exist_ok=True)
        (store / name).write_bytes(b"")
        os.truncate(store / name, HUGE)
    copy_store(store, tmp_path / "copy.grid")
    assert not [name for name in others if (tmp_path / "copy.grid" / name).exists()]
    with GridStore.open(store) as old, GridStore.open(tmp_path / "copy.grid") as new:
        assert new.cells() == old.cells() and read_visit(new, "first") == b"{}"
        for key in old.cells():
            assert new.cell(key) == old.cell(key)
            assert all(new.get(key, name) == old.get(key, name) for name in old.cell(key).parts)


def test_a_part_of_another_size_is_copied_without_its_content(store: Path, tmp_path: Path) -> None:
    os.truncate(part(store, 1), HUGE)
    copy_store(store, tmp_path / "copy.grid")
    assert size_of(tmp_path / "copy.grid") < 200_000 and part(tmp_path / "copy.grid", 1).stat().st_size == 0
    with GridStore.open(tmp_path / "copy.grid") as copy:
        assert copy.get((2, 0, 0), "points.pcd") == b"\2" * 100 and copy.get((1, 0, 0), "gaussians.npz") == b"g"
        with pytest.raises(FormatError, match=r"\b0 bytes.*\b100\b"):
            copy.get((1, 0, 0), "points.pcd")


def test_a_part_larger_than_memory_is_copied_without_its_content(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_copy, "most_memory_bytes", lambda: 50)
    copy_store(store, tmp_path / "copy.grid")
    assert [part(tmp_path / "copy.grid", x).stat().st_size for x in range(3)] == [0, 0, 0]


@pytest.mark.parametrize("name", [OBJECTS_FILE, VISITS])
def test_a_huge_file_beside_the_cells_is_refused(store: Path, tmp_path: Path, name: str) -> None:
    path = visit_file(store, "first") if name == VISITS else store / name
    path.touch()
    os.truncate(path, HUGE)
    with pytest.raises(FormatError, match=rf"{path.name}: .*53,687,091,200 bytes"):
        copy_store(store, tmp_path / "copy.grid")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["map.grid"]


def test_a_part_of_another_size_is_not_read(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.truncate(part(store, 1), HUGE)
    monkeypatch.setattr("ggslam.submaps.cell_files.read_untrusted", lambda *_: pytest.fail("was read"))
    with GridStore.open(store) as opened, pytest.raises(FormatError, match=f"{HUGE} bytes"):
        opened.get((1, 0, 0), "points.pcd")
