# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import zipfile
from pathlib import Path

import pytest
from little_memory import with_little_memory

from ggslam.errors import SequenceError
from ggslam.system.zip_files import open_zip, read_member

WAYS = {"stored": zipfile.ZIP_STORED, "deflated": zipfile.ZIP_DEFLATED, "bzip2": zipfile.ZIP_BZIP2,
        "LZMA": zipfile.ZIP_LZMA}  # fmt: skip


def archive_of(path: Path, way: str, megabytes: float, name: str = "a") -> Path:
    with zipfile.ZipFile(path, "w", WAYS[way]) as archive, archive.open(name, "w", force_zip64=True) as member:
        for _ in range(int(megabytes * 16)):
            member.write(bytes(1 << 16))
    return path


@pytest.mark.parametrize("way", ["stored", "deflated"])
def test_members_are_read_within_a_limit(tmp_path: Path, way: str) -> None:
    path = archive_of(tmp_path / "a.zip", way, 1)
    with open_zip(path) as archive:
        assert read_member(archive, "a", 1 << 20) == bytes(1 << 20)
        with pytest.raises(ValueError, match="a.*1,048,576.*1,048,575"):
            read_member(archive, "a", (1 << 20) - 1)
        with pytest.raises(KeyError):
            read_member(archive, "b", 1)


@pytest.mark.parametrize("way", ["bzip2", "LZMA"])
def test_members_that_are_unpacked_at_once_are_not_read(tmp_path: Path, way: str) -> None:
    path = archive_of(tmp_path / "a.zip", way, 1)
    with pytest.raises(ValueError, match="a is packed by a method that is not read"), open_zip(path):
        pass


def test_no_more_is_unpacked_than_a_member_claims(tmp_path: Path) -> None:
    """300 MB of zeros behind a claim of 1 kB, in the directory and before the member."""
    path = archive_of(tmp_path / "a.zip", "deflated", 300)
    data = path.read_bytes()
    claim, true = (1000).to_bytes(8, "little"), (300 << 20).to_bytes(8, "little")
    short = (300 << 20).to_bytes(4, "little")
    data = data.replace(true, claim).replace(short, claim[:4])
    path.write_bytes(data)
    ended = with_little_memory(
        "from ggslam.system.zip_files import ZIP_DAMAGE, open_zip, read_member",
        "with open_zip(path) as archive: print(len(read_member(archive, 'a', 2000)))", path, 100 << 20,
    )  # fmt: skip
    assert ended.taken < 20 << 20
    assert ended.kind in ("nothing", "BadZipFile"), ended  # Python looks at a checksum at the end only


@pytest.mark.parametrize("kind", ["missing", "pipe", "device", "folder"])
def test_what_is_no_file_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.zip"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(SequenceError, match="missing" if kind == "missing" else "not a regular file"), \
            open_zip(path, SequenceError):  # fmt: skip
        pass
