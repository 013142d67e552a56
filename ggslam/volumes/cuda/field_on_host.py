# SPDX-License-Identifier: Apache-2.0
"""A distance field of a device as arrays of the host, and as one of the compiled core."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import FieldParts
from ggslam.abi.cuda import FieldDistances, FieldRow, FieldSites, FusedBlock, FusedCount
from ggslam.cuda.transfers import download
from ggslam.native.loader import load_library
from ggslam.volumes.cuda.field_memory import FieldMemory
from ggslam.volumes.cuda.fused_state import FusedState
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.tsdf import VOXELS

NOBODY = np.uint32(0xFFFFFFFF)
"""Owner of voxels that are too far from all sites."""


def voxel_of_number(number: np.ndarray) -> np.ndarray:
    """Rows i + 8 j + 64 k of the voxels of sites' numbers, see `FieldSites` in abi/cuda/volumes.hpp."""
    part = number >> 6
    x = (number & 3) + 4 * (part & 1)
    y = (number >> 2 & 3) + 4 * (part >> 1 & 1)
    z = (number >> 4 & 3) + 4 * (part >> 2)
    return x + 8 * y + 64 * z


@dataclass(frozen=True)
class HeldField:
    """Blocks with distances: coordinates int32 [B, 3], `FieldRow`s [B], `FieldDistances` [B], and all `FieldSites`."""

    at: np.ndarray
    rows: np.ndarray
    distances: np.ndarray
    sites: np.ndarray

    def site_numbers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of all sites [S]: blocks, slots and numbers, in the order of blocks and voxels."""
        with_sites = np.nonzero(self.rows["site_slot"] > 0)[0]
        slots = self.rows["site_slot"][with_sites] - 1
        held = self.sites["held"][slots].view(np.uint8).reshape(len(slots), VOXELS // 8)
        which, number = np.nonzero(np.unpackbits(held, axis=1, bitorder="little"))
        order = np.lexsort((voxel_of_number(number), which))
        which, number = which[order], number[order]
        return with_sites[which], slots[which], number


def held_field(state: FusedState, memory: FieldMemory) -> HeldField:
    """Fetches a field; waits for what is under way.

    Args:
        state: of the map.
        memory: of the field.
    """
    counts = state.settle()
    rows, slots = int(counts[FusedCount.ROWS_USED]), int(counts[FusedCount.SITE_SLOTS_USED])
    found = download(
        state.memory.read("blocks", rows), memory.read("rows", rows), memory.read("distances", rows),
        memory.read("sites", slots),
    )  # fmt: skip
    kinds = (FusedBlock, FieldRow, FieldDistances, FieldSites)
    blocks, states, distances, sites = (
        array.reshape(-1).view(np.dtype(kind)) for array, kind in zip(found, kinds, strict=True)
    )  # fmt: skip
    there = (blocks["present"] != 0) & (states["computed"] != 0)
    return HeldField(np.ascontiguousarray(blocks["at"][there]), states[there], distances[there], sites)


def put_field(held: HeldField, field: DistanceField) -> None:
    """Gives a field of the compiled core the distances and sites of one of a device.

    Args:
        held: the field of the device.
        field: of the same map.
    """
    blocks, slots, numbers = held.site_numbers()
    block_of_slot = np.zeros(len(held.sites) + 1, np.uint32)
    there = held.rows["site_slot"] > 0
    block_of_slot[held.rows["site_slot"][there] - 1] = np.nonzero(there)[0]
    owner = held.distances["owner"]
    of_slot, number = owner // VOXELS, owner % VOXELS
    known = owner != NOBODY
    places = block_of_slot[np.where(known, of_slot, 0)] * np.uint32(VOXELS) + voxel_of_number(number).astype(np.uint32)
    arrays = {
        "at": held.at, **{n: held.rows[n] for n in ("known", "negative", "crossed")},
        "distance": held.distances["distance"], "gradient": held.distances["gradient"],
        "owner": np.where(known, places, NOBODY).astype(np.uint32), "site_block": blocks.astype(np.int32),
        "site_voxel": voxel_of_number(numbers).astype(np.int32), "site_at": held.sites["at"][slots, :, numbers],
        "site_normal": held.sites["normal"][slots, :, numbers], "site_radius": held.sites["radius"][slots, numbers],
    }  # fmt: skip
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    parts = FieldParts(len(held.at), len(blocks), **{name: address(array) for name, array in arrays.items()})
    load_library().ggslam_esdf_write(field.handle, ctypes.byref(parts))
