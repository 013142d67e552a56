# SPDX-License-Identifier: Apache-2.0
"""The partial map: what a scan of all cells gives, no cell loaded twice, within its bound, ahead of the motion."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from partial_map import PartialMap

from ggslam.errors import ConfigError
from ggslam.submaps.cell_cache import CellCache, byte_count
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_points import CellArrays
from ggslam.submaps.cells_around import MapStatus
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points, store_cloud
from ggslam.submaps.settings import SubmapSettings

SETTINGS = SubmapSettings(spacing=2.0, axes="xy", partial_radius=5.0, voxel=0.0, lookahead=0.0, cache_megabytes=10.0)
AHEAD = SubmapSettings(spacing=2.0, axes="xy", partial_radius=5.0, voxel=0.0, lookahead=4.0, cache_megabytes=10.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps") / "map.grid"
    generator = np.random.default_rng(0)
    points = (generator.random((12_000, 3)) * [30, 30, 3]).astype(np.float32)
    with GridStore.create(folder, SETTINGS) as store:
        store_cloud(store, points, {"ring": np.arange(12_000, dtype=np.int32)})
    return folder


class CountingLoader:
    """Notes which cells are loaded, and by which thread."""

    def __init__(self) -> None:
        self.loaded: list[tuple[CellKey, bool]] = []

    def __call__(self, store: GridStore, key: CellKey) -> CellArrays:
        self.loaded.append((key, threading.current_thread() is threading.main_thread()))
        return load_points(store, key)


def walk() -> list[np.ndarray]:
    """Positions 0.7 m apart, through the world, out of it and back."""
    corners = np.array([[3.0, 3, 1], [30, 8, 1], [30, 60, 1], [20, 20, 1], [20, 20, 40]])
    return [
        a + (b - a) * step
        for a, b in zip(corners[:-1], corners[1:], strict=True)
        for step in np.arange(0, 1, 0.7 / np.linalg.norm(b - a))
    ]


def test_it_is_the_union_that_a_scan_finds(folder: Path) -> None:
    loader = CountingLoader()
    with GridStore.open(folder) as store, PartialMap(store, SETTINGS, loader) as partial:
        cells = {key: load_points(store, key) for key in store.cells()}
        entered, expected, statuses = None, {}, set()
        for position in walk():
            status = partial.update(position)
            statuses.add(status)
            before = expected
            if store.key_of(position) != entered:
                entered = store.key_of(position)
                distance = {key: np.linalg.norm((store.centre_of(key) - position)[:2]) for key in cells}
                expected = {key for key in cells if distance[key] <= 5.0}
            changed = MapStatus.UNCHANGED if set(before) == expected else MapStatus.CHANGED
            assert status == (changed if expected else MapStatus.EMPTY)
            assert set(partial.slices) == expected
            assert len(partial.points) == sum(len(cells[key]["points"]) for key in expected)
            for key, rows in partial.slices.items():
                for name in ("points", "ring"):
                    np.testing.assert_array_equal(partial.arrays[name][rows], cells[key][name])
        assert statuses == set(MapStatus)
    assert len({key for key, _ in loader.loaded}) == len(loader.loaded)  # the cache had what the way back needed


def test_only_what_came_is_loaded(folder: Path) -> None:
    loader = CountingLoader()
    settings = SubmapSettings(spacing=2.0, axes="xy", partial_radius=5.0, lookahead=0.0, cache_megabytes=0.0)
    with GridStore.open(folder) as store, PartialMap(store, settings, loader) as partial:
        partial.update(np.array([20.0, 20, 0]))
        first, arrays = set(partial.slices), partial.arrays
        assert len(loader.loaded) == len(first) == 21
        assert partial.update(np.array([20.9, 20, 0])) is MapStatus.UNCHANGED and partial.arrays is arrays
        assert partial.update(np.array([22.0, 20, 0])) is MapStatus.CHANGED
        came = set(partial.slices) - first
        assert {key for key, _ in loader.loaded[21:]} == came and len(loader.loaded) == 21 + len(came)
        assert partial.cache.peak_bytes == 0


def test_nothing_around_is_no_error(folder: Path, tmp_path: Path) -> None:
    with GridStore.open(folder) as store, PartialMap(store) as partial:
        assert partial.update(np.array([500.0, 500, 0])) is MapStatus.EMPTY
        assert partial.points.shape == (0, 3) and partial.slices == {}
        assert partial.update(np.array([500.1, 500, 0])) is MapStatus.EMPTY
        assert partial.update(np.array([20.0, 20, 0])) is MapStatus.CHANGED and len(partial.points)
        with pytest.raises(ConfigError, match="finite"):
            partial.update(np.array([np.nan, 0, 0]))
        with pytest.raises(ConfigError, match="spacing|1 m"):
            PartialMap(store, SubmapSettings(spacing=1.0))
    with GridStore.create(tmp_path / "empty.grid") as store, PartialMap(store) as partial:
        assert partial.update(np.zeros(3)) is MapStatus.EMPTY


def test_cells_ahead_are_loaded_by_another_thread(folder: Path) -> None:
    loader = CountingLoader()
    with GridStore.open(folder) as store, PartialMap(store, AHEAD, loader) as partial:
        partial.update(np.array([10.0, 20, 0]), np.array([0.1, 0, 0]))
        assert partial.wait(10)
        ahead = [key for key, main in loader.loaded if not main]
        around = set(store.near(np.array([14.0, 20, 0]), 5.0)) - set(partial.slices)
        assert set(ahead) == around and around
        for x in (11.0, 12.0, 13.0, 14.0):
            partial.update(np.array([x, 20, 0]))  # the direction follows from the last position
            assert partial.wait(10)
        start = set(store.near(np.array([10.0, 20, 0]), 5.0))
        assert {key for key, main in loader.loaded if main} == start  # nothing had to be waited for on the way
        assert len({key for key, _ in loader.loaded}) == len(loader.loaded)


def test_the_bound_holds_while_loading_ahead(folder: Path) -> None:
    with GridStore.open(folder) as store:
        largest = max(byte_count(load_points(store, key)) for key in store.cells())
        for cells in (0.5, 1.5, 10):
            limit = int(cells * largest)
            settings = SubmapSettings(
                spacing=2.0, axes="xy", partial_radius=5.0, lookahead=4.0, cache_megabytes=limit / 1e6
            )
            with PartialMap(store, settings) as partial:
                for number, position in enumerate(walk()):
                    partial.update(position)
                    if number % 3 == 0:
                        assert partial.wait(10)
                    held = sum(byte_count(cell) for cell in list(partial.cache._cells.values()))
                    assert held <= limit and partial.cache.peak_bytes <= limit
                assert cells < 1 or partial.cache.peak_bytes > limit / 3


def test_the_least_recently_used_cell_goes_first() -> None:
    cache = CellCache(100, byte_count)
    cell = {"points": np.zeros(5)}  # 40 bytes
    for key in "ab":
        cache.get(key, lambda: cell)
    cache.get("a", lambda: pytest.fail("loaded again"))
    cache.get("c", lambda: cell)
    assert "a" in cache and "b" not in cache and "c" in cache and cache.bytes == 80
    large = {"points": np.zeros(20)}
    assert cache.get("large", lambda: large) is large and "large" not in cache and "a" in cache
    with pytest.raises(ValueError, match="broken"):
        cache.get("d", lambda: (_ for _ in ()).throw(ValueError("broken")))
    assert cache.get("d", lambda: cell) is cell and cache.peak_bytes == 80


def test_threads_wait_for_one_loading() -> None:
    cache, begun, go_on, loads = CellCache(10**6, byte_count), threading.Event(), threading.Event(), []

    def slow() -> CellArrays:
        begun.set()
        assert go_on.wait(10)
        loads.append(1)
        return {"points": np.zeros((1, 3))}

    results: list[CellArrays] = []
    threads = [threading.Thread(target=lambda: results.append(cache.get("a", slow))) for _ in range(3)]
    for thread in threads:
        thread.start()
    assert begun.wait(10)
    go_on.set()
    for thread in threads:
        thread.join(10)
    assert len(loads) == 1 and len(results) == 3 and all(result is results[0] for result in results)


def test_a_cell_written_anew_is_loaded_anew(tmp_path: Path) -> None:
    with GridStore.create(tmp_path / "map.grid", AHEAD) as store:
        store_cloud(store, np.array([[0.0, 0, 0], [2, 0, 0]], np.float32))
        with PartialMap(store) as partial:
            partial.update(np.array([0.0, 0, 0]))
            store_cloud(store, np.array([[0.5, 0, 0]], np.float32))
            assert partial.update(np.array([2.0, 0, 0])) is MapStatus.CHANGED
            assert sorted(partial.points[:, 0].tolist()) == [0.5, 2.0]
            store.remove((1, 0, 0))
            partial.update(np.array([0.0, 0, 0]))
            assert partial.points.tolist() == [[0.5, 0, 0]]


def test_damaged_cells_are_left_out_and_named(tmp_path: Path) -> None:
    with GridStore.create(tmp_path / "map.grid", AHEAD) as store:
        store_cloud(store, np.array([[0.0, 0, 0], [2, 0, 0], [6, 0, 0]], np.float32))
        for cell in ("1_0_0", "3_0_0"):
            path = next((store.path / "cells" / cell).rglob("points.pcd"))
            path.write_bytes(path.read_bytes()[:-1] + b"?")
        with PartialMap(store) as partial:
            assert partial.update(np.array([0.0, 0, 0]), np.array([1.0, 0, 0])) is MapStatus.CHANGED
            assert partial.wait(10)  # the third cell was tried ahead
            assert list(partial.damaged) == [(1, 0, 0)] and "checksum" in partial.damaged[1, 0, 0]
            partial.update(np.array([2.0, 0, 0]))
            assert set(partial.damaged) == {(1, 0, 0), (3, 0, 0)} and partial.points.tolist() == [[0, 0, 0]]


def test_attributes_that_not_all_cells_have_are_left_out(tmp_path: Path) -> None:
    with GridStore.create(tmp_path / "map.grid", SETTINGS) as store:
        store_cloud(store, np.array([[0.0, 0, 0]]), {"ring": np.array([1]), "time": np.array([2.0])})
        store_cloud(store, np.array([[2.0, 0, 0]]), {"time": np.array([3.0])})
        with PartialMap(store) as partial:
            partial.update(np.zeros(3))
            assert sorted(partial.arrays) == ["points", "time"] and partial.arrays["time"].tolist() == [2.0, 3.0]


def test_errors_in_the_background_are_raised_and_closing_ends_the_thread(folder: Path) -> None:
    def broken(store: GridStore, key: CellKey) -> CellArrays:
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("a fault of the loader")
        return load_points(store, key)

    before = threading.active_count()
    with GridStore.open(folder) as store, PartialMap(store, AHEAD, broken) as partial:
        partial.update(np.array([10.0, 20, 0]), np.array([1.0, 0, 0]))
        assert partial.wait(10)
        with pytest.raises(RuntimeError, match="a fault of the loader"):
            partial.update(np.array([12.0, 20, 0]))
    assert threading.active_count() == before
