# SPDX-License-Identifier: Apache-2.0
"""Writes files of a run in parts, a map on disk cell by cell, so that memory stays as bounded as during the run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ggslam.formats.gaussian_ply import write_gaussian_parts
from ggslam.formats.point_ply import write_points_in_parts
from ggslam.objects.segmented_map import ObjectVotes
from ggslam.objects.table import ObjectTable
from ggslam.runs.map_index import MAP_INDEX, write_map_index
from ggslam.runs.map_points import map_points
from ggslam.slam.result import SlamResult
from ggslam.system.atomic import write_bytes


def save_map_in_parts(folder: Path, result: SlamResult, names: Mapping[int, str] | None = None) -> None:
    """Writes map.ply and map_cells.json, and of a run with objects their files (see `RunFolder.save_objects`).

    Of the objects, votes (24 bytes a Gaussian) and what boxes are made of (16 bytes) are in memory as a whole.
    """
    assert result.cells is not None
    extra = () if result.objects is None else ("object_id", "identity")
    write_gaussian_parts(folder / "map.ply", result.gaussian_count, result.parts(), result.gaussians, extra)
    write_map_index(folder / MAP_INDEX, result.cells)
    if result.objects is None:
        return
    found = result.objects
    votes = [ObjectVotes.of(part) for part in result.parts()]
    together = ObjectVotes(np.concatenate([v.ids for v in votes]), np.concatenate([v.weights for v in votes]))
    write_bytes(folder / "votes.npz", together.to_bytes())
    del votes, together
    write_bytes(folder / "classifier.npz", found.classifier.to_bytes())
    known = names if found.supervision == "masks" else None
    table = ObjectTable.of_parts(result.parts(), found.classifier, found.supervision, known, found.observations)
    table.save(folder / "objects.json")


def save_points(folder: Path) -> None:
    """Writes points.ply and points_grid.ply of the map in a folder, beside it; a part at a time."""
    write_points_in_parts(folder, map_points(folder))
