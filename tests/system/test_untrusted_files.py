# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from little_memory import with_little_memory

from ggslam.errors import FormatError, RunFolderError, SequenceError
from ggslam.system.untrusted_files import (
    copy_untrusted,
    copy_untrusted_folder,
    given_path,
    is_plain_name,
    member,
    printable,
    read_untrusted,
    read_untrusted_text,
    refuse_links,
)


def test_a_file_is_read_within_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"12345")
    assert read_untrusted(path) == read_untrusted(path, 5) == b"12345"
    with pytest.raises(FormatError, match=r"a\.bin: .*\b5\b.*\b4\b"):
        read_untrusted(path, 4)


@pytest.mark.parametrize("kind", ["missing", "folder", "pipe", "device", "socket", "linked pipe"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)  # reading it would wait for ever
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        socket.socket(socket.AF_UNIX).bind(str(path))
    elif kind == "linked pipe":
        os.mkfifo(tmp_path / "b")
        path.symlink_to("b")
    with pytest.raises(RunFolderError, match="missing" if kind == "missing" else "not a regular file"):
        read_untrusted(path, 10, RunFolderError)


@pytest.mark.parametrize(("room", "kind", "exit_code"), [(40, "MemoryFullError", 1), (200, "nothing", 0)])
def test_full_memory_is_no_fault_of_a_small_file(tmp_path: Path, room: int, kind: str, exit_code: int) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(60 << 20))
    prelude = "from ggslam.system.untrusted_files import read_untrusted"
    ended = with_little_memory(prelude, "read_untrusted(path)", path, room << 20)
    assert (ended.kind, ended.exit_code) == (kind, exit_code)
    if exit_code:
        assert ended.message == f"{path}: memory is full: no room for its 62,914,560 bytes"
        assert ended.taken < 5 << 20


def test_a_file_that_no_machine_holds_is_the_fault_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with path.open("wb") as file:
        file.truncate(1 << 42)
    with pytest.raises(FormatError, match="4,398,046,511,104"):
        read_untrusted(path)


def test_no_more_is_read_than_there_was(tmp_path: Path) -> None:
    """Files in /proc have no size and may go on for ever."""
    if Path("/proc/self/pagemap").exists():
        assert read_untrusted("/proc/self/pagemap") == b""


def test_text_may_have_any_line_ends_and_a_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo\rthree\n")
    assert read_untrusted_text(path) == "one\ntwo\nthree\n"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="as text"):
        read_untrusted_text(path)


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "/etc", "..\\x", "a\0", "a" * 256, None, 3, ["x"], "\ud800"])
def test_names_that_lead_elsewhere(name: object) -> None:
    assert not is_plain_name(name)
    assert is_plain_name("map.ply") and is_plain_name("..map") and is_plain_name("Stra\xdfe \U0001f40e")
    assert is_plain_name(os.fsdecode(b"caf\xe9"))  # of an old system: no UTF-8, but a name all the same


def test_members_stay_in_their_folder(tmp_path: Path) -> None:
    inside = tmp_path / "recording"
    (inside / "rgb").mkdir(parents=True)
    (inside / "out").symlink_to(tmp_path)
    (inside / "in").symlink_to(inside / "rgb")
    assert member(inside, "rgb/0.png") == inside / "rgb" / "0.png"
    assert member(inside, "in/0.png") == inside / "in" / "0.png"
    for name in ("../secret", "/etc/passwd", "out/secret", "rgb/../../secret", "a\0b"):
        with pytest.raises(FormatError):
            member(inside, name)


def test_links_out_of_a_folder_are_found_however_deep(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / "renders" / "deep").mkdir(parents=True)
    (folder / "latest").symlink_to("renders")
    (folder / "loop").symlink_to(folder)
    refuse_links(folder)
    (tmp_path / "named").symlink_to(folder)
    refuse_links(tmp_path / "named")  # whoever names a link has chosen where it leads
    (folder / "renders" / "deep" / "x.png").symlink_to("/etc/passwd")
    with pytest.raises(FormatError, match=r"deep/x\.png: .*/etc/passwd"):
        refuse_links(folder)


def test_control_characters_are_shown_not_sent() -> None:
    assert printable("mug \x1b[2J\x07\u202e\n\tä 杯") == "mug \\x1b[2J\\x07\\x202e\n\tä 杯"


def test_a_copy_is_within_its_limit(tmp_path: Path) -> None:
    data = os.urandom((1 << 21) + 17)
    (tmp_path / "a").write_bytes(data)
    copy_untrusted(tmp_path / "a", tmp_path / "b", len(data))
    assert (tmp_path / "b").read_bytes() == data
    os.truncate(tmp_path / "a", 50 << 30)
    with pytest.raises(RunFolderError, match="a: .*53,687,091,200"):
        copy_untrusted(tmp_path / "a", tmp_path / "c", 1 << 20, RunFolderError)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("leads_to", ["..", "b.txt", "/etc"])
def test_a_folder_is_copied_without_its_links(tmp_path: Path, leads_to: str) -> None:
    source = tmp_path / "source"
    (source / "inner").mkdir(parents=True)
    (source / "inner" / "b.txt").write_text("b")
    (source / "a.txt").write_text("a")
    copy_untrusted_folder(source, tmp_path / "copy", 10)
    assert sorted(p.relative_to(tmp_path / "copy").as_posix() for p in (tmp_path / "copy").rglob("*")) == [
        "a.txt", "inner", "inner/b.txt",
    ]  # fmt: skip
    assert (tmp_path / "copy" / "inner" / "b.txt").read_text() == "b"
    (source / "inner" / "z").symlink_to(leads_to)
    with pytest.raises(FormatError, match="inner/z: is a link"):
        copy_untrusted_folder(source, tmp_path / "again", 10)


@pytest.mark.parametrize(
    "text", ["n" * 256, "a/" + "ü" * 128, "n" * 200 + "/" + "m" * 5000, "a/" * 2048, "a\0b", "\0", "a\ud800b"]
)
def test_paths_that_no_file_can_have(text: str) -> None:
    with pytest.raises(SequenceError) as error:
        given_path(text)
    assert len(str(error.value)) < 120 and "\0" not in str(error.value)


@pytest.mark.parametrize("text", ["n" * 255, "ü" * 127, "a/" * 2047 + "b", "", ".", "/", os.fsdecode(b"\xff" * 255)])
def test_paths_that_files_can_have(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert given_path(text) == Path(text)
    assert given_path(text).exists() == (text in ("", ".", "/"))  # no error
