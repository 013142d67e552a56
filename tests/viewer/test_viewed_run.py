# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.jobs.edit.edit import Edit
from ggslam.jobs.edit.edits import edit_run
from ggslam.jobs.view.page_actions import PageActions
from ggslam.jobs.view.run_page import RunPage
from ggslam.jobs.view.serve import serve_run, write_page
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.objects.editing import remove_objects
from ggslam.objects.segmented_rows import keep_rows
from ggslam.runs.folder import RunFolder
from ggslam.runs.writing import OBJECT_FILES, write_objects
from ggslam.scene.poses import quaternion_to_matrix


@pytest.fixture
def viewed(run: RunFolder) -> ViewedRun:
    return ViewedRun(run)


def moved_objects(ids: list[int], T: np.ndarray) -> dict[str, Any]:
    """What a page asks for when objects were moved."""
    selection = [{"mode": "set", "shape": {"kind": "objects", "ids": ids}}]
    return {"kind": "move", "selection": selection, "T": T.ravel().tolist()}


def some_object(viewed: ViewedRun) -> int:
    """One of middle size."""
    return sorted(viewed.objects(), key=lambda record: record.gaussians)[len(viewed.objects()) // 2].id


def means_of(viewed: ViewedRun, object_id: int) -> np.ndarray:
    """Centres of an object's Gaussians, float64 [N, 3]."""
    g = viewed.gaussians()
    return g.means.numpy()[g.object_id.numpy() == object_id].astype(float)


def test_edits_are_saved_as_the_command_would(viewed: ViewedRun, tmp_path: Path) -> None:
    before = (viewed.folder.path / "map.ply").read_bytes()
    ids = [record.id for record in viewed.objects()]
    record = viewed.objects()[1]
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([0.9, 0.1, -0.3, 0.2]))
    T[:3, 3] = record.centroid - T[:3, :3] @ record.centroid + [0.1, -0.05, 0.2]
    viewed.edit(Edit("remove", str(ids[0])))
    home = means_of(viewed, ids[1])
    PageActions(viewed).edit(moved_objects([ids[1]], T))
    viewed.edit(Edit("rename", str(ids[2]), "thing"))
    assert len(viewed.edits()) == 3 and ids[0] not in [r.id for r in viewed.objects()]
    moved = cKDTree(home @ T[:3, :3].T + T[:3, 3]).query(means_of(viewed, ids[1]))[0]
    assert np.mean(moved < 1e-4) > 0.98  # as the page showed it; some had another label before
    viewed.save("saved-from-a-page", inpaint=False)
    edits = [*viewed._edits]
    assert edits[0] == Edit("remove", str(ids[0])) and edits[1].rotation
    expected = edit_run(viewed.folder, edits, tmp_path / "expected").folder
    saved = RunFolder.open(viewed.folder.path.resolve().parent / "saved-from-a-page")
    assert (saved.path / "map.ply").read_bytes() == (expected.path / "map.ply").read_bytes()
    assert saved.object_table().record(ids[2]).name == "thing"
    assert (viewed.folder.path / "map.ply").read_bytes() == before


def test_a_move_is_that_of_the_handles(viewed: ViewedRun) -> None:
    one = some_object(viewed)
    record = next(r for r in viewed.objects() if r.id == one)
    owners = viewed.gaussians().object_id.numpy()
    before = viewed.gaussians().means.numpy()[owners == one].copy()
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([0.8, 0.3, 0.4, -0.2]))
    T[:3, 3] = record.centroid - T[:3, :3] @ record.centroid + [0.3, 0.0, -0.1]
    PageActions(viewed).edit(moved_objects([one], T))
    after = viewed.gaussians().means.numpy()[viewed.gaussians().object_id.numpy() == one]
    expected = before @ T[:3, :3].T + T[:3, 3]
    distance = np.linalg.norm(expected[:, None] - after[None], axis=2).min(axis=1)
    assert np.mean(distance < 0.02) > 0.9  # floaters stay where they are


def test_edits_can_be_taken_back(viewed: ViewedRun) -> None:
    count = len(viewed.objects())
    with pytest.raises(ConfigError, match="no edit"):
        viewed.undo()
    with pytest.raises(ConfigError, match="nothing was edited"):
        viewed.save("anywhere", inpaint=False)
    viewed.edit(Edit("rename", str(viewed.objects()[0].id), "first"))
    viewed.edit(Edit("remove", str(some_object(viewed))))
    viewed.undo()
    assert len(viewed.objects()) == count and viewed.objects()[0].name == "first" and len(viewed.edits()) == 1
    with pytest.raises(ConfigError):
        viewed.edit(Edit("rename", str(viewed.objects()[0].id), "all"))
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
    model.edit(Edit("rename", str(some_object(model)), "thing"))


STRAY_NAMES = ["", "..", "/tmp/elsewhere", "../elsewhere", "~nobody/x", "a\x00b", "a\x1b[2J", "x" * 300]


@pytest.mark.parametrize("target", STRAY_NAMES)
def test_a_page_saves_in_one_folder_only(viewed: ViewedRun, target: str) -> None:
    viewed.edit(Edit("rename", str(some_object(viewed)), "thing"))
    with pytest.raises(ConfigError, match=f"{viewed.save_folder()}"):
        viewed.save(target, inpaint=False)


def test_names_of_objects_have_an_end(viewed: ViewedRun) -> None:
    with pytest.raises(ConfigError, match="201.*200"):
        viewed.edit(Edit("rename", str(some_object(viewed)), "x" * 201))


def test_a_run_all_of_whose_gaussians_were_removed_is_shown(run: RunFolder, tmp_path: Path) -> None:
    empty = RunFolder(Path(shutil.copytree(run.path, tmp_path / "empty")))
    scene = run.segmented_map()
    remove_objects(scene, scene.table.ids())
    keep_rows(scene, np.zeros(len(scene.gaussians), bool))
    with empty.change_files("map.ply", *OBJECT_FILES):
        write_objects(empty.path, scene)
    server, model = serve_run(empty, port=0)
    server.close()
    assert model.describe().startswith("0 Gaussians") and not model.objects() and not len(model.shown_rows())
    assert RunPage(model, "empty").scene()["objects"] == []
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
