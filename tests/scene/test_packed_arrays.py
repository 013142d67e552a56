# SPDX-License-Identifier: Apache-2.0
"""Arrays come back bit for bit, in fewer bytes; damaged files are refused."""

from __future__ import annotations

import contextlib
import json
import lzma

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.scene.packed_arrays import pack_arrays, pack_bytes, unpack_arrays, unpack_bytes


def some_arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.integers(-9, 10, (4000, 3)), axis=0).astype(np.int16)
    return {
        "walk": walk, "extremes": np.array([[-32768, 32767], [32767, -32768], [0, -1]], np.int16),
        "bytes": rng.integers(-128, 128, (50, 3)).astype(np.int8), "floats": rng.normal(size=(3, 4, 4)),
        "odd": np.array([np.nan, -0.0, np.inf], np.float32), "one": np.array(2.5), "none": np.zeros((0, 3), np.int32),
        "wide": np.array([2**63 - 1, -(2**63), 7]), "yes": np.array([True, False]), "many": np.zeros(5000, np.uint8),
        "turned": walk[:, ::-1].T, "big": np.arange(5, dtype=">i4"),
    }  # fmt: skip


def test_arrays_come_back_bit_for_bit() -> None:
    arrays = some_arrays()
    data = pack_arrays(arrays)
    found = unpack_arrays(data)
    assert list(found) == list(arrays)
    for name, values in arrays.items():
        assert found[name].dtype == values.dtype.newbyteorder("=") and found[name].shape == values.shape, name
        assert found[name].tobytes() == values.astype(values.dtype.newbyteorder("=")).tobytes(), name
    assert len(pack_arrays({"walk": arrays["walk"]})) < 0.4 * arrays["walk"].nbytes
    assert pack_arrays(arrays) == data


def test_damage_is_refused() -> None:
    data = pack_arrays(some_arrays())
    rng = np.random.default_rng(1)
    for cut in (0, 10, 20, 100, len(data) - 1):
        with pytest.raises(FormatError):
            unpack_arrays(data[:cut])
    for _ in range(200):
        bad = bytearray(data)
        bad[rng.integers(20, len(bad))] ^= int(rng.integers(1, 256))
        with contextlib.suppress(FormatError):
            unpack_arrays(bytes(bad))  # a name may have become another one
    for size, shape in ((1 << 40, "[1099511627776]"), (5, "[5]")):
        body = lzma.compress(b"\0" * 4)
        head = f'[["a","|u1",{shape},"plain",{len(body)}]]'.encode()
        with pytest.raises(FormatError, match="bytes|size"):
            unpack_arrays(data[:16] + len(head).to_bytes(4, "little") + head + body)
        assert size > 4


def test_files_expand_to_no_more_than_is_allowed() -> None:
    packed = pack_bytes(b"\0" * 100_000)
    assert len(packed) < 300 and unpack_bytes(packed) == b"\0" * 100_000
    for damaged, most in ((packed, 99_999), (packed[:-3], 200_000), (packed + b"x", 200_000), (b"x" * 60, 100)):
        with pytest.raises(FormatError, match="damaged"):
            unpack_bytes(damaged, most)


def test_many_large_arrays_are_not_unpacked() -> None:
    """60 arrays of 60 MB in 0.6 MB: 3.6 GB."""
    body = lzma.compress(bytes(60_000_000), preset=1)
    head = json.dumps([[f"a{k}", "|u1", [60_000_000], "plain", len(body)] for k in range(60)]).encode()
    data = b"ggslam-arrays-1\n" + len(head).to_bytes(4, "little") + head + 60 * body
    assert len(data) < 1_000_000
    with pytest.raises(FormatError, match=r"\b60000000\b"):
        unpack_arrays(data)
