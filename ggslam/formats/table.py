# SPDX-License-Identifier: Apache-2.0
"""The table of formats that maps are exported to and read from, and the choice of one by a file's name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.formats import (
    colmap,
    compressed_ply,
    compressed_ply_reading,
    gaussian_gltf,
    gaussian_gltf_reading,
    gaussian_ply,
    gaussian_ply_reading,
    gaussian_usd,
    gaussian_usd_reading,
    mesh_files,
    nerfstudio,
    packed_splats,
    point_cloud,
    point_ply,
    sog,
    sog_reading,
    splat_file,
    spz_reading,
    streamed_sog,
    trajectory,
)
from ggslam.formats.splat_reader import SplatReader
from ggslam.formats.writer import Takes, Writer


@dataclass(frozen=True)
class Format:
    """A format: who writes it, and who reads maps of Gaussians from it (None: nobody)."""

    writer: Writer
    reader: SplatReader | None = None


FORMATS: tuple[Format, ...] = (
    Format(gaussian_ply.WRITER, gaussian_ply_reading.READER),
    Format(gaussian_ply.SEGMENTED),
    Format(mesh_files.WRITER),
    Format(compressed_ply.WRITER, compressed_ply_reading.READER),
    Format(sog.WRITER, sog_reading.READER),
    Format(streamed_sog.WRITER, sog_reading.STREAMED),
    Format(packed_splats.WRITER, spz_reading.READER),
    Format(packed_splats.VERSION_4),
    Format(gaussian_gltf.WRITER, gaussian_gltf_reading.READER),
    Format(gaussian_usd.WRITER, gaussian_usd_reading.READER),
    Format(splat_file.WRITER, splat_file.READER),
    Format(point_ply.WRITER),
    Format(point_cloud.WRITER),
    Format(trajectory.WRITER),
    Format(colmap.WRITER),
    Format(nerfstudio.WRITER),
)
"""All formats. Of those that fit a name the first is meant; the first that a file is of reads it."""


def writers() -> list[Writer]:
    """Who writes, in the order of the table."""
    return [known.writer for known in FORMATS]


def readers() -> list[SplatReader]:
    """Who reads maps of Gaussians, in the order of the table."""
    return [known.reader for known in FORMATS if known.reader is not None]


def names_of(chosen: list[Writer]) -> str:
    """Names of formats with commas between them."""
    return ", ".join(writer.name for writer in chosen)


def endings() -> list[str]:
    """Endings that say a format, in the order of the table."""
    return list(dict.fromkeys(ending for writer in writers() for ending in writer.endings))


def choose_writer(asked: str | None, out: Path, objects: str | None = None) -> Writer:
    """Who writes an export.

    Args:
        asked: name of the format, if it was given.
        out: file or folder to write.
        objects: which objects; with them alone, a folder of one PLY for each is meant.

    Raises:
        ConfigError: an unknown format; the name says none, or says another one than `asked`.
    """
    named = writers_for(out)
    if asked is not None:
        writer = next((known for known in writers() if known.name == asked), None)
        if writer is None:
            raise ConfigError(f"`format`: expected one of {names_of(writers())}, found {asked!r}")
        if named and writer not in named:
            raise ConfigError(f"`out` {out}: the name says {named[0].name}, but `format` says {asked}")
        return writer
    if named:
        return named[0]
    if objects is not None:
        return gaussian_ply.WRITER
    raise ConfigError(
        f"`out` {out}: the name does not say which format to write; end it with one of {', '.join(endings())}, or give "
        f"`format` ({names_of(writers())})"
    )


def writers_for(out: Path) -> list[Writer]:
    """Those whose files may have this name: of several endings that fit the longest counts."""
    fits = {writer.name: len(writer.longest_ending(out)) for writer in writers()}
    longest = max(fits.values())
    return [writer for writer in writers() if longest and fits[writer.name] == longest]


def splat_writer(path: str | Path) -> Writer:
    """Who writes Gaussians, as they are, into a file of this name; raises ConfigError if no format is called so."""
    able = [writer for writer in writers() if writer.takes is Takes.GAUSSIANS and not writer.in_cells]
    found = next((writer for writer in writers_for(Path(path)) if writer in able), None)
    if found is None:
        known = dict.fromkeys(ending for writer in able for ending in writer.endings)
        raise ConfigError(f"{path}: expected a name that ends in one of {', '.join(known)}")
    return found
