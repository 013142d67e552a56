# SPDX-License-Identifier: Apache-2.0
"""The file of a TSDF whose cells are all on disk, made of a few cells at a time."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from ggslam.system.atomic import atomic_write
from ggslam.volumes.cell_pager import CellPager
from ggslam.volumes.tsdf import VOXELS
from ggslam.volumes.tsdf_file import VOXEL_ARRAYS, tsdf_arrays


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
