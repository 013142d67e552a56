# SPDX-License-Identifier: Apache-2.0
"""TSDF files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_scenes import Plane, render_depth, small_camera

from ggslam.errors import FormatError, RunFolderError
from ggslam.scene.arrays import arrays_to_bytes
from ggslam.volumes.measured_points import measured_octants
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_file import load_tsdf, save_tsdf


@pytest.fixture
def wall() -> TsdfMap:
    tsdf, camera = TsdfMap(TsdfSettings(voxel=0.04, max_weight=9)), small_camera(80, 60)
    depth = render_depth(Plane((0, 0, -1), -2), camera, np.eye(4))
    color = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    tsdf.integrate(depth, camera, np.eye(4), color, np.full((60, 80), 3, np.uint16))
    return tsdf


def test_a_map_comes_back_as_it_was(tmp_path: Path, wall: TsdfMap) -> None:
    save_tsdf(tmp_path / "map.npz", wall)
    back = load_tsdf(tmp_path / "map.npz")
    assert back.settings == wall.settings
    blocks, other = wall.blocks(), back.blocks()
    assert blocks.dense.any() and not blocks.dense.all()
    assert sorted(map(tuple, blocks.coordinates[blocks.dense])) == sorted(map(tuple, other.coordinates[other.dense]))
    voxels, same = wall.read(blocks.coordinates), back.read(blocks.coordinates)
    assert all(np.array_equal(getattr(voxels, name), getattr(same, name)) for name in vars(voxels))
    assert other.frozen.all() and back.decay() == 0
    assert not load_tsdf(tmp_path / "map.npz", frozen=False).blocks().frozen.any()
    save_tsdf(tmp_path / "again.npz", back)
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "map.npz").read_bytes()


def test_files_of_version_1_are_read(tmp_path: Path, wall: TsdfMap) -> None:
    """They hold no measured points: the surface is the same, and those of views from then on count."""
    save_tsdf(tmp_path / "map.npz", wall)
    with np.load(tmp_path / "map.npz") as file:
        arrays = dict(file)
    old = {name: array for name, array in arrays.items() if name not in ("hits", "octants", "sha256")}
    (tmp_path / "old.npz").write_bytes(arrays_to_bytes(**{**old, "version": np.array(1)}))
    back, at = load_tsdf(tmp_path / "old.npz"), wall.blocks().coordinates
    voxels, same = wall.read(at), back.read(at)
    for name in ("value", "weight", "color", "label", "votes"):
        assert np.array_equal(getattr(voxels, name), getattr(same, name))
    assert measured_octants(back).size == 0 and len(measured_octants(wall)) > 1000
    camera = small_camera(80, 60)
    back.integrate(render_depth(Plane((0, 0, -1), -2), camera, np.eye(4)), camera, np.eye(4))
    assert np.array_equal(*(np.unique(measured_octants(m), axis=0) for m in (wall, back)))


def test_damaged_files_are_refused(tmp_path: Path, wall: TsdfMap) -> None:
    path = tmp_path / "map.npz"
    save_tsdf(path, wall)
    data = path.read_bytes()
    with np.load(path) as arrays:
        good = dict(arrays)
    cases: dict[str, bytes] = {
        "cut": data[: len(data) // 2], "empty": b"", "text": b"no map",
        "flipped": data[:5000] + bytes([data[5000] ^ 255]) + data[5001:],
    }  # fmt: skip
    no_unicode = good["setting_names"].copy()
    no_unicode.view(np.uint32)[3] = 0x00F00041  # beyond all characters
    changes: list[dict[str, np.ndarray]] = [
        {"version": np.array(99)}, {"version": np.zeros(3)}, {"value": good["value"][:-1]},
        {"value": good["value"].astype(float)}, {"dense": good["dense"].astype(np.int64)},
        {"free": np.zeros((2, 3), np.int32)},
        {"setting_values": 0 * good["setting_values"]}, {"setting_names": good["setting_names"][:-1]},
        {"setting_values": good["setting_values"] * np.nan}, {"setting_values": good["setting_values"] * 1j},
        {"setting_values": good["setting_values"].reshape(-1, 1)}, {"version": np.array(np.inf)},
        {"setting_names": np.array(["\ud800" * 20] * len(good["setting_names"]))},
        {"setting_names": no_unicode}, {"setting_names": good["setting_names"].astype(bytes)},
        {"dense": np.repeat(good["dense"][:1], len(good["dense"]), 0)},
    ]  # fmt: skip
    cases |= {f"change {n}": arrays_to_bytes(**{**good, **change}) for n, change in enumerate(changes)}
    cases |= {f"no {name}": arrays_to_bytes(**{k: v for k, v in good.items() if k != name}) for name in good}
    for name, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(FormatError, match="map.npz"):
            load_tsdf(path)
            pytest.fail(name)
    with pytest.raises(FormatError, match=r"none\.npz"):
        load_tsdf(tmp_path / "none.npz")
    with pytest.raises(RunFolderError):
        save_tsdf(tmp_path / "no folder" / "map.npz", wall)
