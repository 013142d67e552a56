# SPDX-License-Identifier: Apache-2.0
"""3DGS PLY files of which some Gaussians are in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.formats.gaussian_ply import gaussians_of_vertices
from ggslam.formats.ply import read_ply
from ggslam.formats.ply_rows import PlyRows
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class GaussianRowsTuning(Tuning):
    """How a file is read from start to end."""

    rows_at_once = 1 << 15
    """Gaussians that are in memory at a time."""


class GaussianRows:
    """The Gaussians of a file, by row.

    Binary files without lists, as ggslam and nearly all others write them, are read as far as they are asked for.
    Others are in memory as a whole.

    Args:
        path: the file.

    Raises:
        FormatError: no PLY file, or no Gaussians in it.
    """

    def __init__(self, path: str | Path) -> None:
        self._open(Path(path))
        self.like = gaussians_of_vertices(path, self._raw(0, 0), with_moments=False)
        """A map without Gaussians that has the channels of those here."""

    def _open(self, path: Path) -> None:
        self.path = path
        self._rows: PlyRows | None = None
        self._vertex: np.ndarray | None = None
        try:
            self._rows = PlyRows(path, "vertex")
        except FormatError:  # or its reason is told now
            self._vertex = read_ply(path).elements.get("vertex")

    def __len__(self) -> int:
        return self._row_count()

    def _row_count(self) -> int:
        """Rows of the file."""
        if self._rows is not None:
            return self._rows.count
        return 0 if self._vertex is None else len(self._vertex)

    def read(self, start: int, count: int) -> GaussianMap:
        """The Gaussians of rows start to start + count, without optimizer state.

        Raises:
            FormatError: the file cannot be read any more, or holds values that are none.
        """
        return gaussians_of_vertices(self.path, self._raw(start, count), with_moments=False, first=start)

    def blocks(self) -> Iterator[GaussianMap]:
        """All Gaussians in their order, `rows_at_once` at a time; errors as of `read`."""
        for number in range(-(-len(self) // GaussianRowsTuning.rows_at_once)):
            yield self.block(number)

    def block(self, number: int) -> GaussianMap:
        """The Gaussians of a block, counted from 0; errors as of `read`."""
        first, most = number * GaussianRowsTuning.rows_at_once, GaussianRowsTuning.rows_at_once
        return self.read(first, min(most, len(self) - first))

    def _raw(self, start: int, count: int) -> np.ndarray | None:
        if self._rows is not None:
            return self._rows.read(start, count)
        return None if self._vertex is None else self._vertex[start : start + count]


class GaussiansInMemory(GaussianRows):
    """A map that is in memory, as if it were a file.

    Args:
        path: of the file that it came from.
        gaussians: the map.
    """

    def __init__(self, path: str | Path, gaussians: GaussianMap) -> None:
        self.path, self._gaussians = Path(path), gaussians
        self.like = GaussianMap(gaussians.sh_degree, gaussians.feature_channels, with_moments=False)

    def __len__(self) -> int:
        return len(self._gaussians)

    def read(self, start: int, count: int) -> GaussianMap:
        """Copies of the Gaussians of rows start to start + count."""
        like = self.like
        out = GaussianMap(like.sh_degree, like.feature_channels, with_moments=False)
        out.growth = 0.0
        out.append(self._gaussians.take(torch.arange(start, start + count)))
        return out
