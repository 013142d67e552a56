# SPDX-License-Identifier: Apache-2.0
"""Faults of fault_table.py in files whose checksums are right and whose numbers are not: checkpoints, grid stores and
what is coded from them, as somebody else may have written them."""

from __future__ import annotations

import io
import json
import os
import sqlite3
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fault_bench import Place

Fault = Callable[[Place], None]
Change = Callable[[Any, list[np.ndarray]], None]


# --- checkpoints -----------------------------------------------------------------------------------------------------


def attributes_of(tree: Any, kind: str) -> dict[str, Any]:
    """Those of the first object of a class in the tree of a state."""
    if isinstance(tree, dict) and "o" in tree and str(tree["o"][0]).endswith(f".{kind}"):
        return dict(tree["o"][1])
    items = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return next((found for item in items if (found := attributes_of(item, kind))), {})


def array_of(tree: Any, kind: str, name: str, row: str = "") -> int:
    """Number of the array in an attribute, or in a row of its dictionary."""
    content = attributes_of(tree, kind)[name]
    if row:
        content = next(value for key, value in content["d"] if key == row)
    (place,) = content.values()
    return int(place["p"] if isinstance(place, dict) else place)


def negative_updates(tree: Any, arrays: list[np.ndarray]) -> None:
    number = array_of(tree, "GaussianMap", "rows", "updates")
    arrays[number] = np.full_like(arrays[number], -(2**31))


def infinite_pose(tree: Any, arrays: list[np.ndarray]) -> None:
    number = array_of(tree, "CameraMotion", "T_world_camera")
    arrays[number] = np.full_like(arrays[number], np.inf)


def other_types(tree: Any, arrays: list[np.ndarray]) -> None:
    number = array_of(tree, "ActiveKeyframes", "_cameras")
    arrays[number] = arrays[number].astype(np.int64)


def hostile_checkpoint(change: Change) -> Fault:
    """A run that was cut off, and a state whose sums are right."""
    from ggslam.system.array_file import read_array_file, write_array_file

    def happen(place: Place) -> None:
        place.map_recording(
            place.recording(), "--checkpoint-every", "3", after=lambda k: os.kill(os.getpid(), 9) if k == 8 else None
        )
        for state in (place.out / "checkpoints").glob("state-*.bin"):
            values, arrays = read_array_file(state)
            change(values["state"], arrays)
            write_array_file(state, values, arrays).finish()
        place.ended.clear()
        place.ggslam("run", "--resume", place.out)

    return happen


# --- grid stores -----------------------------------------------------------------------------------------------------


def hostile_store(change: Callable[[Path], None]) -> Fault:
    def happen(place: Place) -> None:
        store = place.folder / "map.grid"
        if place.ggslam("submaps", place.recording(), "--out", store).code:
            raise AssertionError(place.ended[-1].text)
        change(store)
        place.ended.clear()
        place.ggslam("localize", store, place.folder / "recording", "--out", place.folder / "found.txt")

    return happen


def in_index(*statements: str) -> Callable[[Path], None]:
    def change(store: Path) -> None:
        connection = sqlite3.connect(store / "index.sqlite")
        connection.execute("PRAGMA journal_mode = DELETE")
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return change


def infinite_camera(store: Path) -> None:
    """In the places of all cells, with their sums in the index."""
    for path in store.glob("cells/*/*/places.npz"):
        with np.load(path) as arrays:
            held = {**arrays, "camera": np.full(6, np.inf)}
        out = io.BytesIO()
        np.savez(out, **held)
        path.write_bytes(out.getvalue())
        x, y, z = path.parents[1].name.split("_")
        crc = zlib.crc32(out.getvalue())
        where = f"WHERE x = {x} AND y = {y} AND z = {z} AND name = 'places.npz'"
        in_index(f"UPDATE parts SET bytes = {path.stat().st_size}, crc = {crc} {where}")(store)


def huge_member(place: Place) -> None:
    """A store's Gaussians in one file, of which one cell has a number of sixty digits."""
    run, store, coded = place.run(), place.folder / "map.grid", place.folder / "map.ggc"
    for words in (("submaps", run, "--out", store), ("encode", store, coded)):
        if place.ggslam(*words).code:
            raise AssertionError(place.ended[-1].text)
    with zipfile.ZipFile(coded) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    old = next(name for name in members if name.startswith("cells/"))
    new = f"cells/{'9' * 60}_0_0.bin"
    with zipfile.ZipFile(coded, "w") as archive:
        for name, content in members.items():
            if name.endswith(".json"):
                content = json.dumps(json.loads(content)).replace(old, new).encode()
            archive.writestr(new if name == old else name, content)
    place.ended.clear()
    place.ggslam("decode", coded, place.folder / "again.grid")


FAULTS: dict[str, Fault] = {
    "a checkpoint's counters are negative": hostile_checkpoint(negative_updates),
    "a checkpoint has an infinite pose": hostile_checkpoint(infinite_pose),
    "a checkpoint has arrays of another type": hostile_checkpoint(other_types),
    "a store's index computes a column when it is read": hostile_store(
        in_index("ALTER TABLE cells ADD COLUMN more INTEGER AS (length(zeroblob(900000000))) VIRTUAL")
    ),
    "a cell lies at the end of 64 bits": hostile_store(in_index("UPDATE cells SET x = 9223372036854775807")),
    "a store's places were seen by an infinite camera": hostile_store(infinite_camera),
    "a coded cell has a number of 60 digits": huge_member,
}
