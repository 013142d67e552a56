# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as SPZ (Niantic), version 3 (gzip) or 4 (zstd), by the packages gaussforge and zstandard.

Positions in steps of 1/4096 m, everything else in bytes. The specification puts y upwards and z backwards, so the map
(y down, z forward at the first camera) is turned by 180 degrees about x on the way. There are neither object ids nor
identities.
"""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Final

import numpy as np

from ggslam.errors import FormatError, RunFolderError
from ggslam.formats.optional_package import package_for
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.atomic import write_bytes

SPZ_REACH: Final = 2048.0
"""Metres that SPZ's positions reach: 24 bits, 12 of them behind the point."""


def spz_packages(path: str | Path, version: int = 3) -> tuple[ModuleType, ModuleType | None]:
    """The packages gaussforge and, for version 4, zstandard.

    Raises:
        MissingDependency: one is not installed; says how to get it.
    """
    zstandard = package_for(path, "zstandard", "splats", otherwise="write version 3") if version == 4 else None
    return package_for(path, "gaussforge", "splats"), zstandard


def write_spz(path: str | Path, gaussians: GaussianMap, version: int = 3) -> None:
    """Writes an SPZ file, whole or not at all.

    Args:
        path: the file to write; ends in .spz.
        gaussians: at least one, within `SPZ_REACH` of the origin.
        version: 3 or 4.

    Raises:
        MissingDependency: gaussforge or, for version 4, zstandard is not installed.
        FormatError: a Gaussian is too far away for the format, or a number is not finite.
        RunFolderError: the file cannot be written.
    """
    gaussforge, zstandard = spz_packages(path, version)
    farthest = float(gaussians.means.abs().max())
    if not farthest < SPZ_REACH:
        raise FormatError(f"{path}: SPZ holds positions up to {SPZ_REACH:g} m, found {farthest:g} m; write a PLY")
    columns = SplatColumns.of(path, gaussians)
    columns.turn_upright()
    payload = _fine_harmonics(gzip.decompress(_pack(gaussforge, path, columns, gaussians.sh_degree)), columns.sh)
    data = gzip.compress(payload, 6, mtime=0) if zstandard is None else _version_4(zstandard, payload)
    write_bytes(path, data)


def _fine_harmonics(payload: bytes, sh: np.ndarray) -> bytes:
    """The same with higher spherical harmonics, which come last, in whole bytes, -1 to 1 in steps of 1/128. The package
    keeps 5 bits of them at degree 1 and 4 above, where those of trained maps are mostly zero."""
    higher = np.rint(128 + 128 * sh[:, 1:].clip(-1, 1)).clip(0, 255).astype(np.uint8)
    return payload[: len(payload) - higher.size] + higher.tobytes()


def _version_4(zstandard: ModuleType, payload: bytes) -> bytes:
    """Version 4 of what version 3 holds: each attribute is a zstd frame of its own behind a table of their sizes."""
    count, degree, fraction, flags = struct.unpack_from("<8xIBBB", payload)
    widths = [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)]  # bytes a Gaussian: positions, opacities, colours, ...
    frames, table, start = [], b"", 16
    for width in filter(None, widths):
        frames.append(zstandard.ZstdCompressor(level=12).compress(payload[start : start + width * count]))
        table += struct.pack("<QQ", len(frames[-1]), width * count)
        start += width * count
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, fraction, flags, len(frames), 32)
    return b"".join([header, table, *frames])


def _pack(gaussforge: ModuleType, path: str | Path, columns: SplatColumns, degree: int) -> bytes:
    named = {
        "positions": columns.means, "scales": columns.log_scales, "alphas": columns.logits,
        "rotations": columns.quaternions, "colors": columns.sh[:, 0], "sh": columns.sh[:, 1:],
    }  # fmt: skip
    values = {name: np.ascontiguousarray(column).tobytes() for name, column in named.items()}
    known = {"numPoints": len(columns.means), "meta": {"shDegree": degree, "sourceFormat": "ply"}, "extras": {}}
    answer = gaussforge.GaussForge().write({**known, **values}, "spz")
    if "error" in answer:
        raise RunFolderError(f"cannot write {path}: gaussforge: {answer['error']}")
    return bytes(answer["data"])


def _write(path: Path, splats: Splats, version: int = 3) -> str:
    write_spz(path, splats.whole(), version)
    return splats.text(path)


WRITER = Writer(
    "spz", (".spz",), Takes.GAUSSIANS, "the same in fewer bytes, SPZ version 3", _write, y_up=True,
    check=spz_packages,
)  # fmt: skip
VERSION_4 = replace(
    WRITER, name="spz4", text="the same as SPZ version 4", write=partial(_write, version=4),
    check=partial(spz_packages, version=4),
)  # fmt: skip
