# SPDX-License-Identifier: Apache-2.0
"""A file is written whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from ggslam.errors import RunFolderError
from ggslam.system.atomic import atomic_write, write_text


def test_replaces_the_old_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with atomic_write(target, fsync=True) as temporary:
        assert temporary.suffix == ".txt" and temporary.parent == tmp_path
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("failure", [ValueError("x"), KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left")])
def test_failure_keeps_the_old_file(tmp_path: Path, failure: BaseException) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")
    expected = RunFolderError if isinstance(failure, OSError) else type(failure)
    with pytest.raises(expected), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise failure
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_names_file_and_reason(tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full on this system")
    with (
        pytest.raises(RunFolderError, match=r"a\.txt.*No space left"),
        atomic_write(tmp_path / "a.txt"),
        full.open("wb", buffering=0) as file,
    ):
        file.write(b"data")
    assert not list(tmp_path.iterdir())


def test_missing_folder_and_odd_targets_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="No such file"):
        write_text(tmp_path / "missing" / "a.txt", "x")
    with pytest.raises(RunFolderError, match="not a regular file"):
        write_text(tmp_path, "x")


def test_errors_of_other_files_pass_through(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.txt"):
        (tmp_path / "source.txt").read_text()
    assert not list(tmp_path.iterdir())


def test_a_link_keeps_pointing(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
