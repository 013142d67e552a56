# SPDX-License-Identifier: Apache-2.0
"""The grid store: what is put is got back, versions, visits, one writer, damage and full disks."""

from __future__ import annotations

import errno
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.submaps.cell_keys import Grid, partition, sorted_groups
from ggslam.submaps.cell_records import CellChange, CellWrite
from ggslam.submaps.grid import GridStore
from ggslam.submaps.index import CellIndex
from ggslam.submaps.settings import SubmapSettings

SETTINGS = SubmapSettings(spacing=2.0, refresh=300.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "map.grid"


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in (folder / "cells").rglob("*"))


def test_parts_come_back_and_versions_replace_each_other(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put((1, -2, 3), {"points.pcd": b"first", "gaussians.npz": b"kept"}, 10.0, {"points.pcd": 7})
        store.put((1, -2, 3), {"points.pcd": b"second"}, counts={"points.pcd": 8})
        store.put((0, 0, 0), {"places.npz": b""}, 11.0)
    with GridStore.open(folder) as store:
        assert store.settings == SETTINGS and store.cells() == [(0, 0, 0), (1, -2, 3)]
        assert store.get((1, -2, 3), "points.pcd") == b"second"
        assert store.get((1, -2, 3), "gaussians.npz") == b"kept"
        assert store.get((0, 0, 0), "places.npz") == b""
        record = store.cell((1, -2, 3))
        assert (record.version, record.recorded_at, record.visit, record.bytes) == (2, 10.0, None, 10)
        assert record.parts["points.pcd"].count == 8 and record.parts["gaussians.npz"].version == 1
        for key, part in [((9, 9, 9), "points.pcd"), ((0, 0, 0), "points.pcd")]:
            with pytest.raises(KeyError):
                store.get(key, part)
    assert [name for name in files(folder) if "." in name] == [
        "cells/0_0_0/3/places.npz", "cells/1_-2_3/1/gaussians.npz", "cells/1_-2_3/2/points.pcd",
    ]  # fmt: skip


def test_threads_may_write_side_by_side(folder: Path) -> None:
    def write(number: int) -> None:
        for turn in range(6):
            store.put((turn % 2, 0, 0), {f"part{number}": bytes([turn])})

    with GridStore.create(folder, SETTINGS) as store:
        threads = [threading.Thread(target=write, args=(number,)) for number in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for cell, last in (((0, 0, 0), b"\4"), ((1, 0, 0), b"\5")):
            assert {store.get(cell, f"part{number}") for number in range(3)} == {last}
    assert len([name for name in files(folder) if "part" in name]) == 6


def test_a_writer_that_was_killed_before_the_first_cell(folder: Path) -> None:
    GridStore.create(folder, SETTINGS).close()
    (folder / "cells").rmdir()
    (folder / "lock").write_text("123")
    with GridStore.open(folder, write=True) as store:
        store.put((0, 0, 0), {"points.pcd": b"p"})
    assert (folder / "lock").read_text() == ""


def test_cells_are_removed(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put((1, 2, 3), {"points.pcd": b"x"}, 10.0)
        assert (1, 2, 3) in store and not store.due((1, 2, 3), 20.0)
        store.remove((1, 2, 3))
        store.remove((4, 5, 6))
        assert (1, 2, 3) not in store and store.cells() == [] and files(folder) == [] and store.due((1, 2, 3), 20.0)
        with pytest.raises(KeyError):
            store.cell((1, 2, 3))


@pytest.mark.parametrize("axes", ["xyz", "xz", "xy"])
def test_neighbours_are_those_of_a_scan(folder: Path, axes: str) -> None:
    generator = np.random.default_rng(0)
    with GridStore.create(folder, SubmapSettings(spacing=2.0, axes=axes)) as store:
        keys = {store.key_of(p) for p in generator.uniform(-8, 8, (80, 3))}
        store.put_cells([CellWrite(key, {"points.pcd": b"p"} if sum(key) % 2 else {"other": b"o"}) for key in keys])
        centres = {key: store.centre_of(key) for key in keys}
        spanned = [name in axes for name in "xyz"]
        for radius in (0.0, 2.0, 5.5, 1e6):
            for position in [*generator.uniform(-9, 9, (4, 3)), np.array([2.0, 4.0, -6.0])]:
                distance = {key: np.linalg.norm((centres[key] - position)[spanned]) for key in keys}
                expected = {key for key in keys if distance[key] <= radius}
                found = store.near(position, radius)
                assert set(found) == expected and len(found) == len(expected)
                assert [distance[key] for key in found] == sorted(distance[key] for key in found)
                with_points = store.part_versions("points.pcd", position, radius)
                assert set(with_points) == {key for key in expected if sum(key) % 2}
                assert all(store.cell(key).version == version for key, version in with_points.items())


def test_keys_and_centres(folder: Path) -> None:
    grid = Grid(2.0, "xz")
    assert grid.key_of(np.array([0.999, 50, -1.0])) == (0, 0, 0) and grid.key_of(np.array([1.0, 0, -1.001])) == (
        1,
        0,
        -1,
    )
    assert grid.centres_of(np.array([[1, 0, -3]])).tolist() == [[2.0, 0.0, -6.0]]
    for bad in ([np.nan, 0, 0], [np.inf, 0, 0], [1e300, 0, 0]):
        with pytest.raises(ConfigError, match="finite"):
            grid.key_of(np.array(bad))
    points = np.random.default_rng(0).normal(0, 3, (2000, 3))
    parts = dict(partition(points, grid))
    assert sorted(np.concatenate(list(parts.values()))) == list(range(2000))
    for key, indices in parts.items():
        assert (grid.keys_of(points[indices]) == key).all() and (np.diff(indices) > 0).all()
    assert list(partition(points[:0], grid)) == []
    far = np.array([[0, 0, 0], [2**31, 2**31, 2**31], [0, 0, 0]])  # too far apart for one number per row
    order, starts = sorted_groups(far)
    assert order.tolist() == [0, 2, 1] and starts.tolist() == [0, 2]


def test_refresh_is_due_only_after_its_time(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        assert store.due((0, 0, 0), 0.0)
        store.put((0, 0, 0), {"gaussians.npz": b"paged"})
        assert store.due((0, 0, 0), 0.0)  # was never recorded
        store.put((0, 0, 0), {"points.pcd": b"x"}, 1000.0)
        assert not store.due((0, 0, 0), 1300.0) and store.due((0, 0, 0), 1300.5)
        assert store.due((0, 0, 0), 1011.0, refresh=10.0) and not store.due((0, 0, 0), 5.0)


def test_visits_list_what_they_changed(folder: Path) -> None:
    a, b, c = (0, 0, 0), (1, 0, 0), (2, 0, 0)
    with GridStore.create(folder, SETTINGS) as store:
        store.put(c, {"points.pcd": b"0"}, 0.0)
        store.begin_visit("monday")
        store.put(a, {"gaussians.npz": b"no recording: the next one is the first"})
        store.put(a, {"points.pcd": b"1"}, 1.0)
        store.put(b, {"points.pcd": b"1"}, 1.0)
        store.put(c, {"gaussians.npz": b"no recording"})
        store.begin_visit("tuesday")
        store.put(b, {"points.pcd": b"2"}, 2.0, changed=0.25)
        store.put(c, {"points.pcd": b"2"}, 2.0, changed=0.5)
        store.put(c, {"points.pcd": b"3"}, 3.0, changed=0.0)
        assert store.changed_since("tuesday") == [CellChange(b, False, 0.25), CellChange(c, False, 0.5)]
        assert store.changed_since("monday") == [
            CellChange(a, True, None), CellChange(b, True, 0.25), CellChange(c, False, 0.5)
        ]  # fmt: skip
        assert store.cell(b).visit == "tuesday" and store.visits() == ["monday", "tuesday"]
        with pytest.raises(ConfigError, match="wednesday.*monday, tuesday"):
            store.changed_since("wednesday")


def test_one_writer_at_a_time_and_readers_beside_it(folder: Path) -> None:
    code = f"from ggslam.submaps.grid import GridStore; GridStore.open({str(folder)!r}, write=True)"
    with GridStore.create(folder, SETTINGS) as store:
        with pytest.raises(RunFolderError, match=rf"\b{os.getpid()}\b"):
            GridStore.open(folder, write=True)
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert other.returncode == 1 and "is being written to" in other.stderr
        with GridStore.open(folder) as reader:
            store.put((0, 0, 0), {"points.pcd": b"new"})
            assert reader.get((0, 0, 0), "points.pcd") == b"new"
            for write in (lambda: reader.put((0, 0, 0), {}), lambda: reader.remove((0, 0, 0))):
                with pytest.raises(RunFolderError, match="reading"):
                    write()
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_readers_never_see_a_mixture(folder: Path) -> None:
    failures: list[str] = []
    with GridStore.create(folder, SETTINGS) as store, GridStore.open(folder) as reader:
        store.put((0, 0, 0), {"points.pcd": bytes(20_000)})
        done = threading.Event()

        def read() -> None:
            while not done.is_set():
                if len(set(reader.get((0, 0, 0), "points.pcd"))) != 1:
                    failures.append("mixture")

        thread = threading.Thread(target=read)
        thread.start()
        try:
            for value in range(40):
                store.put((0, 0, 0), {"points.pcd": bytes([value]) * (20_000 + value)})
        finally:
            done.set()
            thread.join()
    assert failures == []


@pytest.mark.parametrize(
    ("damage", "reason"), [("flip", "checksum"), ("cut", r"3 bytes.*\b5\b"), ("gone", "No such file")]
)
def test_a_damaged_part_harms_no_other(folder: Path, damage: str, reason: str) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put_cells([CellWrite((n, 0, 0), {"points.pcd": b"01234", "places.npz": b"56"}) for n in range(3)])
        path = next((folder / "cells" / "1_0_0").rglob("points.pcd"))
        if damage == "gone":
            path.unlink()
        else:
            path.write_bytes(b"01734" if damage == "flip" else b"012")
        with pytest.raises(FormatError, match=f"1_0_0.*points.pcd.*{reason}"):
            store.get((1, 0, 0), "points.pcd")
        problems = list(store.problems())
        assert len(problems) == (damage != "flip") and all(
            re.search(reason, line) and "1_0_0" in line for line in problems
        )
        assert store.get((1, 0, 0), "places.npz") == b"56" and store.get((2, 0, 0), "points.pcd") == b"01234"
        store.put((1, 0, 0), {"points.pcd": b"mended"})
        assert store.get((1, 0, 0), "points.pcd") == b"mended"


@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, 1), (errno.EACCES, 2)])
def test_a_failed_write_changes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: int) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put((0, 0, 0), {"points.pcd": b"old"}, 5.0)
        before = files(folder)
        calls = 0
        write_bytes = Path.write_bytes

        def failing(path: Path, data: bytes) -> int:
            nonlocal calls
            calls += 1
            if calls == 3:
                write_bytes(path, data[:1])
                raise OSError(number, os.strerror(number), str(path))
            return write_bytes(path, data)

        monkeypatch.setattr(Path, "write_bytes", failing)
        with pytest.raises(RunFolderError, match=r"1_0_0.*: (No space|Permission denied)") as caught:
            store.put_cells([CellWrite((n, 0, 0), {"a": b"new", "points.pcd": b"new"}) for n in (0, 1)])
        assert caught.value.exit_code == code and calls == 3
        monkeypatch.undo()
        assert files(folder) == before and store.get((0, 0, 0), "points.pcd") == b"old" and store.cells() == [(0, 0, 0)]
        store.put((0, 0, 0), {"points.pcd": b"again"})
    with GridStore.open(folder) as store:
        assert store.get((0, 0, 0), "points.pcd") == b"again" and store.cell((0, 0, 0)).recorded_at == 5.0


def test_a_full_disk_under_the_index_changes_nothing(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put((0, 0, 0), {"points.pcd": b"old"})
        before = files(folder)
        connection = store._index._connection
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")  # SQLite's own way to run out of space
        with pytest.raises(RunFolderError, match=r"index\.sqlite.*full") as caught:
            store.put_cells([CellWrite((n, 0, 0), {"points.pcd": b"new"}) for n in range(200)])
        assert caught.value.exit_code == 1
        assert files(folder) == before and store.get((0, 0, 0), "points.pcd") == b"old" and store.cells() == [(0, 0, 0)]


def test_files_are_on_the_disk_before_the_index_speaks_of_them(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []
    fsync, commit = os.fsync, CellIndex.commit

    def noted_fsync(handle: int) -> None:
        events.append(str(Path(f"/proc/self/fd/{handle}").readlink().relative_to(folder)))
        fsync(handle)

    def noted_commit(self: CellIndex, *arguments: object) -> None:
        events.append("index")
        commit(self, *arguments)  # type: ignore[arg-type]

    with GridStore.create(folder, SETTINGS) as store:
        monkeypatch.setattr(os, "fsync", noted_fsync)
        monkeypatch.setattr(CellIndex, "commit", noted_commit)
        store.put((4, 5, 6), {"points.pcd": b"1", "a": b"2"})
        assert store._index._connection.execute("PRAGMA synchronous").fetchone()[0] == 2  # FULL
        assert store._index._connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    assert events[-1] == "index"
    assert set(events[:-1]) == {"cells", "cells/4_5_6", "cells/4_5_6/1", "cells/4_5_6/1/a", "cells/4_5_6/1/points.pcd"}


def test_folders_that_are_no_store(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"index\.sqlite"):
        GridStore.open(folder)
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(RunFolderError, match=r"notes\.txt"):
        GridStore.create(folder)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="file"):
        GridStore.create(tmp_path / "file")
    for content, reason in [(b"", "not the index"), (b"something else" * 100, "not a database")]:
        (folder / "index.sqlite").write_bytes(content)
        for write in (False, True):
            with pytest.raises(FormatError, match=f"index.sqlite.*{reason}"):
                GridStore.open(folder, write)


def test_other_versions_and_grids(folder: Path) -> None:
    GridStore.create(folder, SETTINGS).close()
    with GridStore.open(folder, settings=SubmapSettings(spacing=2.0, refresh=7.0)) as store:
        assert store.settings.refresh == 7.0
    for other in (SubmapSettings(spacing=3.0), SubmapSettings(axes="xy")):
        with pytest.raises(ConfigError, match="2 m.*xyz"):
            GridStore.open(folder, settings=other)
    connection = sqlite3.connect(folder / "index.sqlite")
    connection.execute("UPDATE store SET settings = '{\"spacing\": -1}'")
    connection.commit()
    with pytest.raises(FormatError, match="settings"):
        GridStore.open(folder)
    connection.execute("PRAGMA user_version = 3")
    connection.commit()
    connection.close()
    with pytest.raises(FormatError, match=r"\b3\b.*\b2\b"):
        GridStore.open(folder)


def test_a_truncated_index_is_refused_plainly(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put_cells([CellWrite((n, 0, 0), {"points.pcd": b"p"}) for n in range(150)])
    data = (folder / "index.sqlite").read_bytes()
    for size in np.linspace(1, len(data) - 1, 9).astype(int).tolist():
        (folder / "index.sqlite").write_bytes(data[:size])
        with pytest.raises(FormatError, match=r"index\.sqlite"), GridStore.open(folder) as store:
            store.cells()


def test_noise_in_the_index_is_refused_or_harmless(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put_cells([CellWrite((n, 0, 0), {"points.pcd": b"p"}) for n in range(100)])
    data = (folder / "index.sqlite").read_bytes()
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(20):
        noisy = np.frombuffer(data, np.uint8).copy()
        noisy[generator.integers(0, len(data), 200)] = generator.integers(0, 256, 200)
        (folder / "index.sqlite").write_bytes(noisy.tobytes())
        try:
            with GridStore.open(folder) as store:
                for key in store.cells():
                    store.cell(key)
        except (FormatError, RunFolderError, KeyError):
            refused += 1
    assert refused > 3


def test_a_folder_that_cannot_be_written(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        store.put((0, 0, 0), {"points.pcd": b"p"})
    folder.chmod(0o555)
    if os.access(folder, os.W_OK):
        pytest.skip("nothing is closed to this user")
    (folder / "lock").chmod(0o444)
    try:
        with GridStore.open(folder) as store:
            assert store.get((0, 0, 0), "points.pcd") == b"p"
        with pytest.raises(RunFolderError, match="lock: Permission denied"):
            GridStore.open(folder, write=True)
        with pytest.raises(RunFolderError, match="other: .*Permission denied"):
            GridStore.create(folder / "other")
        folder.chmod(0o755)
        (folder / "lock").chmod(0o644)
        store = GridStore.open(folder, write=True)
        store.put((0, 0, 0), {"points.pcd": b"q"})
        for name in ("index.sqlite", "index.sqlite-wal"):  # as after a power cut: the log is there, its index is not
            shutil.copy(folder / name, folder.parent)
        store.close()
        for name in ("index.sqlite", "index.sqlite-wal"):
            shutil.copy(folder.parent / name, folder)
        folder.chmod(0o555)
        with pytest.raises(RunFolderError, match="did not close it"):
            GridStore.open(folder)
    finally:
        folder.chmod(0o755)


def test_names_of_parts_are_plain(folder: Path) -> None:
    with GridStore.create(folder, SETTINGS) as store:
        for name in ("../x", "a/b", "", ".hidden"):
            with pytest.raises(ValueError, match="name"):
                store.put((0, 0, 0), {name: b""})
        assert store.cells() == [] and files(folder) == []


def test_impossible_settings() -> None:
    for settings in ({"spacing": 0.0}, {"radius": float("nan")}, {"ratio": 1.5}, {"axes": "yz"}):
        with pytest.raises(ConfigError, match=next(iter(settings))):
            SubmapSettings(**settings)


@pytest.mark.parametrize("kind", ["pipe", "folder"])
def test_a_lock_that_is_no_file_is_refused(tmp_path: Path, kind: str) -> None:
    GridStore.create(tmp_path / "store").close()
    lock = tmp_path / "store" / "lock"
    lock.unlink()
    os.mkfifo(lock) if kind == "pipe" else lock.mkdir()
    with pytest.raises(RunFolderError, match="lock"):
        GridStore.open(tmp_path / "store", write=True)
