# SPDX-License-Identifier: Apache-2.0
"""Gaussians that move to disk and back, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError, RunFolderError
from ggslam.geometry.frustums import Frustums
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, se3_exp
from ggslam.submaps.gaussian_cells import PART, GaussianCells, GaussianCellTuning
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import overridden


def random_map(count: int = 3000, channels: int = 4, seed: int = 0, extent: float = 6.0) -> GaussianMap:
    """A map in which every array, moments and votes too, holds values of its own."""
    rng = np.random.default_rng(seed)
    gaussians = GaussianMap(1, channels)
    gaussians.insert(
        torch.from_numpy(rng.uniform(-extent, extent, (count, 3)).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32)),
        torch.from_numpy(rng.uniform(-6, -2, (count, 3)).astype(np.float32)),
        torch.from_numpy(rng.normal(size=count).astype(np.float32)),
        torch.from_numpy(rng.random((count, 3)).astype(np.float32)),
    )
    for name, array in gaussians.take(torch.arange(count)).items():
        if name not in ("means", "log_scales"):
            drawn = rng.integers(0, 9, array.shape) if array.dtype == torch.int32 else rng.normal(size=array.shape)
            array[:] = torch.from_numpy(np.asarray(drawn)).to(array.dtype)
        values(gaussians, name)[:] = array
    gaussians.birth_keyframe[:] = torch.from_numpy(rng.integers(0, 5, count).astype(np.int32))
    return gaussians


def values(gaussians: GaussianMap, name: str) -> torch.Tensor:
    base, _, which = name.partition(".")
    return gaussians.moments[base][0 if which == "first" else 1] if which else getattr(gaussians, base)


def content(*maps: GaussianMap) -> list[bytes]:
    """Every row with all that is known of it, in an order that does not depend on where it is."""
    rows = []
    for gaussians in maps:
        arrays = gaussians.take(torch.arange(len(gaussians)))
        flat = [np.ascontiguousarray(a.numpy()).view(np.uint8).reshape(len(gaussians), -1) for a in arrays.values()]
        rows += [row.tobytes() for row in np.concatenate(flat, 1)] if len(gaussians) else []
    return sorted(rows)


@pytest.fixture
def cells_for(tmp_path: Path):
    stores = []

    def make(gaussians: GaussianMap, spacing: float = 2.0) -> GaussianCells:
        stores.append(GridStore.create(tmp_path / f"grid{len(stores)}", SubmapSettings(spacing=spacing)))
        return GaussianCells(stores[-1], gaussians)

    yield make
    for store in stores:
        store.close()


def test_rows_come_back_bit_for_bit(cells_for) -> None:
    gaussians = random_map()
    before, cells = content(gaussians), cells_for(gaussians)
    rows = cells.cells_of(gaussians)
    far = dict(list(rows.items())[::2])
    moved = cells.move_out(gaussians, far)
    assert moved == sum(map(len, far.values())) == cells.count and len(gaussians) == 3000 - moved
    assert content(gaussians, *(part for _, part in cells.parts())) == before
    cells.move_in(gaussians, cells.sorted_keys())
    assert cells.count == 0 and content(gaussians) == before


def test_rows_of_a_cell_keep_their_order(cells_for) -> None:
    gaussians = random_map()
    cells = cells_for(gaussians)
    key, index = max(cells.cells_of(gaussians).items(), key=lambda item: len(item[1]))
    expected = gaussians.take(torch.from_numpy(index))
    cells.move_out(gaussians, {key: index})
    back = cells.move_in(gaussians, [key])
    for name, array in expected.items():
        assert torch.equal(values(gaussians, name)[back], array), name


def test_cells_are_those_of_the_grid(cells_for) -> None:
    gaussians = random_map()
    cells = cells_for(gaussians, spacing=1.5)
    for key, index in cells.cells_of(gaussians).items():
        assert all(cells.store.key_of(mean) == key for mean in gaussians.means.numpy()[index])


def test_gaussians_at_no_place_stay(cells_for) -> None:
    gaussians = random_map(50)
    gaussians.means[3, 1], gaussians.means[7, 0] = float("nan"), 1e12
    cells = cells_for(gaussians)
    rows = cells.cells_of(gaussians)
    assert sorted(np.concatenate(list(rows.values())).tolist()) == [i for i in range(50) if i not in (3, 7)]


def test_a_cell_that_is_on_disk_takes_more(cells_for) -> None:
    """Training and new keyframes bring Gaussians into cells that are away."""
    gaussians = random_map()
    before, cells = content(gaussians), cells_for(gaussians)
    key, index = max(cells.cells_of(gaussians).items(), key=lambda item: len(item[1]))
    cells.move_out(gaussians, {key: index[: len(index) // 2]})
    cells.move_out(gaussians, {key: cells.cells_of(gaussians)[key]})
    assert cells.count == len(index) and key not in cells.cells_of(gaussians)
    assert content(gaussians, cells.read(key)) == before


@pytest.mark.parametrize("shift", [(0.02, 0, 0), (3.1, -1.7, 0.4)])
def test_a_change_moves_gaussians_to_the_cells_they_are_in_then(cells_for, shift: tuple[float, ...]) -> None:
    gaussians, expected = (random_map(1500, extent=4.0) for _ in range(2))
    cells, step = cells_for(gaussians), torch.tensor(shift, dtype=torch.float32)
    expected.means[expected.birth_keyframe == 2] += step
    cells.move_out(gaussians, cells.cells_of(gaussians))

    def change(part: GaussianMap) -> None:
        part.means[part.birth_keyframe == 2] += step

    cells.change(change, [2])
    assert content(*(part for _, part in cells.parts())) == content(expected)
    for key, part in cells.parts():
        low, high = cells.box(key)
        assert set(cells.cells_of(part)) == {key}
        assert (part.means.numpy() >= low).all() and (part.means.numpy() <= high).all()


def test_settled_store_holds_nothing_else(cells_for) -> None:
    gaussians = random_map()
    cells = cells_for(gaussians)
    cells.move_out(gaussians, cells.cells_of(gaussians))
    home = cells.sorted_keys()[:5]
    cells.move_in(gaussians, home)
    cells.remove_emptied()
    assert cells.store.cells() == cells.sorted_keys() and not set(home) & set(cells.store.cells())


def test_damaged_rows_are_refused(cells_for) -> None:
    gaussians = random_map()
    cells = cells_for(gaussians)
    cells.move_out(gaussians, cells.cells_of(gaussians))
    key = cells.sorted_keys()[0]
    for damaged in (b"no rows", b'[["means", "<f4", [1, 3]]]\nshort', b'[["means", "<%s", [1]]]\n' % (b"9" * 5000)):
        cells.store.put(key, {PART: damaged})
        with pytest.raises(FormatError, match="Gaussians"):
            cells.read(key)


def test_what_a_camera_sees_is_needed(cells_for) -> None:
    """Every Gaussian whose mean projects into the image within reach is in a needed cell; not all cells are."""
    gaussians = random_map(4000, extent=12.0)
    cells, camera = cells_for(gaussians), Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    rng = np.random.default_rng(3)
    poses = [inverse(se3_exp(np.concatenate([rng.uniform(-4, 4, 3), rng.uniform(-2, 2, 3)]))) for _ in range(5)]
    rows = cells.cells_of(gaussians)
    means = gaussians.means.numpy().astype(float).copy()
    cells.move_out(gaussians, rows)
    needed = cells.visible_cells(Frustums.of(camera, np.stack(poses), [6.0] * 5))
    for T_camera_world, keys in zip(poses, needed, strict=True):
        x, y, z = (means @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]).T
        u, v = 50 * x / z + 31.5, 50 * y / z + 23.5
        visible = (z > 0) & (z < 6) & (u > -0.5) & (u < 63.5) & (v > -0.5) & (v < 47.5)
        seen = {key for key, index in rows.items() if visible[index].any()}
        assert seen and seen <= set(keys) and len(keys) < len(rows) / 3


def test_a_full_disk_loses_and_doubles_nothing(cells_for, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some batches are written, then one is not: what was written is on disk, all else in the map."""
    gaussians = random_map()
    before, cells = content(gaussians), cells_for(gaussians)
    real, calls = cells.store.put_cells, []

    def put(writes) -> None:
        calls.append(writes)
        if len(calls) == 4:
            raise RunFolderError("cannot write cell: No space left on device")
        real(writes)

    monkeypatch.setattr(cells.store, "put_cells", put)
    with pytest.raises(RunFolderError, match="No space left"), overridden(GaussianCellTuning, batch_bytes=1):
        cells.move_out(gaussians, cells.cells_of(gaussians))
    assert len(cells.sorted_keys()) == 3 and len(gaussians) + cells.count == 3000
    assert content(gaussians, *(part for _, part in cells.parts())) == before
    cells.move_out(gaussians, cells.cells_of(gaussians))
    assert content(*(part for _, part in cells.parts())) == before
