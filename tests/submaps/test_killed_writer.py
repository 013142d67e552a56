# SPDX-License-Identifier: Apache-2.0
"""A writer killed at random moments loses nothing that it had completed, and leaves nothing half done."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
import zlib
from pathlib import Path

import pytest

from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings

Contents = dict[str, dict[str, int]]
"""CRC-32 by cell (its first coordinate) and part."""


def applied(before: Contents, operation: Contents) -> Contents:
    """What there is after an operation: parts that it does not name stay, a cell without any is removed."""
    after = dict(before)
    for cell, sums in operation.items():
        after.pop(cell, None) if not sums else after.update({cell: {**before.get(cell, {}), **sums}})
    return after


def possible(log: Path) -> tuple[list[Contents], int]:
    """What the store may hold: what was completed, or with what had begun; and how much was completed."""
    contents: Contents = {}
    begun: Contents | None = None
    done = 0
    for line in log.read_text().splitlines():
        name, *values = json.loads(line)
        if name == "begin":
            begun = values[0]
        elif name == "done":
            contents, begun, done = applied(contents, begun or {}), None, done + 1
        elif name == "found":
            contents, begun = values[0], None
    return [contents] if begun is None else [contents, applied(contents, begun)], done


def held(store: GridStore) -> Contents:
    return {
        str(key[0]): {name: zlib.crc32(store.get(key, name)) for name in store.cell(key).parts} for key in store.cells()
    }


def kill_once(folder: Path, log: Path, number: int) -> bool:
    """Starts a writer and kills it once it has completed something; whether that was while it was writing."""
    before = log.read_text().count('["done"]')
    script = Path(__file__).with_name("killed_writer.py")
    writer = subprocess.Popen([sys.executable, str(script), str(folder), str(log), str(number)])
    try:
        while log.read_text().count('["done"]') == before:  # the slower the disk, the longer
            assert writer.poll() is None, "the writer ended by itself"
            time.sleep(0.001)
        time.sleep(random.Random(number).uniform(0, 0.4))
        assert writer.poll() is None, "the writer ended by itself"
    finally:
        writer.kill()
        writer.wait()
    text = log.read_text()
    log.write_text(text[: text.rfind("\n") + 1])  # a line may be cut off
    return json.loads(log.read_text().splitlines()[-1])[0] == "begin"


@pytest.mark.parametrize("rounds", [4, pytest.param(100, marks=pytest.mark.slow)])
def test_kill(tmp_path: Path, rounds: int) -> None:
    folder, log = tmp_path / "map.grid", tmp_path / "log"
    GridStore.create(folder, SubmapSettings()).close()
    log.touch()
    interrupted = completed = number = 0
    while number < rounds or not interrupted:
        assert number < rounds + 50, "no kill met the writer while it was writing"
        interrupted += kill_once(folder, log, number)
        allowed, completed = possible(log)
        with GridStore.open(folder) as reader:
            assert held(reader) in allowed
        with GridStore.open(folder, write=True) as store:
            found = held(store)
            assert found in allowed
            on_disk = {tuple(path.relative_to(folder / "cells").parts) for path in (folder / "cells").glob("*/*/*")}
            indexed = {
                ("_".join(map(str, key)), str(part.version), name)
                for key in store.cells()
                for name, part in store.cell(key).parts.items()
            }
            assert on_disk == indexed  # no leftovers
            assert len(list((folder / "cells").glob("*/*"))) == len({path[:2] for path in indexed})
        with log.open("a") as file:
            file.write(json.dumps(["found", found]) + "\n")
        number += 1
    assert completed >= number
    print(f"{number} kills, {interrupted} while writing, {completed} operations completed")
