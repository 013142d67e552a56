# SPDX-License-Identifier: Apache-2.0
"""Which format an export has: the one that was asked for, or the one that the file's name says."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from ggslam.errors import ConfigError


class ExportFormat(str, Enum):
    """What to write."""

    ply = "ply"
    segmented = "segmented"
    points = "points"
    trajectory = "trajectory"
    compressed_ply = "compressed-ply"
    spz = "spz"
    spz4 = "spz4"
    splat = "splat"
    sog = "sog"
    streamed_sog = "streamed-sog"
    gltf = "gltf"
    usd = "usd"
    pcd = "pcd"
    mesh = "mesh"
    colmap = "colmap"
    nerfstudio = "nerfstudio"


class UpAxis(str, Enum):
    """The axis of a file that points up."""

    y = "y"
    minus_y = "-y"
    z = "z"


SUFFIXES = {
    ".ply": (ExportFormat.ply, ExportFormat.segmented, ExportFormat.compressed_ply, ExportFormat.mesh),
    ".glb": (ExportFormat.mesh, ExportFormat.gltf),
    ".obj": (ExportFormat.mesh,),
    ".spz": (ExportFormat.spz, ExportFormat.spz4),
    ".splat": (ExportFormat.splat,),
    ".sog": (ExportFormat.sog,),
    ".usd": (ExportFormat.usd,),
    ".usda": (ExportFormat.usd,),
    ".usdc": (ExportFormat.usd,),
    ".usdz": (ExportFormat.usd,),
    ".pcd": (ExportFormat.pcd,),
    ".txt": (ExportFormat.trajectory,),
}
"""Formats that a file with this suffix may hold; the first is meant where none is asked for."""
NAMES = {
    ".compressed.ply": ExportFormat.compressed_ply, "meta.json": ExportFormat.sog,
    "lod-meta.json": ExportFormat.streamed_sog,
}  # fmt: skip
"""Formats of files whose whole name, or more than a suffix of it, says which."""


def choose_format(asked: ExportFormat | None, out: Path, objects: str | None) -> ExportFormat:
    """The format to write.

    Args:
        asked: the format, if it was given.
        out: file or folder to write.
        objects: which objects; with them alone, a folder of one PLY for each is meant.

    Raises:
        ConfigError: the name says no format, or says another one than `asked`.
    """
    name = out.name.lower()
    whole = tuple(kind for end, kind in NAMES.items() if name == end or (end[0] == "." and name.endswith(end)))
    named = whole or SUFFIXES.get(out.suffix.lower(), ())
    if asked is not None:
        if named and asked not in named:
            raise ConfigError(f"`out` {out}: the name says {named[0].value}, but `format` says {asked.value}")
        return asked
    if named:
        return named[0]
    if objects is not None:
        return ExportFormat.ply
    raise ConfigError(
        f"`out` {out}: the name does not say which format to write; end it with one of {', '.join(SUFFIXES)}, or give "
        f"`format` ({', '.join(kind.value for kind in ExportFormat)})"
    )
