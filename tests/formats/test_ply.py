# SPDX-License-Identifier: Apache-2.0
"""PLY files: what is written is read back; every encoding is read; damaged and hostile files are refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError, RunFolderError
from ggslam.formats.ply import read_ply, write_ply

VERTEX = np.array([(1.5, -2.25, 7), (3.0, 4.0, 255)], [("x", "f4"), ("y", "f8"), ("red", "u1")])
FACE = np.array([([0, 1, 0], 5), ([1, 0, 1], -6)], [("vertex_indices", "i4", (3,)), ("label", "i2")])


def header(encoding: str, vertices: int = 2, faces: int = 2) -> str:
    return (
        f"ply\nformat {encoding} 1.0\ncomment made by hand\nelement vertex {vertices}\nproperty float x\n"
        f"property float64 y\nproperty uchar red\nelement face {faces}\nproperty list uchar int vertex_indices\n"
        "property short label\nend_header\n"
    )


def binary_body(order: str) -> bytes:
    body = VERTEX.astype(VERTEX.dtype.newbyteorder(order)).tobytes()
    for indices, label in FACE:
        body += b"\x03" + indices.astype(order + "i4").tobytes() + np.array(label, order + "i2").tobytes()
    return body


def encoded(encoding: str) -> bytes:
    if encoding == "ascii":
        return (header(encoding) + "1.5 -2.25 7\n3 4e0 255\n3 0 1 0 5\n3 1 0 1 -6").encode()
    return header(encoding).encode() + binary_body("<" if encoding == "binary_little_endian" else ">")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_encoding_is_read(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(encoded(encoding))
    ply = read_ply(path)
    assert ply.comments == ["made by hand"]
    np.testing.assert_array_equal(ply.elements["vertex"], VERTEX)
    np.testing.assert_array_equal(ply.elements["face"], FACE)
    assert ply.elements["vertex"].dtype.isnative and ply.elements["face"]["vertex_indices"].dtype.isnative


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_of_different_length(tmp_path: Path, encoding: str) -> None:
    text = f"ply\nformat {encoding} 1.0\nelement face 3\nproperty list uchar short i\nproperty uchar n\nend_header\n"
    lists, path = [[1, 2], [], [-3, 4, 5]], tmp_path / "a.ply"
    if encoding == "ascii":
        body = "\n".join(" ".join(map(str, [len(i), *i, 9])) for i in lists).encode()
    else:
        order = "<" if "little" in encoding else ">"
        body = b"".join(bytes([len(i)]) + np.array(i, order + "i2").tobytes() + b"\x09" for i in lists)
    path.write_bytes(text.encode() + body)
    face = read_ply(path).elements["face"]
    assert [list(row) for row in face["i"]] == lists and face["n"].tolist() == [9, 9, 9]


def test_written_files_are_read_back_and_follow_the_specification(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, {"vertex": VERTEX, "face": FACE}, ["two words"])
    ply = read_ply(path)
    np.testing.assert_array_equal(ply.elements["vertex"], VERTEX)
    np.testing.assert_array_equal(ply.elements["face"], FACE)
    head, body = path.read_bytes().split(b"end_header\n", 1)
    assert b"format binary_little_endian 1.0\ncomment two words\nelement vertex 2\nproperty float x\n" in head
    assert b"property double y\nproperty uchar red\n" in head
    assert b"element face 2\nproperty list uchar int vertex_indices\nproperty short label\n" in head
    assert body == binary_body("<")


def test_empty_elements_and_windows_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, {"vertex": VERTEX[:0], "face": FACE[:0]})
    ply = read_ply(path)
    assert len(ply.elements["vertex"]) == 0 and ply.elements["vertex"].dtype.names == ("x", "y", "red")
    path.write_bytes(header("binary_little_endian").replace("\n", "\r\n").encode() + binary_body("<"))
    np.testing.assert_array_equal(read_ply(path).elements["face"], FACE)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_cut_is_refused(tmp_path: Path, encoding: str) -> None:
    whole, path = encoded(encoding), tmp_path / "cut.ply"
    # An ASCII file cut inside its very last number cannot be told from a whole one.
    for length in range(len(whole) - (2 if encoding == "ascii" else 0)):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError, match=r"cut\.ply"):
            read_ply(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("element vertex 2", "element vertex 4000000000000"), "claims 4000000000000 rows"),
        (("element face 2", "element face 99999999999999999999"), "claims"),
        (("element vertex 2", "element vertex -1"), "negative count"),
        (("element vertex 2", "element vertex many"), "header line 4"),
        (("element vertex 2", "element vertex"), "header line 4"),
        (("property float x", "property quad x"), "'quad'"),
        (("property float x", "property float y"), "declared twice"),
        (("list uchar int", "list float int"), "list length"),
        (("format binary_little_endian 1.0", "format middle_endian 1.0"), "format line"),
        (("format binary_little_endian 1.0\n", ""), "no format line"),
        (("element face 2", "element vertex 2"), "declared twice"),
        (("comment", "comet"), "unknown keyword"),
        (("ply\n", "PLAY\n"), "not a PLY file"),
        (("element vertex 2\n", ""), "property before"),
        (("end_header", "element nothing 7\nend_header"), "no properties"),
    ],
)
def test_hostile_headers_are_refused(tmp_path: Path, change: tuple[str, str], reason: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(header("binary_little_endian").replace(*change).encode() + binary_body("<"))
    with pytest.raises(FormatError, match=reason):
        read_ply(path)


def test_damaged_lists_and_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.ply"
    text = "ply\nformat {} 1.0\nelement face 2\nproperty list {} int i\nend_header\n"
    path.write_bytes(text.format("binary_little_endian", "int").encode() + np.array([2**31 - 1, 1], "<i4").tobytes())
    with pytest.raises(FormatError, match=r"bad\.ply: truncated"):
        read_ply(path)
    path.write_bytes(text.format("binary_little_endian", "int").encode() + np.array([-1, 1], "<i4").tobytes())
    with pytest.raises(FormatError, match=r"bad\.ply: truncated"):
        read_ply(path)
    for body in ("1 2\nnan 3\n", "1 2\n-1 3\n", "1 2\n1 2.5\n", "1 2\n1 3000000000\n", "1 x\n1 2\n"):
        path.write_text(text.format("ascii", "uchar") + body)
        with pytest.raises(FormatError, match="bad.ply"):
            read_ply(path)


def test_missing_file_endless_header_and_unwritable_values(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"none\.ply.*missing"):
        read_ply(tmp_path / "none.ply")
    (tmp_path / "long.ply").write_bytes(b"ply\n" + b"comment x\n" * 200_000)
    with pytest.raises(FormatError, match="end_header"):
        read_ply(tmp_path / "long.ply")
    with pytest.raises(ValueError, match="no type"):
        write_ply(tmp_path / "a.ply", {"vertex": np.zeros(2, [("x", "i8")])})
    with pytest.raises(ValueError, match="comment"):
        write_ply(tmp_path / "a.ply", {"vertex": VERTEX}, ["a\nend_header"])
    with pytest.raises(ValueError, match="one ASCII word"):
        write_ply(tmp_path / "a.ply", {"a b": VERTEX})
    with pytest.raises(RunFolderError, match=r"a\.ply"):
        write_ply(tmp_path / "none" / "a.ply", {"vertex": VERTEX})
    assert not (tmp_path / "a.ply").exists()


def test_a_write_that_breaks_off_leaves_the_old_file(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource", reason="limits of file size exist on POSIX systems only")
    write_ply(tmp_path / "a.ply", {"vertex": VERTEX})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))  # stands in for a disk that is full after 4 KiB
    try:
        with pytest.raises(RunFolderError, match=r"a\.ply: File too large"):
            write_ply(tmp_path / "a.ply", {"vertex": np.repeat(VERTEX, 10_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").elements["vertex"], VERTEX)


def test_real_clouds_are_read(shared_data: Path) -> None:
    path = shared_data / "clouds" / "angel.ply"
    if not path.exists():
        pytest.skip(f"no {path.name}")
    assert len(read_ply(path).elements["vertex"]) > 1000
