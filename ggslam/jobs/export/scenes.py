# SPDX-License-Identifier: Apache-2.0
"""A run's Gaussians in formats that keep the ids and names of objects: glTF, SOG, OpenUSD."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ggslam.errors import FormatError
from ggslam.formats.gaussian_gltf import write_gaussian_gltf
from ggslam.formats.gaussian_usd import USD_ENDINGS, usd_package, write_gaussian_usd
from ggslam.formats.sog import META, write_sog
from ggslam.jobs.export.chosen import ChosenGaussians, Prepare
from ggslam.runs.folder import RunFolder
from ggslam.system.atomic import make_folder

SCENE_ENDINGS = {"gltf": (".glb",), "sog": (".sog",), "usd": USD_ENDINGS}
"""How files of each kind are named, so that other programs know them."""


def export_scene(
    folder: RunFolder, path: Path, kind: str, objects: str | None = None, min_opacity: float = 0.0,
    plain: bool = False, prepare: Prepare | None = None,
) -> str:  # fmt: skip
    """Writes the Gaussians of a run; returns a line that says so.

    Args:
        folder: of the run.
        path: file to write, with an ending of the kind; of "sog" also `FOLDER/meta.json`.
        kind: "gltf" (binary, with KHR_gaussian_splatting), "sog" or "usd".
        objects: only these, names or ids, "mug,7", or "all"; None: the whole map.
        min_opacity: leave out fainter Gaussians.
        plain: leave out object ids and names, which are written of runs with objects.
        prepare: changes the Gaussians first.

    Raises:
        ConfigError: an object is not there.
        FormatError: another ending, or what the format cannot hold.
        MissingDependency: the package that writes the format is not installed.
        RunFolderError: nothing to write, or the file cannot be written.
    """
    check_ending(path, kind)
    if kind == "usd":
        usd_package(path)
    table = folder.object_table() if objects is not None or folder.has_objects() else None
    ids = None if table is None or objects is None else table.select(objects)
    chosen = ChosenGaussians.of(folder, folder.map_in_parts().rows, min_opacity, ids, prepare)
    names = None if table is None or plain else {i: table.record(i).name or "" for i in ids or table.ids()}
    make_folder(path.parent)
    size = _write(path, kind, chosen, names)
    found = "" if names is None else f" with the ids of {len(names)} object{'s' * (len(names) != 1)}"
    return f"wrote {path}: {chosen.count} Gaussians{found}, {size / 1e6:.1f} MB"


def check_ending(path: Path, kind: str) -> None:
    """Raises FormatError unless the name of a file ends as files of a kind do."""
    endings = SCENE_ENDINGS[kind]
    if path.suffix.lower() not in endings and not (kind == "sog" and path.name == META):
        other = f", or is called {META}" if kind == "sog" else ""
        raise FormatError(f"{path}: a file of the format {kind} ends in {', '.join(endings)}{other}")


def _write(path: Path, kind: str, chosen: ChosenGaussians, names: Mapping[int, str] | None) -> int:
    """Writes the file or files; returns their bytes."""
    if kind == "gltf":
        write_gaussian_gltf(path, chosen.count, chosen.parts(), chosen.rows.like.sh_degree, names)
        return path.stat().st_size
    if kind == "sog":
        return write_sog(path, chosen.whole(), names)
    write_gaussian_usd(path, chosen.whole(), names)
    return path.stat().st_size
