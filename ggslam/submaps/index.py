# SPDX-License-Identifier: Apache-2.0
"""The index of a grid store: an SQLite file with write-ahead log (one writer and many readers, no half transactions).

Tables (format version 2; version 1 has them without strict types, and is read and written still):
    store    one row: the settings as JSON, the number of the last version
    visits   number, name
    cells    x y z, version of the last write, recorded_at (seconds or NULL), visit (number or NULL)
    parts    x y z name, version (names the folder), count (things), bytes, crc (CRC-32)
    changes  visit x y z, added (0 or 1), changed (share or NULL)

The write-ahead log needs a local disk: shared memory does not reach over a network file system.
"""

from __future__ import annotations

import json
import sqlite3
import stat
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from ggslam.errors import ConfigError, FormatError, GgslamError, RunFolderError
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_records import CellChange, CellRecord, CellWrite, PartRecord
from ggslam.submaps.index_schema import NEWEST, SCHEMAS, check_rows, check_schema, check_values
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.links import refuse_shared_file
from ggslam.system.tuning import Tuning

_APPLICATION: Final = 0x67677367  # "ggsg": how SQLite files tell whose they are
"""Application id "ggsg" in the header of the SQLite file."""


class IndexTuning(Tuning):
    """Limits of a store's index."""

    busy_s = 10.0
    """Seconds to wait for another writer."""
    max_value_bytes = 1 << 20
    """Longest value in bytes. The settings of a store take a page of text."""
    min_steps = 20_000_000
    """Steps of SQLite's machine that a call may always take."""
    steps_per_byte = 64
    """Further steps that a call may take, for each byte of the file."""
    steps_at_once = 100_000
    """Steps between two checks of that limit."""
    max_columns = 1 << 14
    """Most (x, y) columns of a range that are looked up one by one. A larger range is looked up by x alone."""


_PART = ("version", "count", "bytes", "crc")


class CellIndex:
    """All access to the file; threads may share one. Every method raises FormatError if the file is damaged."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._steps = _Steps(path, connection)
        self._lock = threading.RLock()

    @staticmethod
    def create(path: Path, settings: SubmapSettings) -> None:
        """Writes an empty index. Raises RunFolderError if it cannot be written."""
        with _explain_errors(path):
            connection = sqlite3.connect(path, isolation_level=None)
            try:
                connection.execute("PRAGMA journal_mode = WAL")
                connection.executescript(
                    f"PRAGMA synchronous = FULL; BEGIN; {SCHEMAS[NEWEST]} PRAGMA application_id = {_APPLICATION};"
                    f"PRAGMA user_version = {NEWEST};"
                )
                connection.execute("INSERT INTO store VALUES (?, 0)", (json.dumps(asdict(settings)),))
                connection.execute("COMMIT")
            finally:
                connection.close()

    @staticmethod
    def open(path: Path, write: bool) -> tuple[CellIndex, SubmapSettings]:
        """Opens an index and reads its settings.

        Raises:
            FormatError: there is none, it is not an index, damaged or of another version.
            RunFolderError: the operating system does not let it be opened.
        """
        if not path.is_file():
            raise FormatError(f"{path.parent}: no grid store: there is no file {path.name}")
        _refuse_other_files(path, write)
        with _explain_errors(path):
            connection = _connect(path, write)
            try:
                _check_size(path, connection)
                return CellIndex(path, connection), _read_settings(path, connection)
            except BaseException:
                connection.close()
                raise

    def close(self) -> None:
        with self._lock, suppress(sqlite3.Error):
            self._connection.close()

    def copy(self, path: Path) -> None:
        """Writes all of it to a new file, as it is at one moment."""
        with self._lock, _explain_errors(path):
            copy = sqlite3.connect(path)
            try:
                self._connection.backup(copy)
            finally:
                copy.close()

    def keys(self) -> list[CellKey]:
        """Every cell, sorted."""
        return self._rows("SELECT x, y, z FROM cells ORDER BY x, y, z", (), "x", "y", "z")

    def record(self, key: CellKey) -> CellRecord | None:
        """What is known of a cell; None: there is none."""
        with self._lock:
            rows = self._rows(
                "SELECT c.recorded_at, v.name, c.version FROM cells c LEFT JOIN visits v ON v.number = c.visit "
                "WHERE c.x = ? AND c.y = ? AND c.z = ?", key, "recorded_at", "visit_name", "version",
            )  # fmt: skip
            parts = self._rows(
                "SELECT name, version, count, bytes, crc FROM parts WHERE x = ? AND y = ? AND z = ?", key,
                "name", *_PART,
            )  # fmt: skip
        if not rows:
            return None
        recorded_at, visit, version = rows[0]
        return CellRecord(key, recorded_at, visit, version, {part[0]: PartRecord(*part[1:]) for part in parts})

    def check_absent(self, key: CellKey) -> None:
        """Raises FormatError if a cell without record is among all cells: the file's order is damaged."""
        if key in self.keys() and self.record(key) is None:
            raise FormatError(f"{self.path}: damaged: cell {key} is listed, but not found")

    def part(self, key: CellKey, name: str) -> PartRecord | None:
        """What is known of a part; None: there is none."""
        query = "SELECT version, count, bytes, crc FROM parts WHERE x = ? AND y = ? AND z = ? AND name = ?"
        rows = self._rows(query, (*key, name), *_PART)
        return PartRecord(*rows[0]) if rows else None

    def in_box(self, low: CellKey, high: CellKey, part: str | None = None) -> dict[CellKey, int]:
        """Cells whose coordinates lie in a closed range, with the version of their last write or, if a part is named,
        of that part (cells without it are left out). Takes time by the range, not by the size of the map."""
        table, where, values = ("cells", "", ()) if part is None else ("parts", "AND c.name = ?", (part,))
        if any(first > last for first, last in zip(low, high, strict=True)):
            return {}
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) > IndexTuning.max_columns:
            query = f"SELECT c.x, c.y, c.z, c.version FROM {table} c WHERE c.x BETWEEN ? AND ? AND c.y BETWEEN ? AND ?"
        else:  # CROSS JOIN keeps the order of the loops: each (x, y) is one look-up in the primary key
            query = (
                "WITH RECURSIVE xs (v, last) AS (VALUES (?, ?) UNION ALL SELECT v + 1, last FROM xs WHERE v < last), "
                "ys (v, last) AS (VALUES (?, ?) UNION ALL SELECT v + 1, last FROM ys WHERE v < last) "
                f"SELECT c.x, c.y, c.z, c.version FROM xs CROSS JOIN ys CROSS JOIN {table} c "
                "WHERE c.x = xs.v AND c.y = ys.v"
            )
        bounds = (low[0], high[0], low[1], high[1], low[2], high[2])
        rows = self._rows(f"{query} AND c.z BETWEEN ? AND ? {where}", (*bounds, *values), "x", "y", "z", "version")
        return {(x, y, z): version for x, y, z, version in rows}

    def last_version(self) -> int:
        rows = self._rows("SELECT last_version FROM store", (), "version")
        if len(rows) != 1:
            raise FormatError(f"{self.path}: damaged: {len(rows)} settings of a store")
        return int(rows[0][0])

    def visit_number(self, name: str) -> int | None:
        rows = self._rows("SELECT number FROM visits WHERE name = ?", (name,), "number")
        return rows[0][0] if rows else None

    def add_visit(self, name: str) -> int:
        """The number of a visit, which is made if it is new. Raises ConfigError if none can have this name."""
        check_values(self.path, visit_name=name)
        with self._transaction() as connection:
            connection.execute("INSERT INTO visits (name) VALUES (?) ON CONFLICT DO NOTHING", (name,))
        return int(self._rows("SELECT number FROM visits WHERE name = ?", (name,), "number")[0][0])

    def visits(self) -> list[str]:
        """Names of the visits, oldest first."""
        return [name for (name,) in self._rows("SELECT name FROM visits ORDER BY number", (), "name")]

    def changes(self, since: int) -> list[CellChange]:
        """Cells that the visit of this number or later ones added or refreshed, sorted."""
        query = (
            "SELECT x, y, z, MAX(added), MAX(changed) FROM changes WHERE visit >= ? GROUP BY x, y, z ORDER BY x, y, z"
        )
        rows = self._rows(query, (since,), "x", "y", "z", "added", "changed")
        return [CellChange((x, y, z), bool(added), changed) for x, y, z, added, changed in rows]

    def check(self, writes: Iterable[CellWrite]) -> None:
        """Raises ConfigError if something that is to be written could not be read again."""
        for write in writes:
            check_values(self.path, **dict(zip("xyz", write.key, strict=True)))
            for name, value in (("recorded_at", write.recorded_at), ("changed", write.changed)):
                check_values(self.path, **{name: float(value) if isinstance(value, float) else value})  # of NumPy, too
            for count in write.counts.values():
                check_values(self.path, count=count)

    def commit(self, writes: Sequence[tuple[CellWrite, int, Mapping[str, tuple[int, int]]]], visit: int | None) -> None:
        """Makes written versions the current ones, all in one transaction.

        Args:
            writes: for each cell what was written, its version, and size and CRC-32 of each part.
            visit: number of the visit, or None.
        """
        with self._transaction() as connection:
            for write, version, sizes in writes:
                query = "SELECT recorded_at FROM cells WHERE x = ? AND y = ? AND z = ?"
                known = connection.execute(query, write.key).fetchone()
                connection.execute(
                    "INSERT INTO cells VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET version = excluded.version, "
                    "recorded_at = COALESCE(excluded.recorded_at, recorded_at), "
                    "visit = COALESCE(excluded.visit, visit)",
                    (*write.key, version, write.recorded_at, visit),
                )
                rows = [(*write.key, n, version, write.counts.get(n, 0), *size) for n, size in sizes.items()]
                connection.executemany("INSERT OR REPLACE INTO parts VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
                if visit is not None and write.recorded_at is not None:
                    connection.execute(
                        "INSERT INTO changes VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET "
                        "changed = MAX(COALESCE(changed, excluded.changed), COALESCE(excluded.changed, changed))",
                        (visit, *write.key, known is None or known[0] is None, write.changed),
                    )
            connection.execute("UPDATE store SET last_version = MAX(last_version, ?)", (max(w[1] for w in writes),))

    def remove(self, key: CellKey) -> None:
        """Forgets a cell, and what visits did to it."""
        with self._transaction() as connection:
            for table in ("cells", "parts", "changes"):
                connection.execute(f"DELETE FROM {table} WHERE x = ? AND y = ? AND z = ?", key)

    def remove_part(self, key: CellKey, name: str) -> None:
        """Forgets a part of a cell."""
        with self._transaction() as connection:
            connection.execute("DELETE FROM parts WHERE x = ? AND y = ? AND z = ? AND name = ?", (*key, name))

    def _rows(self, query: str, values: Sequence[Any], *columns: str) -> list[tuple]:
        """What is found, of which each column may be what `index_schema.COLUMNS` says of it."""
        with self._lock, _explain_errors(self.path):
            self._steps.begin()
            rows = self._connection.execute(query, values).fetchall()
        check_rows(self.path, rows, *columns)
        return rows

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock, _explain_errors(self.path):
            self._steps.begin()
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):  # SQLite may have rolled back by itself
                    self._connection.execute("ROLLBACK")
                raise


def _refuse_other_files(path: Path, write: bool) -> None:
    """SQLite opens what lies beside an index by name, and writes to it even for readers: links and pipes are refused.
    The index itself is only read unless `write`, so that a store copied with hard links can be read."""
    beside = [path.with_name(path.name + ending) for ending in ("-wal", "-shm", "-journal")]
    for file in (path, *beside):
        with suppress(FileNotFoundError):
            found = file.lstat()
            if not stat.S_ISREG(found.st_mode):
                raise FormatError(f"{file}: is not a regular file")
            if write or file != path:
                refuse_shared_file(file, found, "copy the store without hard links (`cp -r`)", FormatError)


class _Steps:
    """Stops SQLite when it takes more steps than a file of this size can need: a damaged one may lead in circles."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path, self._taken, self._most = path, 0, 0
        connection.set_progress_handler(self._count, IndexTuning.steps_at_once)

    def begin(self) -> None:
        """The next statements begin."""
        self._taken = 0

    def _count(self) -> int:
        self._taken += IndexTuning.steps_at_once
        if self._taken > self._most:  # the file may have grown
            with suppress(OSError):
                self._most = IndexTuning.min_steps + IndexTuning.steps_per_byte * self._path.stat().st_size
        return int(self._taken > self._most)


def _connect(path: Path, write: bool) -> sqlite3.Connection:
    uri = f"{path.resolve().as_uri()}?mode={'rw' if write else 'ro'}"
    connection = sqlite3.connect(
        uri, uri=True, isolation_level=None, check_same_thread=False, timeout=IndexTuning.busy_s
    )
    _limit(connection)
    if not write:
        try:
            connection.execute("SELECT 1 FROM sqlite_master").fetchone()
        except sqlite3.OperationalError as error:  # in a folder closed to writing the log has no shared memory
            connection.close()
            if not any(word in str(error) for word in ("unable to open", "readonly")):
                raise
            if _has_log(path):
                raise RunFolderError(
                    f"{path}: its last writer did not close it; it must be opened once where it can be written"
                ) from error
            connection = sqlite3.connect(f"{uri}&immutable=1", uri=True, check_same_thread=False)
            _limit(connection)
    return connection


def _limit(connection: sqlite3.Connection) -> None:
    """What a file from elsewhere may not make SQLite do."""
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    connection.execute("PRAGMA synchronous = FULL")
    if sys.version_info >= (3, 11):
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, IndexTuning.max_value_bytes)
        connection.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, IndexTuning.max_value_bytes)
        connection.setlimit(sqlite3.SQLITE_LIMIT_COLUMN, 64)
        connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)


def _has_log(path: Path) -> bool:
    """Whether the write-ahead log holds anything."""
    log = path.with_name(path.name + "-wal")
    return log.exists() and log.stat().st_size > 0


def _check_size(path: Path, connection: sqlite3.Connection) -> None:
    """SQLite sees that whole pages are missing, but takes what is missing of the last page for zeros."""
    page = connection.execute("PRAGMA page_size").fetchone()[0]
    size = path.stat().st_size
    if size % page and not _has_log(path):
        raise FormatError(f"{path}: truncated: {size} bytes are not a multiple of the page size {page}")


def _read_settings(path: Path, connection: sqlite3.Connection) -> SubmapSettings:
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application != _APPLICATION:
        raise FormatError(f"{path}: not the index of a grid store (application id {application:#x})")
    if version not in SCHEMAS:
        raise FormatError(f"{path}: format version {version}, this program reads versions up to {max(SCHEMAS)}")
    check_schema(path, connection, version)
    try:
        return SubmapSettings(**json.loads(connection.execute("SELECT settings FROM store").fetchone()[0]))
    except (TypeError, ValueError, RecursionError, ConfigError) as error:
        raise FormatError(f"{path}: damaged settings: {error}") from None


@contextmanager
def _explain_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise _explanation(path, error) from error
    except UnicodeDecodeError as error:  # text in the file, or SQLite's message about it
        raise FormatError(f"{path}: damaged: {error}") from error


def _explanation(path: Path, error: sqlite3.Error) -> GgslamError:
    reason = str(error)
    if "interrupted" in reason:
        return FormatError(f"{path}: damaged: takes more steps to read than a file of its size can")
    if any(word in reason for word in ("malformed", "not a database", "no such", "disk image", "too big")):
        return FormatError(f"{path}: damaged: {reason}")
    failure = RunFolderError(f"{path}: {reason}")
    if "full" in reason or "I/O" in reason:
        failure.exit_code = 1
    return failure
