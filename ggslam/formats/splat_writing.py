# SPDX-License-Identifier: Apache-2.0
"""The table of the formats that a map of Gaussians is written to as a whole: the file's name says which."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from ggslam.errors import ConfigError
from ggslam.formats.compressed_ply import write_compressed_ply
from ggslam.formats.gaussian_gltf import write_gaussian_gltf
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.gaussian_usd import USD_ENDINGS, write_gaussian_usd
from ggslam.formats.packed_splats import write_spz
from ggslam.formats.sog import META, write_sog
from ggslam.formats.splat_file import write_splat
from ggslam.scene.gaussian_map import GaussianMap

Names = Mapping[int, str] | None
Writer = Callable[[Path, GaussianMap, Names], object]
WRITERS: dict[str, Writer] = {
    ".compressed.ply": lambda path, gaussians, names: write_compressed_ply(path, gaussians),
    ".ply": lambda path, gaussians, names: write_gaussian_ply(path, gaussians, () if names is None else ("object_id",)),
    ".spz": lambda path, gaussians, names: write_spz(path, gaussians),
    ".splat": lambda path, gaussians, names: write_splat(path, [gaussians]),
    ".sog": write_sog,
    META: write_sog,
    ".glb": lambda path, gaussians, names: write_gaussian_gltf(
        path, len(gaussians), [gaussians], gaussians.sh_degree, names
    ),
    **dict.fromkeys(USD_ENDINGS, write_gaussian_usd),
}
"""By the end of the name; the first that fits. Names of objects go where the format has room for them."""


def splat_writer(path: str | Path) -> Writer:
    """Who writes a file of this name; raises ConfigError if no format is called so."""
    name = Path(path).name.lower()
    fits = (writer for end, writer in WRITERS.items() if name == end or (end[0] == "." and name.endswith(end)))
    found = next(fits, None)
    if found is None:
        raise ConfigError(f"{path}: expected a name that ends in one of {', '.join(WRITERS)}")
    return found


def write_splats(path: str | Path, gaussians: GaussianMap, names: Names = None) -> None:
    """Writes a map, whole or not at all.

    Args:
        path: the file; its name says the format.
        gaussians: at least one.
        names: of objects by id, empty where one has none; None: no object ids are written.

    Raises:
        ConfigError: no format is called so.
        FormatError: what the format cannot hold.
        MissingDependency: a package is needed to write it.
        RunFolderError: the file cannot be written.
    """
    splat_writer(path)(Path(path), gaussians, names)
