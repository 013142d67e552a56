# SPDX-License-Identifier: Apache-2.0
"""Files of Gaussians where a run is expected: viewed, rendered, exported, edited, encoded and compared."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import ggslam, refuse, succeed
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ggslam.errors import RunFolderError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.splat_formats import open_splats, read_splats, write_splats
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import MapFile, MapViewTuning, open_map
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.harmonics import spherical_harmonics

NAMES = {1: "mug", 2: "chair"}
FILES = {"map.ply": 1e-6, "c.compressed.ply": 0.002, "map.spz": 0.001, "map.sog": 0.001, "map.splat": 1e-6,
         "map.glb": 1e-6, "map.usda": 1e-6, "sog/meta.json": 0.001}  # fmt: skip
PACKAGES = {".spz": "gaussforge", ".usda": "pxr"}


def two_things(degree: int = 1) -> GaussianMap:
    """Two clusters of 400 opaque Gaussians, 2 m apart, objects 1 and 2."""
    random = torch.Generator().manual_seed(4)
    out = GaussianMap(degree, with_moments=False)
    for number, x in ((1, -1.0), (2, 1.0)):
        means = 0.2 * torch.randn((400, 3), generator=random) + torch.tensor([x, 0, 3.0])
        out.insert(means, torch.randn((400, 4), generator=random), torch.full((400, 3), -3.5), 3.0,
                   torch.rand((400, 3), generator=random), object_id=torch.full((400,), number))  # fmt: skip
    out.sh[:, 1:] = 0.2 * torch.randn(out.sh[:, 1:].shape, generator=random)
    return out


def written(path: Path, names: dict[int, str] | None = None) -> Path:
    if package := PACKAGES.get(path.suffix):
        pytest.importorskip(package, reason=f"{package} is not installed")
    path.parent.mkdir(exist_ok=True)
    write_splats(path, two_things(), names)
    return path


@pytest.mark.parametrize("name", FILES)
def test_every_command_takes_every_format(name: str, tmp_path: Path) -> None:
    path, wanted = written(tmp_path / name), two_things()
    succeed("export", path, "--out", tmp_path / "back.ply")
    distance = cKDTree(read_splats(tmp_path / "back.ply").means.numpy()).query(wanted.means.numpy())[0]
    assert distance.max() <= 2 * FILES[name]
    pictures = tmp_path / "pictures"
    succeed("render", path, "--frames", "0,6", "--what", "color,depth", "--width", 160, "--out", pictures)
    assert all(cv2.imread(str(file)).max() > 100 for file in pictures.iterdir()) and len(list(pictures.iterdir())) == 4
    assert "800 Gaussians" in succeed("view", path, "--html", tmp_path / "page.html")
    assert "800" in succeed("encode", path, tmp_path / "map.bin", "--preset", "splat")
    assert "800 Gaussians" in succeed("export", tmp_path / "map.bin", "--out", tmp_path / "again.splat")
    assert "moved all" in succeed("edit", path, "--move", "all", "0 1 0", "--out", tmp_path / "moved.ply")
    moved = read_splats(tmp_path / "moved.ply").means.numpy()
    assert cKDTree(moved).query(wanted.means.numpy() + [0, 1, 0])[0].max() <= 2 * FILES[name] + 1e-6
    assert "1.0000" in succeed("compare", path, tmp_path / "back.ply", "--align", "none")


def test_the_folder_of_a_meta_json_is_a_file_too(tmp_path: Path) -> None:
    written(tmp_path / "sog" / "meta.json")
    assert "800" in succeed("encode", tmp_path / "sog", tmp_path / "map.bin", "--preset", "splat")
    assert "800 Gaussians" in succeed("export", tmp_path / "sog", "--out", tmp_path / "map.splat")
    assert "1.0000" in succeed("compare", tmp_path / "sog", tmp_path / "map.splat", "--align", "none")


def test_cameras_stand_around_the_map_and_see_it_whole(tmp_path: Path) -> None:
    folder = open_map(written(tmp_path / "map.ply"))
    poses, camera = folder.keyframes().poses(), folder.sequence().camera
    assert len(poses) == MapViewTuning.views and not folder.has_poses
    points = folder.gaussians().means.numpy()
    for T in poses.values():
        own = (points - T[:3, 3]) @ T[:3, :3]
        pixels = own[:, :2] / own[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1) & (own[:, 2] > 0)
        assert inside.mean() > 0.95 and np.ptp(pixels, axis=0).max() > 0.4 * camera.height
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1) and T[1, 1] > 0.9  # y is down


def test_pictures_go_beside_a_file(tmp_path: Path) -> None:
    path = written(tmp_path / "map.ply")
    assert "8 pictures" in succeed("render", path, "--what", "color", "--width", 64)
    assert len(list((tmp_path / "map_renders").glob("frame*_color.png"))) == 8


@pytest.mark.parametrize("name", ["map.sog", "map.glb", "map.ply"])
def test_objects_of_a_file_are_edited_and_exported(name: str, tmp_path: Path) -> None:
    names = NAMES if name != "map.ply" else {}  # which has ids alone
    path, chosen = written(tmp_path / name, names), "mug" if names else "1"
    assert "removed" in succeed("edit", path, "--remove", chosen, "--out", tmp_path / "less.sog")
    left = open_splats(tmp_path / "less.sog")
    assert len(left.rows) == 400 and left.names == {2: names.get(2, "")}
    assert (read_splats(tmp_path / "less.sog").means[:, 0] > 0).all()
    done = succeed("export", path, "--objects", chosen, "--format", "gltf", "--out", tmp_path / "one.glb")
    assert "400 Gaussians" in done and len(read_splats(tmp_path / "one.glb")) == 400
    succeed("render", path, "--frames", "0", "--what", "ids", "--width", 64, "--out", tmp_path / "ids")
    refuse(ggslam("render", path, "--what", "pca", "--out", tmp_path / "pca"), "no identity vectors")
    model = ViewedRun(open_map(path))
    assert len(model.frame_picture(0)) == 2 and model.identity_colors(model.shown_rows()) is None
    assert model.has_objects and {listed.id for listed in model.objects()} == {1, 2}
    assert "views around it" in model.describe() and model.notes == []


def test_object_ids_of_others_may_be_any_number(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    gaussians = two_things()
    gaussians.object_id[:] = 100_000
    write_splats(tmp_path / "map.glb", gaussians, {100_000: "statue"})
    assert not open_map(tmp_path / "map.glb").has_objects() and "read without objects" in caplog.text
    succeed("view", tmp_path / "map.glb", "--html", tmp_path / "page.html")


def test_a_turned_file_keeps_its_colours(tmp_path: Path) -> None:
    path = written(tmp_path / "map.ply")
    succeed("edit", path, "--move", "all", "0 0 0", "--rotate", "20 90 -35", "--out", tmp_path / "turned.ply")
    R = Rotation.from_euler("xyz", [20, 90, -35], degrees=True).as_matrix()
    before, after = two_things().sh.double(), read_splats(tmp_path / "turned.ply").sh.double()
    directions = torch.nn.functional.normalize(torch.from_numpy(np.random.default_rng(0).normal(size=(50, 3))), dim=1)
    seen = torch.einsum("dk,nkc->dnc", spherical_harmonics(directions @ torch.from_numpy(R).T, 4), after)
    assert float((seen - torch.einsum("dk,nkc->dnc", spherical_harmonics(directions, 4), before)).abs().max()) < 1e-5


def test_a_file_with_objects_turns_as_a_whole(tmp_path: Path) -> None:
    """What has no object turns along."""
    gaussians = two_things()
    gaussians.object_id[:50] = 0
    write_splats(tmp_path / "map.ply", gaussians, {1: "a", 2: "b"})
    succeed("edit", tmp_path / "map.ply", "--move", "all", "0 0 1", "--rotate", "0 90 0", "--out", tmp_path / "t.ply")
    turned, means = read_splats(tmp_path / "t.ply"), gaussians.means.double().numpy()
    R = Rotation.from_euler("xyz", [0, 90, 0], degrees=True).as_matrix()
    expected = (means - means.mean(0)) @ R.T + means.mean(0) + [0, 0, 1]
    assert np.abs(turned.means.numpy() - expected).max() < 1e-4
    assert open_map(tmp_path / "t.ply").has_objects()


def test_what_needs_a_recording_says_so(tmp_path: Path) -> None:
    path = written(tmp_path / "map.ply")
    for words, expected in (
        (("--format", "mesh", "--out", tmp_path / "m.ply"), "format mesh needs"),
        (("--out", tmp_path / "poses.txt"), "format trajectory needs"),
        (("--format", "colmap", "--out", tmp_path / "c"), "format colmap needs"),
        (("--zoom", 2, "--out", tmp_path / "z.ply"), "--zoom needs"),
        (("--movers", "--out", tmp_path / "movers"), "--movers needs"),
    ):
        refuse(ggslam("export", path, *words), "without a run's poses and recording", expected)
    refuse(ggslam("edit", path, "--remove", "mug"), "no object ids")
    refuse(ggslam("edit", path, "--move", "all", "0 0 1", "--out", path), "is there already")
    refuse(ggslam("eval", path), "is a file of Gaussians: view, render, export, edit, encode and compare take it")
    with pytest.raises(RunFolderError, match=r"map\.ply.*trajectory"):
        open_map(path).trajectory()
    refuse(ggslam("render", tmp_path / "none.sog"), "no such folder")


def test_what_was_left_out_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    gaussians = two_things()
    gaussians.opacity_logits[:7] = torch.nan
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    done = ggslam("export", tmp_path / "map.ply", "--out", tmp_path / "map.splat")
    assert done.returncode == 0 and "793 Gaussians" in done.stdout
    assert "7 of 800 Gaussians left out: opacity is no number" in caplog.text


def test_a_map_made_to_be_sent_is_seen_from_where_the_run_was(room_run: RunFolder, tmp_path: Path) -> None:
    succeed("encode", room_run.path, tmp_path / "map.ggz", "--rate", "r04")
    folder = open_map(tmp_path / "map.ggz")
    assert isinstance(folder, MapFile) and folder.has_poses and folder.has_objects() == room_run.has_objects()
    poses = room_run.keyframes().poses()
    assert {k: T.tolist() for k, T in folder.keyframes().poses().items()} == {k: T.tolist() for k, T in poses.items()}
    for path, out in ((tmp_path / "map.ggz", tmp_path / "a"), (room_run.path, tmp_path / "b")):
        succeed("render", path, "--frames", "0,5", "--what", "color", "--out", out)
    a, b = (np.stack([cv2.imread(str(file)) for file in sorted((tmp_path / name).iterdir())]) for name in "ab")
    assert np.abs(a.astype(int) - b).mean() < 3
