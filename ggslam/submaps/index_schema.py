# SPDX-License-Identifier: Apache-2.0
"""The tables of a store's index and the values their columns may hold; checks an index from elsewhere against both.

A schema is a program: generated columns, constraints and views run whenever a table is read. So nothing is read of an
index whose schema is not, but for spaces, what this program would have written; and of its rows nothing is taken that
no column may hold.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, Final

from ggslam.errors import ConfigError, FormatError
from ggslam.submaps.cell_keys import is_coordinate
from ggslam.system.tuning import Tuning

_TABLES = """
CREATE TABLE store (settings TEXT NOT NULL, last_version INTEGER NOT NULL){strict};
CREATE TABLE visits (number INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE){strict};
CREATE TABLE cells (x INTEGER, y INTEGER, z INTEGER, version INTEGER NOT NULL, recorded_at REAL, visit INTEGER,
                    PRIMARY KEY (x, y, z)) {strict_and}WITHOUT ROWID;
CREATE TABLE parts (x INTEGER, y INTEGER, z INTEGER, name TEXT, version INTEGER NOT NULL, count INTEGER NOT NULL,
                    bytes INTEGER NOT NULL, crc INTEGER NOT NULL,
                    PRIMARY KEY (x, y, z, name)) {strict_and}WITHOUT ROWID;
CREATE TABLE changes (visit INTEGER, x INTEGER, y INTEGER, z INTEGER, added INTEGER NOT NULL, changed REAL,
                      PRIMARY KEY (visit, x, y, z)) {strict_and}WITHOUT ROWID;
"""
SCHEMAS = {
    1: _TABLES.format(strict="", strict_and=""),
    2: _TABLES.format(strict=" STRICT", strict_and="STRICT, "),
}
"""By format version. Those of version 2 refuse values of other types; SQLite knows such tables since 3.37."""
NEWEST = 2 if sqlite3.sqlite_version_info >= (3, 37) else 1
"""Format version that is written."""

_MOST: Final = 2**53
"""Whole numbers up to this one are exact in float64, too."""


class IndexLimits(Tuning):
    """Values that an index may hold."""

    max_name = 4096
    """Longest name in characters."""


def check_schema(path: Path, connection: sqlite3.Connection, version: int) -> None:
    """Raises FormatError unless the tables are those of a format version, and there is nothing besides."""
    found = _objects_of(connection)
    if found == _objects_to_expect(version):
        return
    known = {name for _, name, _ in _objects_to_expect(version)}
    strange = next((name for _, name, _ in found if name not in known), None)
    if strange is not None:
        raise FormatError(f"{path}: holds {strange!r:.60}, which no index of ggslam does")
    raise FormatError(f"{path}: its tables are not those of a grid store")


@cache
def _objects_to_expect(version: int) -> list[tuple[str, str, str]]:
    connection = sqlite3.connect(":memory:")
    try:
        connection.executescript(SCHEMAS[version])
        return _objects_of(connection)
    finally:
        connection.close()


def _objects_of(connection: sqlite3.Connection) -> list[tuple[str, str, str]]:
    """Kind, name and definition, spaces as one, of everything in a file; SQLite's own statistics are left out."""
    rows = connection.execute("SELECT type, name, sql FROM sqlite_master ORDER BY type, name").fetchall()
    return [(str(kind), str(name), re.sub(r"\s+", " ", str(sql))) for kind, name, sql in rows]


# --- what columns may hold -------------------------------------------------------------------------------------------

Reader = Callable[[Any], bool]


def _whole(low: int, high: int) -> Reader:
    return lambda value: type(value) is int and low <= value <= high


def _number_or_none(low: float, high: float) -> Reader:
    def fits(value: Any) -> bool:
        return value is None or (type(value) in (int, float) and math.isfinite(value) and low <= value <= high)

    return fits


def _is_name(value: Any) -> bool:
    return type(value) is str and len(value) <= IndexLimits.max_name


COLUMNS: dict[str, Reader] = {
    **dict.fromkeys("xyz", is_coordinate),
    **dict.fromkeys(("version", "count", "bytes", "number"), _whole(0, _MOST)),
    "crc": _whole(0, 2**32 - 1),
    "recorded_at": _number_or_none(-1e15, 1e15),
    "changed": _number_or_none(0, 1),
    "added": _whole(0, 1),
    "name": _is_name,
    "visit_name": lambda value: value is None or _is_name(value),
}
"""By what a value is; times in seconds."""


def is_time(value: Any) -> bool:
    """Whether a cell may have been recorded at this time, seconds or None."""
    return COLUMNS["recorded_at"](value)


def check_values(path: Path, **values: Any) -> None:
    """Raises ConfigError if a value that is to be written, by name of `COLUMNS`, could not be read again."""
    for name, value in values.items():
        if not COLUMNS[name](value):
            raise ConfigError(f"{path}: cannot hold {value!r:.40}: no {name} of a cell, a part or a visit")


def check_rows(path: Path, rows: Iterable[tuple[Any, ...]], *columns: str) -> None:
    """Raises FormatError if a row holds what its columns, by name of `COLUMNS`, may not."""
    readers = [COLUMNS[name] for name in columns]
    for row in rows:
        for fits, name, value in zip(readers, columns, row, strict=True):
            if not fits(value):
                raise FormatError(f"{path}: damaged: {value!r:.40} is no {name} of a cell, a part or a visit")
