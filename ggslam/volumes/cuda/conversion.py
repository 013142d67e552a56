# SPDX-License-Identifier: Apache-2.0
"""Maps of a device as arrays of the host, and back."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch

from ggslam.abi.cuda import FusedBlock, FusedPoints, FusedVoxels
from ggslam.cuda.transfers import download
from ggslam.native.loader import NativeContext
from ggslam.volumes.cuda.map_memory import MapMemory
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap

_AT_ONCE: Final = 4096
"""Blocks with voxels that are converted at a time, 25 MB."""
_BLOCK, _VOXELS, _POINTS = (np.dtype(kind) for kind in (FusedBlock, FusedVoxels, FusedPoints))


def map_on_host(
    memory: MapMemory, rows: int, slots: int, settings: TsdfSettings, origin: np.ndarray | None,
    context: NativeContext | None,
) -> TsdfMap:  # fmt: skip
    """The same map in the compiled core.

    Args:
        memory: of the map on its device; nothing is under way there.
        rows, slots: that are used.
        settings, origin: of the map.
        context: threads of the new map.
    """
    tsdf = TsdfMap(settings, context, origin, memory.points)
    blocks = download(memory.read("blocks", rows))[0].reshape(-1).view(_BLOCK)
    blocks = blocks[blocks["present"] != 0]
    free, dense = blocks[blocks["slot"] < 0], blocks[blocks["slot"] >= 0]
    dense = dense[np.argsort(dense["slot"])]
    for first in range(0, slots, _AT_ONCE):
        last = min(first + _AT_ONCE, slots)
        part = dense[(dense["slot"] >= first) & (dense["slot"] < last)]
        if len(part):
            arrays = _arrays(memory, first, last, part["slot"] - first)
            tsdf.write(part["at"], **arrays)
    tsdf.write_free(free["at"], free["free_weight"].astype(np.uint16))
    return tsdf


def _arrays(memory: MapMemory, first: int, last: int, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Voxels of some of the slots from one to below another, as `TsdfMap.write` takes them."""
    names = ("voxels", "points") if memory.points else ("voxels",)
    found = download(*(memory.read(name, last)[first:] for name in names))
    voxels = found[0].reshape(-1).view(_VOXELS)[rows]
    arrays = {name: voxels[name] for name in ("value", "weight", "label", "votes")}
    arrays["color"] = np.stack([voxels["red"], voxels["green"], voxels["blue"]], -1)
    if memory.points:
        points = found[1].reshape(-1).view(_POINTS)[rows]
        arrays |= {name: points[name] for name in ("hits", "octants")}
    return arrays


def blocks_of_host(tsdf: TsdfMap, points: bool, revision: int) -> dict[str, np.ndarray]:
    """Arrays "blocks", "voxels" and, where `points` are counted, "points", as bytes, of a map of the compiled core."""
    listed = tsdf.blocks()
    dense = listed.coordinates[listed.dense]
    blocks = np.zeros(len(listed.coordinates), _BLOCK)
    blocks["at"], blocks["slot"], blocks["update"] = listed.coordinates, -1, -1
    blocks["slot"][listed.dense] = np.arange(len(dense))
    blocks["free_weight"], blocks["present"], blocks["revision"] = listed.free_weight, 1, revision
    found = tsdf.read(dense)
    voxels = np.zeros(len(dense), _VOXELS)
    for name in ("value", "weight", "label", "votes"):
        voxels[name] = getattr(found, name)
    for channel, name in enumerate(("red", "green", "blue")):
        voxels[name] = found.color[..., channel]
    arrays = {"blocks": blocks, "voxels": voxels}
    if points:
        arrays["points"] = np.zeros(len(dense), _POINTS)
        arrays["points"]["hits"], arrays["points"]["octants"] = found.hits, found.octants
    return {name: array.view(np.uint8) if len(array) else np.zeros(0, np.uint8) for name, array in arrays.items()}


def put_bytes(target: torch.Tensor, array: np.ndarray) -> None:
    """Copies bytes to the beginning of device memory of any shape."""
    if array.size:
        target.view(-1)[: array.size].copy_(torch.from_numpy(array.reshape(-1)))
