# SPDX-License-Identifier: Apache-2.0
"""Mesh and file of a TSDF whose cells are all on disk, made of a few cells at a time."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ggslam.system.atomic import atomic_write
from ggslam.system.tuning import Tuning
from ggslam.volumes.block_arrays import put_blocks
from ggslam.volumes.cell_pager import CellPager
from ggslam.volumes.mesh import Mesh, extract_mesh, join_meshes, without_small_pieces
from ggslam.volumes.tsdf import SIDE, VOXELS, TsdfMap
from ggslam.volumes.tsdf_file import VOXEL_ARRAYS, tsdf_arrays
from ggslam.volumes.volume_cells import CellKey, as_keys, with_neighbours


class CellExportTuning(Tuning):
    """How much is in memory at a time."""

    side = 4
    """Cells along an edge of the box that is meshed at a time; those around it are in memory, too."""


def mesh_of_cells(pager: CellPager, min_weight: float | None, min_triangles: int) -> Mesh:
    """The surface of all cells: the triangles that `extract_mesh` makes of everything at once, in another order."""
    parts = [
        _triangles_of(_in_memory(pager, with_neighbours(own, 1) & pager.keys()), own, pager, min_weight)
        for own in _boxes(pager)
    ]
    mesh = join_meshes(parts)
    return without_small_pieces(mesh, min_triangles) if min_triangles > 1 else mesh


def _boxes(pager: CellPager) -> Iterator[set[CellKey]]:
    """All cells, in boxes."""
    keys = np.array(sorted(pager.keys())).reshape(-1, 3)
    _, box_of = np.unique(np.floor_divide(keys, CellExportTuning.side), axis=0, return_inverse=True)
    for number in range(box_of.max(initial=-1) + 1):
        yield as_keys(keys[box_of.ravel() == number])


def _in_memory(pager: CellPager, keys: set[CellKey]) -> TsdfMap:
    like = pager.tsdf
    part = TsdfMap(like.settings, like.context, like.origin, like.points)
    for key in sorted(keys):
        put_blocks(part, pager.arrays(key))
    return part


def _triangles_of(part: TsdfMap, own: set[CellKey], pager: CellPager, min_weight: float | None) -> Mesh:
    """Those of cells `own`: a cube of marching cubes belongs to the block of its lowest corner."""
    mesh, voxel = extract_mesh(part, min_weight), part.settings.voxel
    middles = mesh.vertices[mesh.triangles].astype(np.float64).mean(1) - part.origin
    blocks = np.floor(np.floor(middles / voxel - 0.5) / SIDE).astype(np.int64)
    keys = map(tuple, pager.cells.keys_of(blocks).tolist())
    return mesh.part(np.fromiter((key in own for key in keys), bool, len(blocks)))


def save_cells(path: str | Path, pager: CellPager) -> None:
    """Writes the file that `save_tsdf` writes of everything at once, byte for byte.

    Raises:
        RunFolderError: the file cannot be written.
    """
    keys = sorted(pager.keys())
    held = [{name: pager.arrays(key)[name] for name in ("dense", "free", "free_weight")} for key in keys]
    dense, free = (np.concatenate([np.zeros((0, 3), np.int32), *(part[n] for part in held)]) for n in ("dense", "free"))
    free_weight = np.concatenate([np.zeros(0, np.uint16), *(part["free_weight"] for part in held)])
    order, free_order = np.lexsort(dense.T), np.lexsort(free.T)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    with atomic_write(path) as temporary, tempfile.TemporaryDirectory(dir=Path(temporary).parent) as folder:
        voxels = {
            name: np.lib.format.open_memmap(Path(folder) / f"{name}.npy", "w+", dtype, (len(dense), VOXELS, *tail))
            for name, (dtype, tail) in VOXEL_ARRAYS.items()
        }
        begin = 0
        for key in keys:
            arrays = pager.arrays(key)
            rows = place[begin : begin + len(arrays["dense"])]
            begin += len(rows)
            for name, values in voxels.items():
                values[rows] = arrays.get(name, 0)
        arrays = tsdf_arrays(pager.tsdf, dense[order], free[free_order], free_weight[free_order], voxels)
        with Path(temporary).open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
