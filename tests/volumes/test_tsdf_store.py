# SPDX-License-Identifier: Apache-2.0
"""The block store of the TSDF."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, VOXELS, TsdfMap


def random_blocks(n: int, seed: int = 0) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    coordinates = np.unique(rng.integers(-50, 50, (n, 3)).astype(np.int32), axis=0)
    coordinates = rng.permutation(coordinates)
    n = len(coordinates)
    voxels = {
        "value": rng.integers(-32767, 32767, (n, VOXELS)), "weight": rng.integers(0, 65535, (n, VOXELS)),
        "label": rng.integers(0, 65535, (n, VOXELS)), "votes": rng.integers(0, 255, (n, VOXELS)),
        "color": rng.integers(0, 255, (n, VOXELS, 3)),
    }  # fmt: skip
    return coordinates, voxels


def test_blocks_are_found_again() -> None:
    coordinates, voxels = random_blocks(3000)
    tsdf = TsdfMap()
    tsdf.write(coordinates, **voxels)
    assert len(tsdf) == tsdf.dense_blocks == len(coordinates)
    back = tsdf.read(coordinates[::-1])
    for name, array in voxels.items():
        assert np.array_equal(getattr(back, name), array[::-1]), name
    assert (tsdf.read(np.array([[1000, 0, 0]])).weight == 0).all()


def test_erased_blocks_are_gone_and_the_others_stay() -> None:
    coordinates, voxels = random_blocks(5000)
    tsdf = TsdfMap()
    tsdf.write(coordinates, **voxels)
    gone = np.zeros(len(coordinates), bool)
    gone[::3] = True
    tsdf.erase(coordinates[gone])
    assert len(tsdf) == tsdf.dense_blocks == (~gone).sum()
    back = tsdf.read(coordinates)
    assert (back.weight[gone] == 0).all()
    assert np.array_equal(back.value[~gone], voxels["value"][~gone])
    memory = tsdf.memory_bytes
    tsdf.write(coordinates[gone], value=voxels["value"][gone])
    assert tsdf.memory_bytes == memory  # freed voxels are used again
    assert (tsdf.read(coordinates[gone]).label == 0).all()  # and do not remember what they were


def test_free_blocks_hold_no_voxels() -> None:
    tsdf = TsdfMap()
    coordinates, _ = random_blocks(100)
    tsdf.write_free(coordinates, np.full(len(coordinates), 77))
    assert len(tsdf) == len(coordinates) and tsdf.dense_blocks == 0
    voxels = tsdf.read(coordinates)
    assert (voxels.value == FREE_VALUE).all() and (voxels.weight == 77).all()
    tsdf.write(coordinates[:1], label=np.ones((1, VOXELS)))  # gets voxels, which keep value and weight
    voxels = tsdf.read(coordinates[:1])
    assert tsdf.dense_blocks == 1 and (voxels.weight == 77).all() and (voxels.label == 1).all()


def test_revisions_tell_what_changed() -> None:
    tsdf = TsdfMap()
    coordinates, voxels = random_blocks(50)
    tsdf.write(coordinates, **voxels)
    before = tsdf.revision
    tsdf.write(coordinates[:5], value=voxels["value"][:5])
    blocks = tsdf.blocks()
    changed = blocks.coordinates[blocks.revision > before]
    assert {tuple(c) for c in changed} == {tuple(c) for c in coordinates[:5]}
    tsdf.freeze()
    assert tsdf.blocks().frozen.all()
    tsdf.clear()
    assert len(tsdf) == 0 and tsdf.revision > before


def test_wrong_arrays_are_refused() -> None:
    tsdf = TsdfMap(TsdfSettings(voxel=0.05))
    with pytest.raises(ValueError, match="value"):
        tsdf.write(np.zeros((2, 3)), value=np.zeros((1, VOXELS)))
    with pytest.raises(ValueError, match="depth"):
        tsdf.write(np.zeros((2, 3)), depth=np.zeros((2, VOXELS)))
    with pytest.raises(ValueError, match="coordinates"):
        tsdf.erase(np.zeros(3))
