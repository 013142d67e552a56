# SPDX-License-Identifier: Apache-2.0
"""What is recorded, when, and how it is thinned; clouds cut into cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import ConfigError, FormatError
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.submaps.cell_points import POINTS, changed_share, decode_points, encode_points, thin
from ggslam.submaps.cell_records import CellChange
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import SubmapRecorder, load_points, store_cloud
from ggslam.submaps.settings import SubmapSettings

SETTINGS = SubmapSettings(spacing=2.0, radius=0.8, refresh=300.0, sensor_range=5.0, voxel=0.0)
HERE = (5, 0, 0)
"""The cell of `pose()`."""


def pose(x: float = 10.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def cloud(count: int = 3000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-10, 20, (count, 3)).astype(np.float32)


@pytest.fixture
def store(tmp_path: Path) -> GridStore:
    return GridStore.create(tmp_path / "map.grid", SETTINGS)


def test_a_cell_is_recorded_near_its_centre_and_refreshed_after_its_time(store: GridStore) -> None:
    recorder = SubmapRecorder(store)
    points = cloud()
    assert recorder.record(pose(10.9), points, 0.0) is None and store.cells() == []
    assert recorder.record(pose(10.7), points, 0.0) == HERE
    assert recorder.cell_to_record(np.array([10.0, 0, 0]), 300.0) is None
    assert recorder.record(pose(), points, 300.0) is None and store.cell(HERE).version == 1
    assert recorder.cell_to_record(np.array([10.0, 0, 0]), 300.1) == HERE
    assert recorder.record(pose(), points, 300.1) == HERE
    assert store.cell(HERE).recorded_at == 300.1 and store.cell(HERE).version == 2
    patient = SubmapRecorder(store, SubmapSettings(spacing=2.0, radius=0.8, refresh=1e6))
    assert patient.record(pose(), points, 9000.0) is None
    with pytest.raises(ConfigError, match="3 m"):
        SubmapRecorder(store, SubmapSettings(spacing=3.0))


def test_what_is_within_range_is_recorded_with_its_attributes(store: GridStore) -> None:
    points = cloud()
    points[5] = np.nan
    color = np.random.default_rng(1).integers(0, 256, (3000, 3), np.uint8)
    time = np.arange(3000, dtype=np.float64)
    SubmapRecorder(store).record(
        pose(), points, 1.0, {"color": color, "time": time}, {"places.npz": b"x"}, {"places.npz": 1}
    )
    cell = load_points(store, HERE)
    within = np.linalg.norm(points - [10, 0, 0], axis=1) <= 5
    assert 10 < within.sum() < 3000
    np.testing.assert_array_equal(cell["points"], points[within])
    np.testing.assert_array_equal(cell["color"], color[within])
    np.testing.assert_array_equal(cell["time"], time[within])
    parts = store.cell(HERE).parts
    assert (parts[POINTS].count, parts["places.npz"].count) == (within.sum(), 1)
    assert store.get(HERE, "places.npz") == b"x"
    file = next(store.path.rglob("points.pcd"))  # other programs read it too
    np.testing.assert_array_equal(read_point_cloud(file).points, points[within])


def test_nothing_in_range_is_recorded_as_nothing(store: GridStore) -> None:
    SubmapRecorder(store).record(pose(), cloud() + 100, 1.0)
    assert load_points(store, HERE)["points"].shape == (0, 3)


def test_points_are_thinned_like_in_a_dictionary() -> None:
    points = np.random.default_rng(0).normal(0, 0.5, (4000, 3))
    label, weight = np.arange(4000), np.random.default_rng(1).random((4000, 2))
    cubes: dict[tuple, list[int]] = {}
    for number, point in enumerate(points):
        cubes.setdefault(tuple(np.floor(point / 0.2)), []).append(number)
    found = thin({"points": points, "label": label, "weight": weight}, 0.2, 1.0)
    expected = [cubes[key] for key in sorted(cubes)]
    np.testing.assert_allclose(found["points"], [points[rows].mean(0) for rows in expected])
    np.testing.assert_allclose(found["weight"], [weight[rows].mean(0) for rows in expected])
    assert found["label"].tolist() == [rows[0] for rows in expected]
    quarter = thin({"points": points, "label": label}, 0.0, 0.25)
    assert quarter["label"].tolist() == list(range(0, 4000, 4))
    assert len(thin({"points": points[:0]}, 0.2, 0.5)["points"]) == 0


@pytest.mark.parametrize(("far", "dtype"), [(0.0, np.float32), (5e5, np.float64)])
def test_points_far_from_the_origin_keep_their_digits(far: float, dtype: type) -> None:
    points = np.random.default_rng(0).random((500, 3)) * 10 + [far, 0, -far]
    data = encode_points({"points": points, "ring": np.arange(500, dtype=np.uint16)})
    arrays = decode_points(data, "p.pcd")
    assert arrays["points"].dtype == dtype and arrays["ring"].tolist() == list(range(500))
    assert np.abs(arrays["points"] - points).max() < 1e-4
    with pytest.raises(FormatError, match=r"p\.pcd"):
        decode_points(data[:-9], "p.pcd")
    with pytest.raises(FormatError, match=r"p\.pcd"):
        decode_points(data.replace(b"FIELDS x y z", b"FIELDS a b c"), "p.pcd")


def test_attributes_that_cannot_be_stored_are_refused() -> None:
    points = np.zeros((2, 3))
    for name, values in (("x", np.zeros(2)), ("seen", np.ones(2, bool)), ("half", np.ones(2, np.float16))):
        with pytest.raises(ValueError, match=name):
            encode_points({"points": points, name: values})


def test_changed_share_counts_what_came_and_went() -> None:
    old = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], 1)
    assert changed_share(old, old + [0, 0, 0.05], 0.1) == 0.0
    assert changed_share(old, old[:50], 0.1) == pytest.approx(50 / 150)
    end = (
        changed_share(old, old[:50], 0.1, np.array([0.0, 0, 0]), 49.0),
        changed_share(old, old[:50], 0.1, old[0], 59.0),
    )
    assert end == (0.0, pytest.approx(10 / 110))
    moved = old.copy()
    moved[:10, 2] = 3
    assert changed_share(old, moved, 0.1) == pytest.approx(20 / 200)
    assert changed_share(old[:0], old, 0.1) == 1.0 and changed_share(old[:0], old[:0], 0.1) == 0.0


def test_a_refresh_says_how_much_changed(store: GridStore) -> None:
    recorder, points = SubmapRecorder(store), cloud()
    store.begin_visit("before")
    recorder.record(pose(), points, 0.0)
    store.begin_visit("same")
    recorder.record(pose(10.3), points, 1000.0)
    store.begin_visit("moved")
    near = np.linalg.norm(points - [10, 0, 0], axis=1) < 2
    points[near] += [0, 0, 0.4]
    recorder.record(pose(10.3), points, 2000.0)
    assert store.changed_since("before")[0].added
    (change,) = store.changed_since("moved")
    assert change.key == HERE and not change.added and 0.02 < change.changed < 0.5
    recorder.record(pose(9.5), points, 3000.0)  # what only one of the two sees, at the range's end, is no change
    assert store.changed_since("moved") == [change]
    store.begin_visit("nothing moved")
    recorder.record(pose(10.3), points, 4000.0)
    assert store.changed_since("nothing moved") == [CellChange(HERE, False, 0.0)]


def test_a_whole_cloud_is_cut_into_cells(store: GridStore) -> None:
    points, ring = cloud(5000) / 4, np.arange(5000, dtype=np.int32)
    points[7] = np.inf
    keys = store_cloud(store, points, {"ring": ring}, 5.0)
    assert sorted(keys) == store.cells() and store.cell(keys[0]).recorded_at == 5.0
    seen = []
    for key in keys:
        cell = load_points(store, key)
        assert (store.grid.keys_of(cell["points"]) == key).all()
        np.testing.assert_array_equal(cell["points"], points[cell["ring"]])
        assert store.cell(key).parts[POINTS].count == len(cell["points"])
        seen += cell["ring"].tolist()
    assert sorted(seen) == [n for n in range(5000) if n != 7]
    store.begin_visit("again")
    store_cloud(store, points, {"ring": ring}, 6.0)
    assert {change.changed for change in store.changed_since("again")} == {0.0}
