# SPDX-License-Identifier: Apache-2.0
"""A TSDF as one file: NumPy's .npz with the settings, the dense blocks' voxels, and the free blocks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import ConfigError, FormatError
from ggslam.native.loader import NativeContext
from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays
from ggslam.system.atomic import write_bytes
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import VOXELS, TsdfMap

_VERSION: Final = 2
"""Version of the file."""
_ORIGIN = "origin"
"""Where in the world blocks are counted from, float64 [3]; there if it is not zero."""
_CONTENT = "a TSDF"
VOXEL_ARRAYS = {
    "value": (np.int16, ()), "weight": (np.uint16, ()), "color": (np.uint8, (3,)), "label": (np.uint16, ()),
    "votes": (np.uint8, ()), "hits": (np.uint8, ()), "octants": (np.uint8, ()),
}  # fmt: skip
_SINCE_2 = ("hits", "octants")
"""Arrays that files of version 1 lack: no points are known."""


def save_tsdf(path: str | Path, tsdf: TsdfMap) -> None:
    """Writes a map.

    Raises:
        RunFolderError: the file cannot be written.
    """
    write_bytes(path, tsdf_to_bytes(tsdf))


def tsdf_to_bytes(tsdf: TsdfMap) -> bytes:
    """Content of the file."""
    blocks = tsdf.blocks()
    # Order in the map depends on its history; in the file it does not.
    order = np.lexsort(blocks.coordinates.T)
    coordinates, dense = blocks.coordinates[order], blocks.dense[order]
    voxels = vars(tsdf.read(coordinates[dense]))
    arrays = tsdf_arrays(tsdf, coordinates[dense], coordinates[~dense], blocks.free_weight[order][~dense], voxels)
    return arrays_to_bytes(**arrays)


def tsdf_arrays(
    like: TsdfMap, dense: np.ndarray, free: np.ndarray, free_weight: np.ndarray, voxels: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The arrays of the file.

    Args:
        like: a map of these settings and origin.
        dense, free: coordinates [n, 3], [m, 3] of the blocks, sorted.
        free_weight: [m].
        voxels: of the dense blocks.
    """
    numbers = like.settings.numbers()
    place = {_ORIGIN: like.origin} if like.origin.any() else {}
    return {
        "version": np.array(_VERSION),
        "setting_names": np.array(list(numbers)),
        "setting_values": np.array(list(numbers.values()), float),
        "dense": dense,
        "free": free,
        "free_weight": free_weight,
        **{name: voxels[name] for name in VOXEL_ARRAYS},
        **place,
    }


def load_tsdf(path: str | Path, frozen: bool = True, context: NativeContext | None = None) -> TsdfMap:
    """Reads a map.

    Args:
        path: of a file by `save_tsdf`.
        frozen: decay leaves its blocks alone.
        context: threads to work on.

    Raises:
        FormatError: the file is missing or damaged.
    """
    tsdf = tsdf_of_arrays(read_all_arrays(path, _CONTENT), path, context)
    tsdf.freeze(frozen)
    return tsdf


def tsdf_of_arrays(arrays: dict[str, np.ndarray], path: str | Path, context: NativeContext | None = None) -> TsdfMap:
    """The map of a file's arrays; `path` is for messages. Raises FormatError if they are none."""
    settings = _settings(path, arrays)
    dense = _check(path, arrays, "dense", np.int32, (-1, 3))
    free = _check(path, arrays, "free", np.int32, (-1, 3))
    if int(arrays["version"]) == 1:
        arrays = {**arrays, **{name: np.zeros((len(dense), VOXELS), np.uint8) for name in _SINCE_2}}
    voxels = {
        name: _check(path, arrays, name, dtype, (len(dense), VOXELS, *tail))
        for name, (dtype, tail) in VOXEL_ARRAYS.items()
    }
    free_weight = _check(path, arrays, "free_weight", np.uint16, (len(free),))
    everything = np.concatenate([dense, free])
    if len(np.unique(everything, axis=0)) != len(everything):
        raise FormatError(f"{path}: not {_CONTENT} written by ggslam: a block is there twice")
    origin = _check(path, arrays, _ORIGIN, np.float64, (3,)) if _ORIGIN in arrays else np.zeros(3)
    if not np.isfinite(origin).all():
        raise FormatError(f"{path}: {_ORIGIN}: expected finite numbers, found {origin.tolist()}")
    tsdf = TsdfMap(settings, context, origin)
    tsdf.write(dense, **voxels)
    tsdf.write_free(free, free_weight)
    return tsdf


def blocks_within(arrays: dict[str, np.ndarray], low: np.ndarray, high: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of a file without the blocks that lie outside of coordinates low to high [3]."""
    inside = {name: ((arrays[name] >= low) & (arrays[name] <= high)).all(1) for name in ("dense", "free")}
    chosen = {name: arrays[name][inside["dense"]] for name in ("dense", *VOXEL_ARRAYS)}
    chosen |= {name: arrays[name][inside["free"]] for name in ("free", "free_weight")}
    return {**arrays, **chosen}


def join_blocks(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of several files, which have no block in common, as of one."""
    names = ("dense", *VOXEL_ARRAYS, "free", "free_weight")
    return {**parts[0], **{name: np.concatenate([part[name] for part in parts]) for name in names}}


def _settings(path: str | Path, arrays: dict[str, np.ndarray]) -> TsdfSettings:
    try:
        if int(arrays["version"]) not in (1, _VERSION):
            raise FormatError(f"{path}: TSDF of version {int(arrays['version'])}, expected {_VERSION}")
        values = dict(zip(arrays["setting_names"].tolist(), arrays["setting_values"].tolist(), strict=True))
        known = {field.name for field in dataclasses.fields(TsdfSettings)}
        if not known.issuperset(values) or not all(type(v) is float and math.isfinite(v) for v in values.values()):
            raise ValueError("its settings are no finite numbers of a TSDF")
        return TsdfSettings.of_numbers(values)
    except (KeyError, TypeError, ValueError, OverflowError, ConfigError) as error:
        raise FormatError(f"{path}: not {_CONTENT} written by ggslam: {error}") from None


def _check(
    path: str | Path, arrays: dict[str, np.ndarray], name: str, dtype: type, shape: tuple[int, ...]
) -> np.ndarray:
    array = arrays.get(name)
    if array is None:
        raise FormatError(f"{path}: not {_CONTENT} written by ggslam: it has no '{name}'")
    fits = array.ndim == len(shape) and all(e in (-1, n) for e, n in zip(shape, array.shape, strict=True))
    if array.dtype != dtype or not fits:
        expected = f"{np.dtype(dtype).name} {['n' if e < 0 else e for e in shape]}"
        raise FormatError(f"{path}: {name}: expected {expected}, found {array.dtype} {list(array.shape)}")
    return array
