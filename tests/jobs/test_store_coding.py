# SPDX-License-Identifier: Apache-2.0
"""A grid store in one file, coded cell by cell: each can be read alone, whoever coded it."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import ggslam, refuse, succeed
from small_runs import store_of

from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.splats import gaussians_of, splat_attributes, splat_settings
from ggslam.errors import FormatError
from ggslam.jobs.code.store_coding import CodedCells, decode_store, encode_store
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, gaussians_of_cell
from ggslam.jobs.tasks.engines import Engine
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store


@pytest.fixture(scope="module")
def store(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_of(room_run, tmp_path_factory)


@pytest.fixture(scope="module")
def coded(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("coded") / "room.ggc"
    encode_store(store, out, engine=Engine(workers=1))
    return out


def order_of(gaussians: GaussianMap) -> np.ndarray:
    return np.lexsort(gaussians.means.numpy().round(3).T)


def test_each_cell_comes_back_alone(store: Path, coded: Path) -> None:
    cells = CodedCells(coded)
    with GridStore.open(store) as opened:
        assert sorted(cells.members) == [key for key in opened.cells() if GAUSSIANS in opened.cell(key).parts]
        for key in sorted(cells.members)[:3]:
            found, true = cells.read(key), gaussians_of_cell(opened, key)
            assert len(found) == len(true)
            a, b = found.means.numpy(), true.means.numpy()
            near = np.linalg.norm(a[:, None] - b[None], axis=2).min(1)
            assert near.max() < 1e-4 and len(cells.members) > 4


@pytest.mark.long("two workers that are begun")
def test_two_workers_write_the_same_file(store: Path, coded: Path, tmp_path: Path) -> None:
    encode_store(store, tmp_path / "two.ggc", engine=Engine(workers=2))
    assert (tmp_path / "two.ggc").read_bytes() == coded.read_bytes()


def test_the_whole_is_as_good_as_coded_at_once(store: Path, coded: Path, tmp_path: Path) -> None:
    """Colours are within one step of the quantiser of those of one stream; it takes little more room."""
    with GridStore.open(store) as opened:
        keys = [key for key in opened.cells() if GAUSSIANS in opened.cell(key).parts]
        parts = [gaussians_of_cell(opened, key) for key in keys]
    whole = GaussianMap(parts[0].sh_degree, parts[0].feature_channels, with_moments=False)
    for part in parts:
        whole.append(part.take(torch.arange(len(part))))
    attributes = splat_attributes(whole, with_ids=True)
    settings = splat_settings(CodecSettings(), "r03", attributes)
    stream = encode_cloud(whole.means.numpy().astype(float), attributes, settings)
    once, cells = gaussians_of(decode_cloud(stream.data)), CodedCells(coded)
    apart = [cells.read(key) for key in sorted(cells.members)]
    assert sum(map(len, apart)) == len(once) == len(whole)
    assert coded.stat().st_size < 1.25 * len(stream.data)
    means = [float(np.abs(np.concatenate([p.sh.numpy().ravel() for p in apart])).mean()), float(once.sh.abs().mean())]
    assert means[0] == pytest.approx(means[1], rel=0.01)


def test_a_store_goes_to_a_file_and_back(store: Path, tmp_path: Path) -> None:
    said = succeed("encode", store, tmp_path / "room.ggc", "--rate", "r04", "--workers", 1)
    assert "a Gaussian" in said
    succeed("decode", tmp_path / "room.ggc", tmp_path / "back.grid")
    with GridStore.open(store) as a, GridStore.open(tmp_path / "back.grid") as b:
        assert a.settings.spacing == b.settings.spacing
        keys = [key for key in a.cells() if GAUSSIANS in a.cell(key).parts]
        assert b.cells() == keys
        for key in keys:
            one, other = gaussians_of_cell(a, key), gaussians_of_cell(b, key)
            assert sorted(one.object_id.tolist()) == sorted(other.object_id.tolist())


def test_what_is_damaged_is_said(store: Path, coded: Path, room_run: RunFolder, tmp_path: Path) -> None:
    data = coded.read_bytes()
    torn = tmp_path / "torn.ggc"
    torn.write_bytes(data[: len(data) // 2])
    refuse(ggslam("decode", torn, tmp_path / "a.grid"), "no coded cells")
    with zipfile.ZipFile(coded) as archive:
        info = archive.getinfo(archive.namelist()[2])
    middle = info.header_offset + 60 + info.file_size // 2
    torn.write_bytes(data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :])
    with pytest.raises(FormatError, match=r"torn.ggc.*(damaged|CRC)"):
        decode_store(torn, tmp_path / "b.grid")
    refuse(ggslam("encode", room_run.path, tmp_path / "x.ggc"), "a grid store becomes a .ggc")
    refuse(ggslam("encode", store, tmp_path / "x.bin", "--preset", "splat"), "a grid store becomes a .ggc")
    refuse(ggslam("decode", coded, tmp_path / "c.grid", "--slice", 1), "decoded as a whole")
    copy_store(store, tmp_path / "copy.grid")
    file = sorted((tmp_path / "copy.grid").rglob(GAUSSIANS))[2]
    file.write_bytes(b"torn")
    done = ggslam("encode", tmp_path / "copy.grid", tmp_path / "y.ggc")
    assert done.returncode == 1 and "left out" in done.stdout and len(CodedCells(tmp_path / "y.ggc").members) > 3
