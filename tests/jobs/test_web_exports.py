# SPDX-License-Identifier: Apache-2.0
"""SOG, streamed SOG and OpenUSD of a run and of a grid store, by the command line; the files are read in
tests/conformance."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.formats.table import choose_writer
from ggslam.jobs.export.export_run import export_run
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS
from ggslam.runs.folder import RunFolder
from ggslam.runs.verification import accept_files


def meta_of(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("meta.json"))


def refused(said: str, *words: object) -> None:
    refuse(ggslam("export", *words), said)


@pytest.fixture(scope="module")
def store(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "room.grid"
    succeed("submaps", room_run.path, "--out", path, "--spacing", 1)
    return path


def test_sog(room_run: RunFolder, tmp_path: Path) -> None:
    gaussians, table = room_run.gaussians(), room_run.object_table()
    line = succeed("export", room_run.path, "--out", tmp_path / "map.sog")
    assert f"{len(gaussians)} Gaussians with the ids of {len(table)} objects" in " ".join(line.split())
    meta = meta_of(tmp_path / "map.sog")
    assert meta["count"] == len(gaussians) and len(meta["objects"]["names"]) == len(table)
    succeed("export", room_run.path, "--out", tmp_path / "web" / "meta.json", "--plain")
    meta = json.loads((tmp_path / "web" / "meta.json").read_text())
    assert meta["count"] == len(gaussians) and "objects" not in meta
    assert all((tmp_path / "web" / name).is_file() for name in meta["means"]["files"])


def test_objects_and_opacity(room_run: RunFolder, tmp_path: Path) -> None:
    gaussians = room_run.gaussians()
    number = next(i for i in room_run.object_table().ids() if (gaussians.object_id == i).any())
    wanted = (gaussians.object_id == number) & (gaussians.opacities >= 0.5)
    chosen = ["--objects", number, "--min-opacity", 0.5]
    succeed("export", room_run.path, "--out", tmp_path / "one.sog", *chosen)
    meta = meta_of(tmp_path / "one.sog")
    assert meta["count"] == int(wanted.sum()) and list(meta["objects"]["names"]) == [str(number)]
    succeed("export", room_run.path, "--out", tmp_path / "web", "--format", "streamed-sog", *chosen)
    index = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    assert index["counts"][0] == int(wanted.sum()) and list(index["objects"]) == [str(number)]


def test_usd(room_run: RunFolder, tmp_path: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (extra [usd])")
    succeed("export", room_run.path, "--out", tmp_path / "map.usdz")
    stage = Usd.Stage.Open(str(tmp_path / "map.usdz"))
    prim = stage.GetPrimAtPath("/map/gaussians")
    np.testing.assert_array_equal(prim.GetAttribute("primvars:object_id").Get(), room_run.gaussians().object_id)
    export_run(room_run, tmp_path / "plain.usdc", plain=True)
    stage = Usd.Stage.Open(str(tmp_path / "plain.usdc"))
    assert not stage.GetPrimAtPath("/map/gaussians").HasAttribute("primvars:object_id")


def test_streamed_cell_by_cell(room_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A map that was written in cells is read so, and is all there."""
    copy, count = tmp_path / "run", len(room_run.gaussians())
    shutil.copytree(room_run.path, copy)
    box, first = {"low": [-9, -9, -9], "high": [9, 9, 9]}, count // 3
    cells = [{"cell": [0, 0, 0], "start": 0, "count": first, **box},
             {"cell": [1, 0, 0], "start": first, "count": count - first, **box}]  # fmt: skip
    (copy / "map_cells.json").write_text(json.dumps({"version": 1, "cells": cells}))
    accept_files(copy)
    monkeypatch.setattr(RunFolder, "gaussians", None)
    line = succeed("export", copy, "--out", tmp_path / "web" / "lod-meta.json")
    index = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    assert index["counts"][0] == count and f"{count} + " in " ".join(line.split())
    assert len(index["tree"]["children"]) == 2


def test_streamed_of_a_store(room_run: RunFolder, store: Path, tmp_path: Path) -> None:
    said = succeed("export", store, "--format", "streamed-sog", "--out", tmp_path / "web")
    index = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    count = len(room_run.gaussians())
    assert index["counts"][0] == count and "children" in index["tree"] and f"{count} + " in " ".join(said.split())
    opaque = int((room_run.gaussians().opacities >= 0.6).sum())
    succeed("export", store, "--format", "streamed-sog", "--out", tmp_path / "opaque", "--min-opacity", 0.6)
    assert json.loads((tmp_path / "opaque" / "lod-meta.json").read_text())["counts"][0] == opaque


def test_names_say_the_format(tmp_path: Path) -> None:
    named = {"a.sog": "sog", "a/meta.json": "sog", "a/lod-meta.json": "streamed-sog", "a.usd": "usd", "a.USDA": "usd",
             "a.usdc": "usd", "a.usdz": "usd", "a.compressed.ply": "compressed-ply"}  # fmt: skip
    for name, kind in named.items():
        assert choose_writer(None, Path(name), None).name == kind
    with pytest.raises(ConfigError, match=r"my-meta\.json.*`format`"):
        choose_writer(None, tmp_path / "my-meta.json", None)
    with pytest.raises(ConfigError, match=r"a\.sog.*sog.*`format`.*usd"):
        choose_writer("usd", Path("a.sog"), None)


def test_what_is_refused(room_run: RunFolder, store: Path, tmp_path: Path) -> None:
    out = tmp_path / "web"
    refused("grid store, of which --format streamed-sog can be written, not sog", store, "--out", tmp_path / "a.sog")
    refused("no table of objects", store, "--format", "streamed-sog", "--out", out, "--objects", "all")
    refused("--keyframes goes with", room_run.path, "--out", tmp_path / "a.sog", "--keyframes")
    refused("nothing to export", room_run.path, "--out", tmp_path / "a.sog", "--min-opacity", 1.1)
    refused("at least one Gaussian", store, "--format", "streamed-sog", "--out", out, "--min-opacity", 1.1)
    refused("not an empty folder", room_run.path, "--format", "streamed-sog", "--out", store)
    with pytest.raises(FormatError, match=r"web\.zip.*\.sog.*meta\.json"):
        export_run(room_run, tmp_path / "web.zip", "sog")
    with pytest.raises(RunFolderError, match=r"1\.1"):
        export_run(room_run, out, "streamed-sog", min_opacity=1.1)
    assert not (tmp_path / "a.sog").exists() and not list(out.iterdir())


def test_a_damaged_store(store: Path, tmp_path: Path) -> None:
    """Names the file; there is no index of what was not written."""
    copy = Path(shutil.copytree(store, tmp_path / "copy.grid"))
    file = sorted(copy.rglob(GAUSSIANS))[-1]
    file.write_bytes(file.read_bytes()[:-3])
    refused("damaged", copy, "--format", "streamed-sog", "--out", tmp_path / "web")
    assert not (tmp_path / "web" / "lod-meta.json").exists()
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).random((500, 3)))
    succeed("submaps", tmp_path / "cloud.npy", "--out", tmp_path / "cloud.grid")
    refused("has Gaussians", tmp_path / "cloud.grid", "--format", "streamed-sog", "--out", tmp_path / "none")
