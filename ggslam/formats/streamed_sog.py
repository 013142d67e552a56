# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as streamed SOG, version 1: a viewer loads near places in fine and far ones in coarse levels.

`lod-meta.json` holds a binary tree of boxes. Each leaf has its Gaussians at every level of detail as a run of rows of a
SOG, `LEVEL_NUMBER/meta.json` and the images beside it (sog.py). Level 0 is the map itself, each coarser one has a
quarter of the Gaussians (splat_levels.py). Numbers are those of the PLY, as in SOG.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.morton import morton_order
from ggslam.formats.point_sampling import MapPart
from ggslam.formats.sog import META, sog_files, write_sog_folder
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_levels import coarser
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.atomic import make_empty_folder, write_text
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

INDEX = "lod-meta.json"


class StreamedSogTuning(Tuning):
    """How a map is cut into levels and chunks."""

    level_ratio = 4
    """Gaussians of a level that one of the next level stands for."""
    coarsest = 4096
    """Gaussians of the coarsest level: levels are added until one has so few."""
    max_levels = 8
    """Most levels."""
    leaf = 1 << 15
    """Most Gaussians of a leaf."""
    leaf_extent_m = 4.0
    """Longest side of a leaf, in metres."""
    leaf_min = 1 << 11
    """Gaussians up to which a leaf may be longer."""
    chunk = 1 << 18
    """Gaussians of a SOG folder, about."""


@dataclass(frozen=True)
class StreamedSize:
    """Gaussians of each level, SOG files and bytes that were written."""

    counts: tuple[int, ...]
    chunks: int
    bytes: int


def write_streamed_sog(
    folder: str | Path, parts: Sequence[MapPart], count: int, objects: Mapping[int, str] | None = None,
    done: Callable[[int], None] = lambda parts: None,
) -> StreamedSize:  # fmt: skip
    """Writes a map that comes in parts, of which one is in memory at a time; the index comes last.

    Args:
        folder: to write into.
        parts: boxes with their Gaussians.
        count: Gaussians of all parts together, about.
        objects: names by object id; None: no object ids are written.
        done: told how many parts are written.

    Raises:
        FormatError: there is no Gaussian, a number is not finite, an object id is too large, or parts have spherical
            harmonics of different degrees.
        RunFolderError: a file cannot be written.
    """
    folder = Path(folder)
    levels = 1 + min(
        StreamedSogTuning.max_levels - 1,
        max(0, math.ceil(math.log(max(count, 1) / StreamedSogTuning.coarsest, StreamedSogTuning.level_ratio))),
    )
    writer = _Writer(folder, levels, objects, done)
    tree = writer.tree_of_parts(list(parts))
    if tree is None:
        raise FormatError(f"{folder}: streamed SOG holds at least one Gaussian, found none")
    writer.finish()
    counts = [level.count for level in writer.levels]
    index: dict[str, Any] = {
        "version": 1, "asset": {"generator": "ggslam"}, "count": sum(counts), "counts": counts, "lodLevels": levels,
        "lodErrors": False, "filenames": writer.filenames, "tree": tree,
    }  # fmt: skip
    if objects is not None:
        index["objects"] = {str(number): name for number, name in objects.items()}
    text = json.dumps(index, separators=(",", ":"), allow_nan=False)
    write_text(folder / INDEX, text)
    return StreamedSize(tuple(counts), len(writer.filenames), writer.bytes + len(text))


@dataclass
class _Level:
    """The state of a level: rows of the current SOG, its number in `filenames`, and the files before it."""

    file: int = -1
    chunks: int = 0
    count: int = 0
    gathered: list[SplatColumns] = field(default_factory=list)
    rows: int = 0


class _Writer:
    """Splits parts into leaves and gathers their levels in SOGs."""

    def __init__(
        self, folder: Path, levels: int, objects: Mapping[int, str] | None, done: Callable[[int], None]
    ) -> None:
        self.levels = [_Level() for _ in range(levels)]
        self.filenames: list[str] = []
        self.bytes = 0
        self._folder = folder
        self._objects: dict[int, str] | None = None if objects is None else {}
        self._done = done
        self._parts = 0
        self._coefficients = 0
        """Of spherical harmonics of a Gaussian, once known."""

    def tree_of_parts(self, parts: list[MapPart]) -> dict[str, Any] | None:
        """Writes parts; returns their tree, None if there is no Gaussian in them."""
        if len(parts) > 1:
            centres = np.array([(np.asarray(part.low) + np.asarray(part.high)) / 2 for part in parts])
            children = [self.tree_of_parts([parts[i] for i in half]) for half in _halves(centres)]
            there = [child for child in children if child is not None]
            return _above(there) if there else None
        tree = None
        for part in parts:
            columns = SplatColumns.of(self._folder, part.load())
            tree = self._tree(self._of_one_degree(columns)) if len(columns) else None
            self._parts += 1
            self._done(self._parts)
        return tree

    def _of_one_degree(self, columns: SplatColumns) -> SplatColumns:
        """The same; raises FormatError where a part before had spherical harmonics of another degree."""
        found = columns.sh.shape[1]
        if found != (self._coefficients or found):
            raise FormatError(
                f"{self._folder}: streamed SOG holds spherical harmonics of one degree, parts of the map have "
                f"{math.isqrt(self._coefficients) - 1} and {math.isqrt(found) - 1}"
            )
        self._coefficients = found
        return columns

    def _tree(self, columns: SplatColumns) -> dict[str, Any]:
        extent = float(np.ptp(columns.means, axis=0).max())
        if len(columns) > StreamedSogTuning.leaf or (
            extent > StreamedSogTuning.leaf_extent_m and len(columns) > StreamedSogTuning.leaf_min
        ):
            return _above([self._tree(columns.take(half)) for half in _halves(columns.means)])
        lods, bounds, whole = {}, [], len(columns)
        for number in range(len(self.levels)):
            columns = coarser(columns, math.ceil(whole / StreamedSogTuning.level_ratio**number))
            lods[str(number)] = self._put(number, columns)
            bounds.append(_box_of(columns))
        return {"bound": _union(bounds), "lods": lods}

    def _put(self, number: int, columns: SplatColumns) -> dict[str, int]:
        """Adds a leaf's Gaussians of a level; returns where they are."""
        level = self.levels[number]
        if level.file < 0:
            level.file = len(self.filenames)
            self.filenames.append(f"{number}_{level.chunks}/{META}")
        place = {"file": level.file, "offset": level.rows, "count": len(columns)}
        level.gathered.append(columns.take(morton_order(columns.means)))
        level.rows += len(columns)
        if level.rows >= StreamedSogTuning.chunk:
            self._write(level)
        return place

    def _write(self, level: _Level) -> None:
        target = self._folder / self.filenames[level.file]
        files = sog_files(target, SplatColumns.join(level.gathered), self._objects)
        write_sog_folder(target.parent, files)
        self.bytes += sum(map(len, files.values()))
        level.count += level.rows
        level.chunks += 1
        level.file, level.rows, level.gathered = -1, 0, []

    def finish(self) -> None:
        """Writes what was gathered."""
        for level in self.levels:
            if level.rows:
                self._write(level)


def _halves(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points [N, 3], int64, on both sides of the median along the axis on which they lie farthest apart."""
    axis, middle = int(np.ptp(points, axis=0).argmax()), len(points) // 2
    order = np.argsort(points[:, axis], kind="stable")
    return np.sort(order[:middle]), np.sort(order[middle:])


def _above(children: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The node above two others; one alone itself."""
    if len(children) == 1:
        return children[0]
    return {"bound": _union([child["bound"] for child in children]), "children": list(children)}


def _box_of(columns: SplatColumns) -> dict[str, list[float]]:
    """Box around ellipsoids of one standard deviation, as far as their turned boxes reach."""
    R = quaternion_to_matrix(columns.quaternions.astype(np.float64))
    reach = (np.abs(R) @ np.exp(columns.log_scales.astype(np.float64))[:, :, None])[:, :, 0]
    low, high = (columns.means - reach).min(0), (columns.means + reach).max(0)
    return {"min": _outwards(low, -1), "max": _outwards(high, 1)}


def _outwards(corner: np.ndarray, sign: int) -> list[float]:
    """Seven digits of a corner, none of which brings it nearer."""
    exact = np.asarray(corner, np.float64)
    return [float(f"{value + sign * 1e-6 * abs(value):.7g}") for value in exact.tolist()]


def _union(bounds: Sequence[dict[str, list[float]]]) -> dict[str, list[float]]:
    return {
        "min": np.min([bound["min"] for bound in bounds], 0).tolist(),
        "max": np.max([bound["max"] for bound in bounds], 0).tolist(),
    }


def _write(path: Path, splats: Splats) -> str:
    folder, cells = path.parent if path.name == INDEX else path, splats.cells()
    make_empty_folder(folder)
    splats.done(0, len(cells))
    size = write_streamed_sog(
        folder, cells, splats.count, splats.names, lambda done: splats.done(done, len(cells))
    )  # fmt: skip
    levels = " + ".join(map(str, size.counts))
    return f"wrote {folder / INDEX}: {levels} Gaussians in {quantity(size.chunks, 'SOG')}, {size.bytes / 1e6:.1f} MB"


WRITER = Writer(
    "streamed-sog", (INDEX,), Takes.GAUSSIANS, "the same in pieces and levels of detail, for the web", _write,
    any_name=True, by_object=True, in_cells=True,
)  # fmt: skip
