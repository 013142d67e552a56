# SPDX-License-Identifier: Apache-2.0
"""Places in the cells of a store that came from elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.localization.places import PLACES, StoredPlaces, stored_views
from ggslam.loops.settings import PlaceSettings
from ggslam.scene.arrays import arrays_to_bytes
from ggslam.scene.camera import Camera
from ggslam.submaps.grid import GridStore

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
Arrays = dict[str, np.ndarray]


def some_places() -> Arrays:
    """Two views with three and four landmarks."""
    rng = np.random.default_rng(0)
    return {
        "poses": np.tile(np.eye(4), (2, 1, 1)), "counts": np.array([3, 4], np.int32),
        "codes": rng.integers(0, 16, (2, PlaceSettings().ferns)).astype(np.uint8),
        "descriptors": rng.integers(0, 256, (7, 32)).astype(np.uint8),
        "points": rng.uniform(1, 2, (7, 3)).astype(np.float32),
        "camera": np.array([64, 48, 50, 50, 31.5, 23.5]),
    }  # fmt: skip


def store_with(path: Path, arrays: Arrays) -> Path:
    with GridStore.create(path) as store:
        store.put((0, 0, 0), {PLACES: arrays_to_bytes(**arrays)})
    return path


def test_places_are_read(tmp_path: Path) -> None:
    with GridStore.open(store_with(tmp_path / "map.grid", some_places())) as store:
        places = StoredPlaces(store, CAMERA)
        assert len(places) == 2 and not places.damage
        assert [len(view.place.landmarks) for view in stored_views(store, (0, 0, 0), CAMERA)] == [3, 4]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("camera", lambda a: a * np.inf, "'camera': .*finite"),
        ("camera", lambda a: a[:5], "'camera': .*6"),
        ("poses", lambda a: a * np.nan, "'poses'"),
        ("poses", lambda a: 2 * a, "'poses': .*rotation"),
        ("poses", lambda a: a + 1e9, "'poses': .*within"),
        ("poses", lambda a: a[:1], "'counts': .*views|'poses'"),
        ("counts", lambda a: np.array([-1, 8], np.int32), "'counts': .*\\b0\\b"),
        ("counts", lambda a: np.array([2**30, 7], np.int32), "landmarks"),
        ("counts", lambda a: a.astype(float), "'counts': .*int"),
        ("points", lambda a: a * np.float32(np.nan), "'points': .*finite"),
        ("points", lambda a: a[:6], "'points': .*landmarks"),
        ("descriptors", lambda a: a.astype(np.int64), "'descriptors': .*uint8"),
        ("codes", lambda a: a[:, :, None], "'codes': .*uint8"),
    ],
)
def test_places_that_cannot_be_are_left_out_and_told(
    tmp_path: Path, name: str, change: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    arrays = some_places()
    arrays[name] = change(arrays[name])
    with GridStore.open(store_with(tmp_path / "map.grid", arrays)) as store:
        places = StoredPlaces(store, CAMERA)
        assert len(places) == 0 and len(places.damage) == 1
        with pytest.raises(FormatError, match=message):
            stored_views(store, (0, 0, 0), CAMERA)


def test_codes_of_other_settings_are_refused(tmp_path: Path) -> None:
    arrays = some_places()
    arrays["codes"] = arrays["codes"][:, :7]
    with GridStore.open(store_with(tmp_path / "map.grid", arrays)) as store, pytest.raises(FormatError, match="codes"):
        StoredPlaces(store, CAMERA)
