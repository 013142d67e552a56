# SPDX-License-Identifier: Apache-2.0
"""places.npz with arrays that do not fit together or cannot be: one line that names the file, and no store."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.runs.folder import RunFolder

Change = Callable[[np.ndarray], np.ndarray]


def first(value: float) -> Change:
    def change(array: np.ndarray) -> np.ndarray:
        out = array.copy()
        out.flat[0] = value
        return out

    return change


CHANGES: list[tuple[str, Change, str]] = [
    ("surface_normals", lambda a: a[:-1], "'normals'"),
    ("surface_points", lambda a: a[:-1], "'normals'"),
    ("surface_counts", first(-1), "'counts'"),
    ("surface_counts", lambda a: a + 1, "surface: the counts"),
    ("surface_reach", first(np.inf), "'reach'"),
    ("surface_reach", first(1e30), "'reach'"),
    ("surface_poses", first(np.nan), "'poses'"),
    ("surface_poses", lambda a: a[:-1], "'poses'"),
    ("camera", first(np.inf), "'camera'"),
    ("camera", first(1e18), "'camera'"),
    ("camera", first(0.2), "'camera'"),
    ("camera", lambda a: a[:5], "'camera'"),
    ("loops_places_numbers", first(2**30), "out of bounds"),
    ("loops_places_numbers", first(-1), "'numbers'"),
    ("loops_poses", first(1e30), "'loops_poses'"),
    ("loops_places_points", first(np.nan), "'points'"),
]


@pytest.mark.parametrize(("name", "change", "words"), CHANGES, ids=[f"{n}-{k}" for k, (n, _, _) in enumerate(CHANGES)])
def test_a_store_is_not_made_of_them(
    name: str, change: Change, words: str, room_run: RunFolder, tmp_path: Path
) -> None:
    run = shutil.copytree(room_run.path, tmp_path / "run")
    arrays = dict(np.load(run / "places.npz"))
    arrays[name] = change(arrays[name])
    np.savez(run / "places.npz", **arrays)
    succeed("verify", run, "--accept")
    refuse(ggslam("submaps", run, "--out", tmp_path / "out.grid"), "places.npz: not the places of a run", words)
