# SPDX-License-Identifier: Apache-2.0
"""Files of arrays that somebody made to do harm: one clear error, and nothing large is allocated."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.lib import format as npy

from ggslam.errors import FormatError
from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays, read_array, read_arrays

FEW_BYTES = 80 << 20


def header(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    out = io.BytesIO()
    npy.write_array_header_1_0(out, {"descr": dtype, "fortran_order": False, "shape": shape})
    return out.getvalue()


def check_refused(path: Path, reason: str) -> None:
    tracemalloc.start()
    with pytest.raises(FormatError, match=reason) as caught:
        read_all_arrays(path, "votes")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < FEW_BYTES and str(path) in str(caught.value)


def test_an_archive_that_expands_to_gigabytes(tmp_path: Path) -> None:
    path = tmp_path / "votes.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w", force_zip64=True) as file,
    ):
        file.write(header((200 << 18,)))
        for _ in range(200):
            file.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 20
    check_refused(path, "claims")


def test_an_archive_that_claims_less_than_its_array(tmp_path: Path) -> None:
    path = tmp_path / "votes.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header((1 << 40,)) + bytes(64))
    check_refused(path, "claims")


@pytest.mark.parametrize("dtype", ["|O", "<c16", "<M8[s]", "|V9", "<m8"])
def test_types_that_nobody_needs(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "votes.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header((1,), dtype) + bytes(16))
    check_refused(path, "not numbers")


def test_an_encrypted_archive(tmp_path: Path) -> None:
    path = tmp_path / "votes.npz"
    data = bytearray(arrays_to_bytes(a=np.zeros(4)))
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(signature) + at] |= 1
    path.write_bytes(data)
    check_refused(path, "encrypted")


@pytest.mark.parametrize("place", range(0, 300, 7))
def test_any_damaged_byte_gives_one_error_or_the_arrays(tmp_path: Path, place: int) -> None:
    path = tmp_path / "votes.npz"
    out = io.BytesIO()
    np.savez_compressed(out, a=np.arange(100), b=np.eye(3))
    data = bytearray(out.getvalue())
    data[place] ^= 0xFF
    path.write_bytes(data)
    try:
        read_arrays(path, "votes", "a")
    except FormatError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x93NUMPY",
        header((1 << 40,)),
        header((4,), "|O") + bytes(32),
        header((-4,)) + bytes(16),
        b"\x93NUMPY\x09\x00",
    ],
)
def test_an_array_file_that_claims_too_much(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "points.npy"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"points\.npy"):
        read_array(path)
