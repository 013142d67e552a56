# SPDX-License-Identifier: Apache-2.0
"""Hidden folders beside what is being made."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ggslam.errors import RunFolderError
from ggslam.submaps.coming_store import coming_store
from ggslam.submaps.grid import GridStore
from ggslam.system.hidden_folder import hidden_beside

DEAD = 2**22 + 1
"""No process of Linux has this number."""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_left_overs_of_dead_programs_go_and_others_stay(tmp_path: Path) -> None:
    stay = [f".a-coming-{os.getpid()}-0123abcd", f".b-coming-{DEAD}-0123abcd", ".a-coming-1", "a-coming"]
    for name in (f".a-coming-{DEAD}-0123abcd", *stay):
        (tmp_path / name / "inside").mkdir(parents=True)
    with hidden_beside(tmp_path / "a") as hidden:
        assert names(tmp_path) == sorted(stay)
        hidden.mkdir()
    assert names(tmp_path) == sorted(stay)


def test_a_link_of_that_name_is_refused_and_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    (victim / "precious").mkdir(parents=True)
    (tmp_path / f".a-coming-{DEAD}-0123abcd").symlink_to(victim)
    with pytest.raises(RunFolderError, match="is a link"), hidden_beside(tmp_path / "a"):
        pass
    assert names(victim) == ["precious"]


def test_a_store_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "store"
    target.mkdir()  # empty: fine
    with pytest.raises(ZeroDivisionError), coming_store(target) as beside, GridStore.create(beside) as store:
        store.put((0, 0, 0), {"points.pcd": b"1"})
        raise ZeroDivisionError
    assert names(tmp_path) == ["store"] and names(target) == []
    with coming_store(target) as beside, GridStore.create(beside) as store:
        store.put((0, 0, 0), {"points.pcd": b"1"})
        assert names(target) == []
    with GridStore.open(target) as store:
        assert store.get((0, 0, 0), "points.pcd") == b"1"
    with pytest.raises(RunFolderError, match="not empty"), coming_store(target):
        pass
    assert names(tmp_path) == ["store"]
