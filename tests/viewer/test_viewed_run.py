# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.jobs.view.serve import serve_run, write_page
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.objects.editing import remove_objects
from ggslam.objects.segmented_rows import keep_rows
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import vote_label_image
from ggslam.runs.folder import RunFolder
from ggslam.runs.writing import OBJECT_FILES, write_objects
from ggslam.scene.poses import inverse, quaternion_to_matrix
from ggslam.viewer.page import Page
from ggslam.viewer.server import close_server, open_server


@pytest.fixture
def viewed(run: RunFolder) -> ViewedRun:
    return ViewedRun(run)


def some_object(viewed: ViewedRun) -> int:
    """One of middle size."""
    return sorted(viewed.objects(), key=lambda record: record.gaussians)[len(viewed.objects()) // 2].id


def test_splats_come_by_object(viewed: ViewedRun) -> None:
    groups = viewed.splats("colour", 0)
    listed = {record.id: record.gaussians for record in viewed.objects()}
    assert set(groups) - {0} <= set(listed)
    assert sum(map(len, groups.values())) <= len(viewed.folder.gaussians())
    one = some_object(viewed)
    colors = viewed.splats("objects", 0)[one].colors
    assert (colors == next(r.color for r in viewed.objects() if r.id == one)).all()
    assert len(np.unique(viewed.splats("depth", 0)[one].colors, axis=0)) > 1
    limited = ViewedRun(viewed.folder, max_splats=1000)
    assert sum(map(len, limited.splats("identity", 0).values())) == 1000


def test_the_object_under_a_pixel_is_the_rendered_one(viewed: ViewedRun) -> None:
    """A small patch that is rendered around a pixel's ray gives what the whole image has there."""
    gaussians, camera = viewed.folder.segmented_map().gaussians, viewed.camera
    T = viewed.frame_poses[0]
    rasterizer = CpuRasterizer()
    view = rasterizer.forward(gaussians, camera, inverse(T), features=False)
    expected = vote_label_image(rasterizer, view, gaussians.object_id.numpy().astype(np.uint16))
    pixels = np.random.default_rng(1).integers([10, 10], [camera.width - 10, camera.height - 10], (60, 2))
    same = []
    for u, v in pixels:
        ray = T[:3, :3] @ [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]
        # The patch faces the ray: there is less than a cosine between its pixels and those of the image.
        focal = camera.fx * np.linalg.norm([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        same.append(viewed.object_at(T[:3, 3], ray, focal, set()) == expected[v, u])
    assert np.mean(same) > 0.9
    u, v = camera.width // 2, camera.height // 2
    hidden = viewed.object_at(T[:3, 3], T[:3, 2], camera.fx, {0, *(r.id for r in viewed.objects())})
    assert hidden == 0 and 0 <= u < camera.width and 0 <= v < camera.height


def test_edits_are_saved_as_the_command_would(viewed: ViewedRun, tmp_path: Path) -> None:
    before = (viewed.folder.path / "map.ply").read_bytes()
    ids = [record.id for record in viewed.objects()]
    record = viewed.objects()[1]
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([0.9, 0.1, -0.3, 0.2]))
    T[:3, 3] = record.centroid - T[:3, :3] @ record.centroid + [0.1, -0.05, 0.2]
    viewed.remove(ids[0])
    viewed.move(ids[1], T)
    viewed.rename(ids[2], "thing")
    assert len(viewed.edits()) == 3 and ids[0] not in [r.id for r in viewed.objects()]
    moved = next(r for r in viewed.objects() if r.id == ids[1])
    assert np.allclose(moved.centroid, record.centroid + [0.1, -0.05, 0.2], atol=0.02)
    viewed.save("saved-from-a-page", inpaint=False)
    edits = [*viewed._edits]
    assert edits[0] == Edit("remove", str(ids[0])) and edits[1].rotation
    expected = edit_run(viewed.folder, edits, tmp_path / "expected").folder
    saved = RunFolder.open(viewed.folder.path.resolve().parent / "saved-from-a-page")
    assert (saved.path / "map.ply").read_bytes() == (expected.path / "map.ply").read_bytes()
    assert saved.object_table().record(ids[2]).name == "thing"
    assert (viewed.folder.path / "map.ply").read_bytes() == before


def test_a_move_is_that_of_the_gizmo(viewed: ViewedRun) -> None:
    one = some_object(viewed)
    record = next(r for r in viewed.objects() if r.id == one)
    before = viewed.splats("colour", 0)[one].centers
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([0.8, 0.3, 0.4, -0.2]))
    T[:3, 3] = record.centroid - T[:3, :3] @ record.centroid + [0.3, 0.0, -0.1]
    viewed.move(one, T)
    after = viewed.splats("colour", 0)[one].centers
    expected = before @ T[:3, :3].T + T[:3, 3]
    distance = np.linalg.norm(expected[:, None] - after[None], axis=2).min(axis=1)
    assert np.mean(distance < 0.02) > 0.9  # floaters stay where they are


def test_edits_can_be_taken_back(viewed: ViewedRun) -> None:
    count = len(viewed.objects())
    with pytest.raises(ConfigError, match="no edit"):
        viewed.undo()
    with pytest.raises(ConfigError, match="nothing was edited"):
        viewed.save("anywhere", inpaint=False)
    viewed.rename(viewed.objects()[0].id, "first")
    viewed.remove(some_object(viewed))
    viewed.undo()
    assert len(viewed.objects()) == count and viewed.objects()[0].name == "first" and len(viewed.edits()) == 1
    with pytest.raises(ConfigError):
        viewed.rename(viewed.objects()[0].id, "all")
    assert len(viewed.edits()) == 1


def test_an_exported_object_is_a_splat_file(viewed: ViewedRun, tmp_path: Path) -> None:
    record = viewed.objects()[0]
    name, content = viewed.export(record.id)
    (tmp_path / name).write_bytes(content)
    found = read_gaussian_ply(tmp_path / name, with_moments=False)
    assert len(found) == record.gaussians and (found.object_id == record.id).all()


def test_pictures(viewed: ViewedRun) -> None:
    picture, recorded = viewed.frame_picture(3)
    assert picture.dtype == np.uint8 and recorded.shape == (viewed.camera.height, viewed.camera.width, 3)
    T = viewed.frame_poses[0]
    everything = {0, *(r.id for r in viewed.objects())}
    assert viewed.picture(viewed.camera, T, set()).std() > 10
    assert viewed.picture(viewed.camera, T, everything).max() == 0


def test_a_run_named_by_a_dot_has_a_place_to_save_to(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.path)
    model = ViewedRun(RunFolder.open(Path()))
    assert model.save_folder() / model.default_target() == Path(str(run.path.resolve()) + "-edited")
    model.rename(some_object(model), "thing")


STRAY_NAMES = ["", "..", "/tmp/elsewhere", "../elsewhere", "~nobody/x", "a\x00b", "a\x1b[2J", "x" * 300]


@pytest.mark.parametrize("target", STRAY_NAMES)
def test_a_page_saves_in_one_folder_only(viewed: ViewedRun, target: str) -> None:
    viewed.rename(some_object(viewed), "thing")
    with pytest.raises(ConfigError, match=f"{viewed.save_folder()}"):
        viewed.save(target, inpaint=False)


def test_names_of_objects_have_an_end(viewed: ViewedRun) -> None:
    with pytest.raises(ConfigError, match="201.*200"):
        viewed.rename(some_object(viewed), "x" * 201)


def test_a_run_all_of_whose_gaussians_were_removed_is_shown(run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    empty = RunFolder(Path(shutil.copytree(run.path, tmp_path / "empty")))
    scene = run.segmented_map()
    remove_objects(scene, scene.table.ids())
    keep_rows(scene, np.zeros(len(scene.gaussians), bool))
    with empty.change_files("map.ply", *OBJECT_FILES):
        write_objects(empty.path, scene)
    server, model = serve_run(empty, port=0)
    close_server(server)
    assert model.describe().startswith("0 Gaussians") and not model.objects()
    for coloring in model.colorings:
        assert model.splats(coloring, 0) == {}
    write_page(empty, tmp_path / "empty.html")


@pytest.mark.parametrize("damage", [
    ("keyframes.json", "[]"), ("keyframes.json", "{}"), ("sequence.json", "{}"), ("sequence.json", '{"camera": null}'),
])  # fmt: skip
def test_damaged_files_are_named(run: RunFolder, tmp_path: Path, damage: tuple[str, str]) -> None:
    copied = RunFolder(Path(shutil.copytree(run.path, tmp_path / "damaged")))
    (copied.path / damage[0]).write_text(damage[1])
    with pytest.raises(RunFolderError, match=damage[0]):
        ViewedRun(copied)


def test_a_pose_that_is_no_number_is_told(run: RunFolder, tmp_path: Path) -> None:
    copied = RunFolder(Path(shutil.copytree(run.path, tmp_path / "damaged")))
    path = copied.path / "keyframes.json"
    record = json.loads(path.read_text())
    record["frames"][2]["T_keyframe_camera"][0][3] = None
    path.write_text(json.dumps(record))
    with pytest.raises(RunFolderError, match=r"keyframes\.json.*\b2\b"):
        ViewedRun(copied)


BOX = {"center": [0.5, 0.0, 1.0], "axes": np.eye(3).tolist(), "size": [0.2, 0.2, 0.3]}


def written_changes(folder: Path, old: Path, new: Path) -> Path:
    """As `ggslam changes` writes them: something moved, without a picture, and something was removed, with one."""
    folder.mkdir()
    cv2.imwrite(str(folder / "change01_removed.png"), np.full((20, 40, 3), (0, 0, 200), np.uint8))
    moved = {"kind": "moved", "name": "mug (7)", "confidence": 0.9, "old": {"ids": [7], "box": BOX},
             "new": {"ids": [7], "box": {**BOX, "center": [0.9, 0.0, 1.0]}}, "moved_m": 0.4, "turned_deg": 3.0,
             "turn_known": False}  # fmt: skip
    removed = {"kind": "removed", "name": "milk (2)", "confidence": 0.8, "old": {"ids": [2], "box": BOX}, "new": None,
               "picture": "change01_removed.png"}  # fmt: skip
    values = {"old": str(old), "new": str(new), "changes": [moved, removed], "unseen": []}
    (folder / "changes.json").write_text(json.dumps(values))
    return folder


def test_changes_of_a_later_visit_are_shown_in_the_older_map(run: RunFolder, tmp_path: Path) -> None:
    place = written_changes(tmp_path / "changes", run.path, tmp_path / "newer")
    viewed = ViewedRun(run, changes=place)
    moved, removed = viewed.changes()
    assert moved.text == "mug (7): moved by 40.0 cm, turn not known" and moved.picture is None
    assert moved.old is not None and moved.new is not None and np.allclose(moved.new[0] - moved.old[0], [0.4, 0, 0])
    assert removed.new is None and removed.picture is not None and tuple(removed.picture[0, 0]) == (200, 0, 0)
    assert not [note for note in viewed.notes if "changes" in note] and not ViewedRun(run).changes()


def test_changes_of_other_runs_are_told(run: RunFolder, tmp_path: Path) -> None:
    other = written_changes(tmp_path / "other", tmp_path / "older", tmp_path / "newer")
    assert [note for note in ViewedRun(run, changes=other).notes if "not of this run" in note]
    newer = written_changes(tmp_path / "newer", tmp_path / "older", run.path)
    with pytest.raises(ConfigError, match="newer.*older"):
        ViewedRun(run, changes=newer)
    with pytest.raises(ConfigError, match=r"changes\.json"):
        ViewedRun(run, changes=tmp_path)


def test_damaged_changes_do_not_hide_the_map(run: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(Path(shutil.copytree(run.path, tmp_path / "run")))
    written_changes(copy.path / "changes", run.path, tmp_path / "newer")
    assert len(ViewedRun(copy).changes()) == 2  # as of an updated run
    (copy.path / "changes" / "changes.json").write_text('{"changes": [{"kind": "moved"}]}')
    viewed = ViewedRun(copy)
    assert not viewed.changes() and [note for note in viewed.notes if "changes.json" in note]


def test_changes_are_stepped_through(run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    server = open_server(port=0)
    try:
        place = written_changes(tmp_path / "changes", run.path, tmp_path / "newer")
        model = ViewedRun(run, 1000, changes=place)
        tab = Page(server, model, None, "room").changes
        assert tab is not None and tab.number is None
        assert server.scene.get_handle_by_name("/camera/change") is None
        tab.show(1, None)
        removed = server.scene.get_handle_by_name("/camera/change")
        assert tab.number == 1 and removed is not None and removed.points.shape == (12, 2, 3)
        tab.step(forward=True, client=None)  # after the last the first
        moved = server.scene.get_handle_by_name("/camera/change")
        assert tab.number == 0 and moved is not None and moved.points.shape == (25, 2, 3)  # and how it went
        tab.step(forward=False, client=None)
        assert tab.number == 1
        tab.show(None, None)
        assert server.scene.get_handle_by_name("/camera/change") is None
        assert Page(server, ViewedRun(run, 1000), None, "room").changes is None
    finally:
        close_server(server)
