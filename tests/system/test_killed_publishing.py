# SPDX-License-Identifier: Apache-2.0
"""A program killed while files change places leaves the old ones or what is needed to finish with the new ones."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from ggslam.system.staging import finish_saving, is_being_saved, make_staging, new_staging, publish

MARKER = "run.json"
OLD = {"map.ply": "old", "points.ply": "old", MARKER: '{"of": "old"}'}
NEW = {"map.ply": "new", "cloud.ply": "new", MARKER: '{"of": "new"}'}


def files_of(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if not path.name.startswith(".")}


def publish_and_die(target: Path, renames: int) -> int:
    """Publishes in another process, which is killed before it renames a file once more than `renames` times."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    replace, done = Path.replace, 0

    def counted(self: Path, to: Path) -> Path:
        nonlocal done
        if done == renames:
            os._exit(9)
        done += 1
        return replace(self, to)

    try:
        Path.replace = counted  # type: ignore[assignment, method-assign]
        staged = make_staging(target)
        for name, text in NEW.items():
            (staged / name).write_text(text)
        publish(staged, target, MARKER, ["points.ply"], {})
        os._exit(0)
    finally:
        os._exit(1)


@pytest.mark.parametrize("renames", range(5))
def test_what_was_killed_between_writing_and_exchange_is_old_or_new(tmp_path: Path, renames: int) -> None:
    for name, text in OLD.items():
        (tmp_path / name).write_text(text)
    assert publish_and_die(tmp_path, renames) == (9 if renames < 4 else 0)
    begun = is_being_saved(tmp_path, MARKER)
    assert begun == (0 < renames < 4)
    new_staging(tmp_path)  # the next program sweeps what dead ones left, but not what waits to be put into place
    finish_saving(tmp_path, MARKER)
    assert files_of(tmp_path) == (OLD if renames == 0 else NEW)
    assert not list(tmp_path.glob(".staged-*"))


def test_only_what_waits_is_kept_of_two_dead_programs(tmp_path: Path) -> None:
    for name, text in OLD.items():
        (tmp_path / name).write_text(text)
    assert publish_and_die(tmp_path, 1) == 9
    waiting = json.loads((tmp_path / MARKER).read_text())["saving"]["from"]
    other = tmp_path / f"{waiting[:-8]}{'0' * 8}"
    other.mkdir()
    new_staging(tmp_path)
    assert [path.name for path in tmp_path.glob(".staged-*")] == [waiting]
