# SPDX-License-Identifier: Apache-2.0
"""A grid store in one file, coded cell by cell: each can be read alone, whoever coded it."""

from __future__ import annotations

import hashlib
import json
import os
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
from ggslam.jobs.encode.coded_cells import CodedCells, decode_store
from ggslam.jobs.encode.contents import contents_of_cells
from ggslam.jobs.encode.store_coding import encode_store
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, cell_arrays, gaussians_of_cell, gaussians_to_bytes
from ggslam.jobs.tasks.engines import Engine
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.oriented_box import OrientedBox
from ggslam.scene.packed_arrays import pack_bytes
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store
from ggslam.submaps.store_objects import (
    ObjectEvent,
    StoredObject,
    StoreObjects,
    VisitObjects,
    read_objects,
    write_objects,
)
from ggslam.submaps.visit_files import read_visit


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
            size = float(np.exp(np.median(true.log_scales.median(1).values.numpy())))
            assert near.max() < 3**0.5 * 0.52 * max(size / 24, 1e-4) and len(cells.members) > 4


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


def several_visits(store: Path, out: Path) -> StoreObjects:
    """A copy of a store of which a second visit wrote some cells, and that knows objects."""
    copy_store(store, out)
    box = OrientedBox((0.1, 0.2, 0.3), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (1.0, 0.5, 0.25))
    with GridStore.open(out, write=True) as opened:
        keys = [key for key in opened.cells() if GAUSSIANS in opened.cell(key).parts]
        first = opened.visits()[0]
        opened.begin_visit("second")
        for key in keys[:2]:
            arrays, _ = cell_arrays(opened, key)
            data = gaussians_to_bytes(arrays, "second")
            opened.put(key, {GAUSSIANS: data}, 1234.5, {GAUSSIANS: len(arrays["means"])})
        known = [StoredObject(3, "mug", box, 12, keys[:1], first, "second"),
                 StoredObject(40, None, box, 0, [], first, first, gone_since="second")]  # fmt: skip
        events = [ObjectEvent("removed", 40, None, keys[:1], (0.1, 0.2, 0.3))]
        objects = StoreObjects(visits=[VisitObjects(first, "/a", [], "first"),
                                       VisitObjects("second", "/b", ["x"], "history", events=events)],
                               objects=known)  # fmt: skip
        write_objects(opened, objects)
    return objects


def test_objects_and_visits_are_kept(store: Path, tmp_path: Path) -> None:
    objects = several_visits(store, tmp_path / "two.grid")
    encode_store(tmp_path / "two.grid", tmp_path / "two.ggc", "r04", engine=Engine(workers=1))
    decode_store(tmp_path / "two.ggc", tmp_path / "back.grid")
    with GridStore.open(tmp_path / "two.grid") as a, GridStore.open(tmp_path / "back.grid") as b:
        assert read_objects(b) == objects == read_objects(a)
        assert a.visits() == b.visits() and len(a.visits()) == 2
        assert [read_visit(a, visit) for visit in a.visits()] == [read_visit(b, visit) for visit in b.visits()]
        assert read_visit(b, b.visits()[0]) is not None
        for key in b.cells():
            one, other = a.cell(key), b.cell(key)
            assert (one.visit, one.recorded_at) == (other.visit, other.recorded_at)
            assert cell_arrays(a, key)[1] == cell_arrays(b, key)[1]
        assert b.cell(b.cells()[0]).recorded_at == 1234.5
        assert {change.key for change in b.changed_since("second")} == set(b.cells()[:2])
    with zipfile.ZipFile(tmp_path / "two.ggc") as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    head = json.loads(members["cells.json"])
    for name in ("objects.json.xz", "visits/0.json.xz"):
        torn = {**members, name: pack_bytes(b"[]")}
        told = {"bytes": len(torn[name]), "sha256": hashlib.sha256(torn[name]).hexdigest()}
        torn["cells.json"] = json.dumps({**head, "files": {**head["files"], name: told}}).encode()
        with zipfile.ZipFile(tmp_path / "torn.ggc", "w") as archive:
            for member, content in torn.items():
                archive.writestr(member, content)
        with pytest.raises(FormatError, match=rf"torn\.ggc: {name}"):
            decode_store(tmp_path / "torn.ggc", tmp_path / "no.grid")
        assert not (tmp_path / "no.grid").exists()


def test_inspect_says_what_is_inside(store: Path, tmp_path: Path) -> None:
    several_visits(store, tmp_path / "two.grid")
    file = tmp_path / "two.ggc"
    done = encode_store(tmp_path / "two.grid", file, engine=Engine(workers=1))
    found = contents_of_cells(file)
    facts = dict(found.facts)
    assert found.gaussians == done.gaussians == int(facts["Gaussians"])
    assert facts["objects"] == "1: mug (3); 1 more are gone" and facts["visits"].startswith("2: run ")
    assert facts["visits"].endswith(", second") and facts["grid"].startswith(f"{len(done.sizes)} cells of 2 m")
    assert sum(found.parts.values()) == file.stat().st_size and found.parts["object ids"] > 0 and not found.problems
    said = succeed("inspect", file)
    assert "mug (3)" in said and "positions" in said and str(file.stat().st_size) in said
    data = bytearray(file.read_bytes())
    with zipfile.ZipFile(file) as archive:
        info = archive.getinfo(next(name for name in archive.namelist() if name.startswith("cells/")))
    data[info.header_offset + 60 + info.file_size // 2] ^= 255
    file.write_bytes(data)
    found = contents_of_cells(file)
    assert len(found.problems) == 1 and info.filename in found.problems[0]
    assert found.parts["damaged cells"] == info.file_size and sum(found.parts.values()) == file.stat().st_size
    assert "damaged:" in succeed("inspect", file)


def test_files_of_version_1_are_read(store: Path, coded: Path, tmp_path: Path) -> None:
    """Which tell nothing of visits and objects."""
    with zipfile.ZipFile(coded) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    head = json.loads(members.pop("cells.json"))
    head = {key: value for key, value in head.items() if key not in ("visits", "files")} | {"version": 1}
    for cell in head["cells"].values():
        for name in ("visit", "seen_by", "recorded_at"):
            del cell[name]
    with zipfile.ZipFile(tmp_path / "old.ggc", "w") as archive:
        archive.writestr("cells.json", json.dumps(head))
        for member, content in members.items():
            archive.writestr(member, content)
    count = decode_store(tmp_path / "old.ggc", tmp_path / "old.grid")
    with GridStore.open(tmp_path / "old.grid") as opened:
        assert opened.visits() == ["old.ggc"] and len(opened.cells()) == len(head["cells"]) and count > 1000


def test_a_cell_far_away_leaves_the_others_their_precision(store: Path, tmp_path: Path) -> None:
    copy_store(store, tmp_path / "far.grid")
    with GridStore.open(tmp_path / "far.grid", write=True) as opened:
        keys = [key for key in opened.cells() if GAUSSIANS in opened.cell(key).parts]
        arrays, _ = cell_arrays(opened, keys[0])
        one = {name: values[:1].copy() for name, values in arrays.items()}
        one["means"][0, 0] += 100_000
        opened.begin_visit("far")
        opened.put(opened.key_of(one["means"][0]), {GAUSSIANS: gaussians_to_bytes(one, "far")}, 0.0, {GAUSSIANS: 1})
    encode_store(tmp_path / "far.grid", tmp_path / "far.ggc", "r04", engine=Engine(workers=1))
    cells = CodedCells(tmp_path / "far.ggc")
    with GridStore.open(tmp_path / "far.grid") as opened:
        for key in (keys[0], keys[-1]):
            found, true = cells.read(key).means.numpy(), gaussians_of_cell(opened, key).means.numpy()
            off = np.abs(np.sort(found, axis=0) - np.sort(true, axis=0)).max()
            assert off < 5e-4  # metres; 100 km in 18 bits are steps of 0.4 m


def test_what_is_damaged_is_said(store: Path, coded: Path, room_run: RunFolder, tmp_path: Path) -> None:
    data = coded.read_bytes()
    torn = tmp_path / "torn.ggc"
    torn.write_bytes(data[: len(data) // 2])
    refuse(ggslam("decode", torn, tmp_path / "a.grid"), "no coded cells")
    with zipfile.ZipFile(coded) as archive:
        info = archive.getinfo(archive.namelist()[2])
    middle = info.header_offset + 60 + info.file_size // 2
    torn.write_bytes(data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :])
    with pytest.raises(FormatError, match=r"torn\.ggc.*cells/.*\.bin"):
        decode_store(torn, tmp_path / "b.grid")
    refuse(ggslam("encode", room_run.path, tmp_path / "x.ggc"), "a grid store becomes a .ggc")
    refuse(ggslam("encode", store, tmp_path / "x.bin", "--preset", "splat"), "a grid store becomes a .ggc")
    refuse(ggslam("decode", coded, tmp_path / "c.grid", "--slice", 1), "decoded as a whole")
    copy_store(store, tmp_path / "copy.grid")
    file = sorted((tmp_path / "copy.grid").rglob(GAUSSIANS))[2]
    for damage in (lambda: file.write_bytes(b"torn"), lambda: os.truncate(file, 50 << 30), lambda: swap(file.parent)):
        damage()
        done = ggslam("encode", tmp_path / "copy.grid", tmp_path / "y.ggc")
        assert done.returncode == 2 and "left out" in done.stdout and len(CodedCells(tmp_path / "y.ggc").members) > 3


def swap(folder: Path) -> None:
    """Puts a link in the place of a folder, to where it is then."""
    aside = folder.parents[3] / "aside"
    folder.rename(aside)
    folder.symlink_to(aside)
