# SPDX-License-Identifier: Apache-2.0
"""What people read holds no numbers of errors and no names of hidden folders, whoever wrote the message."""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path

import pytest
from command_line import ggslam

from ggslam.cli.console import PlainConsole
from ggslam.errors import CoreMemoryError, FormatError, GgslamError, InputError, plain
from ggslam.runs.records.run_json import RunRecord
from ggslam.system.staging import new_staging, publish

ERROR = OSError(errno.ENOSPC, "No space left on device", "runs/a/.staged-12-0123abcd/map.ply")
SAID = "No space left on device: 'runs/a/map.ply'"


@pytest.mark.parametrize("kind", [GgslamError, FormatError, InputError, CoreMemoryError])
def test_errors(kind: type[GgslamError]) -> None:
    assert str(kind(f"saving: {ERROR}")) == f"saving: {SAID}" and kind(f"{ERROR}").args == (SAID,)
    moved = OSError(errno.EXDEV, "Invalid link", "a/.staged-1-00000000/x", None, "b")
    assert str(kind(f"{moved}")) == "Invalid link: 'a/x' -> 'b'"
    assert str(kind()) == "" and kind("a", 3).args == ("a", 3)


def test_printing() -> None:
    out = io.StringIO()
    PlainConsole(file=out).print(f"note: {ERROR}", markup=False)
    assert out.getvalue() == f"note: {SAID}\n"


@pytest.mark.parametrize(("text", "said"), [
    ("cannot write a/.staged-12-0123abcd: File too large", "cannot write a: File too large"),
    ("cannot write a/.staged-12-0123abcd/renders/0.png: full", "cannot write a/renders/0.png: full"),
    ("cannot write b/.e.ggz-coming-12-0123abcd/map.bin: full", "cannot write b/e.ggz: full"),
    ("cannot write .e.ggz-coming-12-0123abcd/map.bin: full", "cannot write e.ggz: full"),
    ("b/.my st.grid-coming-12-0123abcd: cannot be made: full", "b/my st.grid: cannot be made: full"),
    ("st/.index-14532-89abcdef: disk I/O error", "st/index.sqlite: disk I/O error"),
    ("full: 'a/.map.12-0123abcd.ply' -> 'a/map.ply'", "full: 'a/map.ply' -> 'a/map.ply'"),
    ("cannot write a/.a b.tar.12-0123abcd.gz: full", "cannot write a/a b.tar.gz: full"),
    ("cannot write a/.noending.12-0123abcd: full", "cannot write a/noending: full"),
])  # fmt: skip
def test_what_is_being_made_has_the_name_that_it_is_to_have(text: str, said: str) -> None:
    assert plain(text) == said and plain(said) == said


@pytest.mark.parametrize("text", [
    "[Errno] x", "Errno 5", "a/.staged-1-00000000: is a link", ".staged/x", "[0] a/b",
    "a/.a-coming-1-00000000: is a link", "a/.staged-1-00000000: holds a link, map.ply",
    "a/.map.ply.lock: x", "a/room.12-0123abcd.ply", "a/.index/x",
    "a/.staged-1-000000001/x",
])  # fmt: skip
def test_what_is_something_else_stays(text: str) -> None:
    assert plain(text) == text


def test_a_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    done = ggslam("export", tmp_path / "no-run", "--out", tmp_path / "file" / "map.ply")
    assert done.returncode == 2 and "Errno" not in done.stderr


def test_files_that_cannot_change_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, target: Path) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self), None, str(target))

    staged = new_staging(tmp_path)
    staged.mkdir()
    (staged / "map.ply").write_text("new")
    RunRecord(ggslam="1").write(staged)
    with monkeypatch.context() as patch, pytest.raises(GgslamError) as failed:
        real = Path.replace
        patch.setattr(Path, "replace", lambda a, b: refuse(a, b) if ".staged" in str(a) else real(a, b))
        publish(staged, tmp_path, RunRecord.FILE, [], {})
    text = str(failed.value)
    assert text.startswith(f"{tmp_path}: not all files could be put into place; the next command on it will go on: ")
    assert text.endswith("Read-only file system") and staged.is_dir()  # what waits is kept


@pytest.mark.parametrize("count", [300, 5000])
@pytest.mark.parametrize(
    "words", [("inspect", "LONG"), ("run", "a", "--out", "LONG"), ("submaps", "LONG"), ("batch", "LONG"),
              ("verify", "LONG"), ("view", "LONG"), ("synth", "LONG")],
    ids=" ".join,
)  # fmt: skip
def test_names_that_are_too_long(words: tuple[str, ...], count: int, tmp_path: Path) -> None:
    done = ggslam(*("x" * count if word == "LONG" else word for word in words))
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and len(done.stderr) < 500, done.stderr
