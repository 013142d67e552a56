# SPDX-License-Identifier: Apache-2.0
"""What a run exports: which parts of it, under which names. tests/conformance opens the files with other programs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import ConfigError, FormatError, GgslamError, RunFolderError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.table import choose_writer
from ggslam.jobs.export.export_run import export_run
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe
from ggslam.runs.verification import accept_files
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam

HELD_OUT = [4, 12]


@pytest.fixture(scope="module")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    config = load_config(None, ["mapping.iterations_per_frame=1"])
    request = SequenceRequest(room, stop=14)
    sequence = request.open()
    slam = Slam(sequence.camera, config)
    for frame in sequence.stream(masks=False):
        slam.step(frame)
    folder = RunFolder.create(tmp_path_factory.mktemp("exports") / "run")
    folder.save(config, describe(request, sequence), slam.finish())
    return folder


def test_only_keyframes_and_what_is_held_out(run: RunFolder, tmp_path: Path) -> None:
    export_run(run, tmp_path / "few", "nerfstudio", voxel=0.05, keyframes=True)
    values = json.loads((tmp_path / "few" / "transforms.json").read_text())
    keyframes = run.keyframes().keyframe_numbers()
    found = {int(frame["file_path"][-10:-4]) for frame in values["frames"]}
    assert found == keyframes | set(HELD_OUT) and len(found) < 14
    assert len(list((tmp_path / "few" / "images").iterdir())) == len(found)


def test_a_folder_with_something_in_it_is_left_alone(run: RunFolder, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for kind in ("colmap", "nerfstudio"):
        with pytest.raises(RunFolderError, match="not an empty.*`out`"):
            export_run(run, tmp_path, kind)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("name", ["map.ply", "map.compressed.ply", "map.splat", "map.sog", "map.glb"])
def test_gaussians_for_a_larger_window_are_wider(run: RunFolder, tmp_path: Path, name: str) -> None:
    asked = "gltf" if name == "map.glb" else None
    for zoom, folder in ((1.0, "small"), (4.0, "large")):
        export_run(run, tmp_path / folder / name, asked, zoom=zoom)
    assert (tmp_path / "small" / name).read_bytes() != (tmp_path / "large" / name).read_bytes()
    if name == "map.ply":
        small, large = (read_gaussian_ply(tmp_path / folder / name) for folder in ("small", "large"))
        torch.testing.assert_close(small.means, large.means)
        assert (large.log_scales > small.log_scales).all()


def test_a_zoom_goes_with_gaussians_and_has_limits(run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`zoom`.*trajectory"):
        export_run(run, tmp_path / "poses.txt", zoom=2.0)
    with pytest.raises(ConfigError, match=r"`zoom`.* 0\.05 .*1000.* 0\.04"):
        export_run(run, tmp_path / "map.ply", zoom=0.04)
    result = CliRunner().invoke(app, ["export", str(run.path), "--out", str(tmp_path / "map.ply"), "--zoom", "0"])
    assert str(result.exception) == "--zoom: expected 0.05 to 1000, found 0" and not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["compressed-ply", "spz", "spz4", "splat"])
def test_splats_by_the_command_line(run: RunFolder, tmp_path: Path, kind: str) -> None:
    if kind in ("spz", "spz4"):
        pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
        pytest.importorskip("zstandard", reason="zstandard is not installed (extra [splats])")
    out = tmp_path / f"map{choose_writer(kind, tmp_path).endings[0]}"
    faint = export_run(run, out, kind)
    result = CliRunner().invoke(
        app, ["export", str(run.path), "--format", kind, "--out", str(out), "--min-opacity", "0.6"]
    )
    assert result.exit_code == 0, result.output
    opaque = int((run.gaussians().opacities >= 0.6).sum())
    assert f"{opaque} Gaussians" in result.output.replace("\n", " ") and f"{len(run.gaussians())} Gaussians" in faint
    if kind == "splat":
        assert out.stat().st_size == 32 * opaque


def gltf_of(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_gltf_by_the_command_line(run: RunFolder, tmp_path: Path) -> None:
    """A .glb is a mesh unless the format is given; object ids are the last column."""
    out, gaussians = tmp_path / "splats.glb", run.gaussians()
    opaque = gaussians.opacities >= 0.6
    result = CliRunner().invoke(
        app, ["export", str(run.path), "--format", "gltf", "--out", str(out), "--min-opacity", "0.6"]
    )
    assert result.exit_code == 0, result.output
    count = int(opaque.sum())
    assert f"{count} Gaussians" in result.output.replace("\n", " ")
    gltf = gltf_of(out)
    assert {accessor["count"] for accessor in gltf["accessors"]} == {count}
    assert run.has_objects()
    assert list(gltf["meshes"][0]["primitives"][0]["extensions"]) == ["KHR_gaussian_splatting", "EXT_mesh_features"]
    ids = np.frombuffer(out.read_bytes()[-4 * count :], "<f4")
    np.testing.assert_array_equal(ids, gaussians.object_id[opaque])
    assert list(gltf["meshes"][0]["extras"]["objects"]) == [str(i) for i in run.object_table().ids()]


def test_gltf_plain_and_of_objects(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "splats.glb"
    export_run(run, out, "gltf", plain=True)
    gltf = gltf_of(out)
    assert list(gltf["meshes"][0]["primitives"][0]["extensions"]) == ["KHR_gaussian_splatting"]
    assert "extras" not in gltf["meshes"][0]
    object_id, gaussians = run.object_table().ids()[0], run.gaussians()
    export_run(run, out, "gltf", objects=str(object_id))
    gltf, count = gltf_of(out), int((gaussians.object_id == object_id).sum())
    assert {accessor["count"] for accessor in gltf["accessors"]} == {count}
    assert list(gltf["meshes"][0]["extras"]["objects"]) == [str(object_id)]
    with pytest.raises(FormatError, match=r"splats\.gltf.*\.glb"):
        export_run(run, tmp_path / "splats.gltf", "gltf")
    assert choose_writer(None, out, None).name == "mesh"


def test_a_map_on_disk_is_written_cell_by_cell(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, first = tmp_path / "whole.splat", len(run.gaussians()) // 3
    export_run(run, whole, "splat")
    copy = tmp_path / "run"
    shutil.copytree(run.path, copy)
    box = {"low": [-9, -9, -9], "high": [9, 9, 9]}
    cells = [{"cell": [0, 0, 0], "start": 0, "count": first, **box},
             {"cell": [1, 0, 0], "start": first, "count": len(run.gaussians()) - first, **box}]  # fmt: skip
    (copy / "map_cells.json").write_text(json.dumps({"version": 1, "cells": cells}))
    accept_files(copy)
    monkeypatch.setattr(RunFolder, "gaussians", None)  # the whole map is not asked for
    export_run(RunFolder.open(copy), tmp_path / "parts.splat", "splat")
    assert (tmp_path / "parts.splat").read_bytes() == whole.read_bytes()


def refused(*arguments: str) -> GgslamError:
    error = CliRunner().invoke(app, ["export", *arguments]).exception
    assert isinstance(error, GgslamError)
    return error


def test_what_does_not_go_together(run: RunFolder, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "map.ply")]
    assert "says ply, but --format says spz" in str(refused(str(run.path), "--format", "spz", *out))
    assert "says ply, but --format says pcd" in str(refused(str(run.path), "--format", "pcd", *out))
    assert isinstance(refused(str(run.path), "--format", "splat", "--keyframes", *out), ConfigError)
    assert isinstance(refused(str(run.path), "--format", "colmap", "--voxel", "0", *out), ConfigError)
    with pytest.raises(RunFolderError, match=r"no Gaussian.* 1\.1 "):
        export_run(run, tmp_path / "map.splat", "splat", min_opacity=1.1)
    assert not list(tmp_path.iterdir())
