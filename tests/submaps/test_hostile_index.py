# SPDX-License-Identifier: Apache-2.0
"""Indexes and cells of stores that came from elsewhere: none runs anything, hangs, or leads outside."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ggslam.errors import FormatError, GgslamError
from ggslam.submaps.grid import GridStore
from ggslam.submaps.index_schema import NEWEST, SCHEMAS

CELLS = 30


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with parts and a visit."""
    path = tmp_path / "map.grid"
    with GridStore.create(path) as made:
        made.begin_visit("first")
        for x in range(CELLS):
            made.put((x, -x, 0), {"points.pcd": bytes(x)}, recorded_at=float(x), counts={"points.pcd": x}, changed=0.5)
    return path


def rewrite(store: Path, *statements: str) -> Path:
    """The same store with an index that others wrote."""
    connection = sqlite3.connect(store / "index.sqlite")
    connection.execute("PRAGMA journal_mode = DELETE")
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    return store


def use_all(path: Path) -> None:
    """Everything that is read of a store."""
    with GridStore.open(path) as opened:
        opened.visits(), list(opened.problems()), opened.changed_since("first")
        for key in opened.cells():
            for name in opened.cell(key).parts:
                opened.get(key, name)
        opened.near([0.0, 0.0, 0.0], 1e4), opened.part_versions("points.pcd", [0.0, 0.0, 0.0], 1e4)


def with_schema(store: Path, change: Callable[[str], str]) -> Path:
    """The same content in tables whose definition was changed."""
    columns = {"visits": "number, name", "parts": "x, y, z, name, version, count, bytes, crc"}
    connection = sqlite3.connect(store / "index.sqlite")
    connection.execute("PRAGMA journal_mode = DELETE")
    for table, names in columns.items():
        (made,) = connection.execute("SELECT sql FROM sqlite_master WHERE name = ?", (table,)).fetchone()
        connection.execute(f"ALTER TABLE {table} RENAME TO old_{table}")
        connection.execute(change(made))
        connection.execute(f"INSERT INTO {table} ({names}) SELECT {names} FROM old_{table}")
        connection.execute(f"DROP TABLE old_{table}")
    connection.commit()
    connection.close()
    return store


ENDLESS = "(SELECT count(*) FROM (WITH RECURSIVE n(i) AS (VALUES (1) UNION ALL SELECT i + 1 FROM n) SELECT i FROM n))"


@pytest.mark.parametrize(
    "statement",
    [
        "ALTER TABLE parts ADD COLUMN more INTEGER AS (zeroblob(1000000000)) VIRTUAL",
        "ALTER TABLE cells ADD COLUMN more INTEGER",
        f"CREATE VIEW more AS SELECT {ENDLESS}",
        f"CREATE TRIGGER more AFTER INSERT ON visits BEGIN SELECT {ENDLESS}; END",
        "CREATE INDEX more ON visits (abs(number))",
        "CREATE TABLE more (x)",
    ],
)
def test_an_index_with_more_than_its_tables_is_refused(store: Path, statement: str) -> None:
    try:
        rewrite(store, statement)
    except sqlite3.OperationalError as error:
        pytest.skip(f"this SQLite does not make it: {error}")
    start = time.process_time()
    with pytest.raises(FormatError, match="index.sqlite"):
        GridStore.open(store)
    assert time.process_time() - start < 1


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("crc INTEGER NOT NULL", "crc INTEGER AS (length(zeroblob(900000000))) VIRTUAL"),
        ("name TEXT NOT NULL", "name TEXT NOT NULL CHECK (length(name) < 1000)"),
        ("name TEXT NOT NULL", "name TEXT COLLATE NOCASE NOT NULL"),
        ("bytes INTEGER NOT NULL", "bytes INTEGER NOT NULL DEFAULT 7"),
    ],
)
def test_an_index_with_other_columns_is_refused(store: Path, old: str, new: str) -> None:
    if "AS (" in new:
        connection = sqlite3.connect(store / "index.sqlite")
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = replace(sql, ?, ?)", (old, new))
        connection.commit()
        connection.close()
    else:
        with_schema(store, lambda made: made.replace(old, new))
    with pytest.raises(FormatError, match="index.sqlite"):
        use_all(store)


def test_an_index_of_version_1_is_read_and_written(tmp_path: Path) -> None:
    path = tmp_path / "old.grid"
    GridStore.create(path).close()
    (path / "index.sqlite").rename(tmp_path / "new.sqlite")
    new, old = sqlite3.connect(tmp_path / "new.sqlite"), sqlite3.connect(path / "index.sqlite")
    (application,) = new.execute("PRAGMA application_id").fetchone()
    old.executescript(f"{SCHEMAS[1]} PRAGMA application_id = {application}; PRAGMA user_version = 1;")
    old.execute("INSERT INTO store VALUES (?, 0)", new.execute("SELECT settings FROM store").fetchone())
    old.commit()
    new.close(), old.close()
    with GridStore.open(path, write=True) as opened:
        opened.put((1, 2, 3), {"points.pcd": b"abc"}, recorded_at=1.0)
    with GridStore.open(path) as opened:
        assert opened.cells() == [(1, 2, 3)] and opened.get((1, 2, 3), "points.pcd") == b"abc"


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("UPDATE cells SET x = 9223372036854775807 WHERE x = 3", "9223372036854775807 .*x"),
        ("UPDATE cells SET z = -9223372036854775808 WHERE x = 3", r"-9223372036854775808.*\bz\b"),
        ("UPDATE cells SET version = -1 WHERE x = 3", "-1 .*version"),
        ("UPDATE cells SET recorded_at = 9e999 WHERE x = 3", "inf .*recorded_at"),
        ("UPDATE parts SET bytes = -7 WHERE x = 3", "-7 .*bytes"),
        ("UPDATE parts SET count = -1 WHERE x = 3", "-1 .*count"),
        ("UPDATE parts SET crc = 4294967296 WHERE x = 3", "4294967296 .*crc"),
        ("UPDATE changes SET changed = -9e999 WHERE x = 3", "-inf .*changed"),
        ("UPDATE changes SET added = 2 WHERE x = 3", "2 .*added"),
        ("UPDATE store SET last_version = -5", "-5 .*version"),
        ("DELETE FROM store", "settings"),
        (f"UPDATE visits SET name = '{'x' * 5000}'", "is no"),
        ("UPDATE parts SET name = '../../evil' WHERE x = 3", "evil"),
    ],
)
def test_rows_that_cannot_be_are_refused(store: Path, statement: str, reason: str) -> None:
    rewrite(store, statement)
    with pytest.raises(FormatError, match=reason):
        use_all(store)


@pytest.mark.skipif(NEWEST < 2, reason="SQLite before 3.37 has no strict tables")
def test_tables_refuse_other_types(store: Path) -> None:
    with pytest.raises(sqlite3.IntegrityError):
        rewrite(store, "UPDATE parts SET bytes = x'00ff' WHERE x = 3")


@pytest.mark.parametrize("name", ["index.sqlite-wal", "index.sqlite-shm", "index.sqlite-journal"])
def test_pipes_and_links_beside_an_index_are_refused(store: Path, name: str, tmp_path: Path) -> None:
    (store / name).unlink(missing_ok=True)
    os.mkfifo(store / name)
    with pytest.raises(FormatError, match=name):
        GridStore.open(store)
    (store / name).unlink()
    (tmp_path / "elsewhere").write_bytes(b"")
    (store / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FormatError, match=name):
        GridStore.open(store)


@pytest.mark.parametrize("write", [False, True])
@pytest.mark.parametrize("name", ["index.sqlite-wal", "index.sqlite-shm", "index.sqlite-journal", "lock"])
def test_somebodys_file_under_a_name_of_ours_is_not_written(
    store: Path, name: str, write: bool, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_text("my thesis")
    (store / name).unlink(missing_ok=True)
    (store / name).hardlink_to(mine)
    if name == "lock" and not write:  # which readers do not touch
        use_all(store)
    else:
        with pytest.raises(GgslamError, match=name) as refused:
            GridStore.open(store, write=write)
        assert refused.value.exit_code == 2
    assert mine.read_text() == "my thesis"


def test_a_store_copied_with_hard_links_is_read_and_not_written(store: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.grid"
    shutil.copytree(store, copy, copy_function=os.link)
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    use_all(copy)
    with pytest.raises(GgslamError, match="lock"):
        GridStore.open(copy, write=True)
    (copy / "lock").unlink()
    with pytest.raises(GgslamError, match=r"index.sqlite: .*cp -r"):
        GridStore.open(copy, write=True)
    assert {path: path.read_bytes() for path in before} == before
    shutil.copytree(copy, tmp_path / "own.grid")
    with GridStore.open(tmp_path / "own.grid", write=True) as opened:
        assert len(opened.cells()) == CELLS


def test_a_part_that_is_a_pipe_is_refused(store: Path) -> None:
    with GridStore.open(store) as opened:
        version = opened.cell((3, -3, 0)).parts["points.pcd"].version
        part = store / "cells" / "3_-3_0" / str(version) / "points.pcd"
        part.unlink()
        os.mkfifo(part)
        with pytest.raises(FormatError, match="points.pcd"):
            opened.get((3, -3, 0), "points.pcd")


def test_folders_with_huge_numbers_are_no_cells(store: Path) -> None:
    (store / "cells" / f"{'9' * 60}_0_0").mkdir()
    with GridStore.open(store, write=True) as opened:
        assert len(opened.cells()) == CELLS


def test_damaged_indexes_end_in_errors_of_ours(store: Path) -> None:
    """Bytes changed at random, with the file as large as before: read as it is, or refused."""
    rewrite(store)
    path, rng, ends = store / "index.sqlite", random.Random(0), {"read": 0, "refused": 0}
    good = path.read_bytes()
    for _ in range(150):
        data = bytearray(good)
        for _ in range(rng.choice((1, 1, 2, 8, 64))):
            data[rng.randrange(len(data))] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
        path.write_bytes(data)
        try:
            use_all(store)
        except GgslamError:
            ends["refused"] += 1
        else:
            ends["read"] += 1
    assert ends["refused"] > 25 and sum(ends.values()) == 150


def test_a_statement_that_goes_on_and_on_is_ended(store: Path) -> None:
    """Pages that lead in circles are told from large stores by the number of steps."""
    with GridStore.open(store) as opened:
        start = time.process_time()
        with pytest.raises(FormatError, match="index.sqlite"):
            opened._index._rows(f"SELECT {ENDLESS}", (), "count")
        assert time.process_time() - start < 10
        assert len(opened.cells()) == CELLS
