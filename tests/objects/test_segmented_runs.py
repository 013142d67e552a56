# SPDX-License-Identifier: Apache-2.0
"""A run folder with objects: saved, loaded, exported, rendered and scored."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

from ggslam.cli.main import app
from ggslam.errors import ConfigError, FormatError, GgslamError, RunFolderError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.mapping.keyframe import make_keyframe
from ggslam.mapping.mapper import MapperTimes
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe
from ggslam.runs.writing import OBJECT_FILES, write_objects
from ggslam.scene.identity import IdentityClassifier
from ggslam.scene.object_names import object_file_name
from ggslam.scene.poses import inverse
from ggslam.sequences import Sequence
from ggslam.slam.config import Config
from ggslam.slam.result import SlamResult, SlamTimes, TrackedFrame


def votes_for(labels: np.ndarray) -> ObjectVotes:
    """Heavy votes for the labels in the second slot, light ones for id 60000 in the first."""
    ids, weights = np.zeros((len(labels), 4), np.uint16), np.zeros((len(labels), 4), np.float32)
    ids[:, 0], weights[:, 0] = 60000, 0.5
    ids[:, 1], weights[:, 1] = labels, 2
    return ObjectVotes(ids, weights)


def result_of(room: Any) -> SlamResult:
    """A run that tracked the recording perfectly, with the room's frames as keyframes."""
    keyframes = [make_keyframe(i, frame, frame.T_world_camera) for i, frame in enumerate(room.frames)]
    numbers, truth = [frame.index for frame in room.frames], room.sequence.ground_truth
    frames = []
    for i, T in enumerate(truth):
        k = int(np.searchsorted(numbers, i, side="right")) - 1
        T_keyframe_camera = inverse(truth[numbers[k]]) @ T
        frames.append(TrackedFrame(i, i, float(room.sequence.timestamps[i]), k, T_keyframe_camera, 1.0, 0.001, "ok"))
    times = MapperTimes(iterations=1, keyframes=len(keyframes))
    return SlamResult(room.gaussians, keyframes, frames, SlamTimes(wall=1.0), times)


def save_objects(folder: RunFolder, segmented: SegmentedMap) -> None:
    with folder.change_files("map.ply", *OBJECT_FILES):
        write_objects(folder.path, segmented)


def write_run(room: Any, path: Path, supervision: Any = "masks", objects: bool = True, votes: bool = True) -> RunFolder:
    folder = RunFolder.create(path)
    request = SequenceRequest(room.sequence.path)
    folder.save(Config(), describe(request, room.sequence), result_of(room))
    if objects:
        table = ObjectTable.build(room.gaussians, room.classifier, supervision, room.sequence.instance_names)
        labels = room.gaussians.object_id.numpy().astype(np.uint16)
        save_objects(folder, SegmentedMap(room.gaussians, room.classifier, table, votes_for(labels) if votes else None))
    return folder


@pytest.fixture(scope="module")
def saved(shared_segmented_room: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of the room's run with objects and without, not to be changed."""
    room, runs = shared_segmented_room, tmp_path_factory.mktemp("runs")
    return {name: write_run(room, runs / name, objects=name == "run").path for name in ("run", "plain")}


@pytest.fixture
def run(saved: dict[str, Path], tmp_path: Path) -> RunFolder:
    """A run to be changed."""
    return RunFolder.open(shutil.copytree(saved["run"], tmp_path / "run"))


@pytest.fixture
def plain_run(saved: dict[str, Path], tmp_path: Path) -> RunFolder:
    """The same without objects."""
    return RunFolder.open(shutil.copytree(saved["plain"], tmp_path / "plain"))


def ggslam(*arguments: object) -> Result:
    """The command line within this process; an error of ours is in `exception`."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def done(*arguments: object) -> str:
    result = ggslam(*arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    return " ".join(result.output.split())


def refused(*arguments: object) -> GgslamError:
    error = ggslam(*arguments).exception
    assert isinstance(error, GgslamError), error
    return error


# --- the folder ------------------------------------------------------------------------------------------------------


def test_what_is_saved_is_loaded(run: RunFolder, shared_segmented_room: Any) -> None:
    segmented, room = run.segmented_map(), shared_segmented_room
    assert torch.equal(segmented.gaussians.object_id, room.gaussians.object_id)
    assert torch.equal(segmented.gaussians.features, room.gaussians.features)
    assert (segmented.classifier.class_ids == room.classifier.class_ids).all()
    assert segmented.table.ids() == room.classifier.class_ids.tolist()
    assert segmented.votes is not None and (segmented.votes.labels() == room.gaussians.object_id.numpy()).all()
    assert len(run.gaussians()) == len(room.gaussians)
    assert [p.name for p in run.path.iterdir() if p.name.startswith(".")] == []


def test_a_run_without_objects_says_so(plain_run: RunFolder) -> None:
    assert not plain_run.has_objects() and plain_run.votes() is None
    assert len(plain_run.gaussians()) > 0
    with pytest.raises(RunFolderError, match="plain"):
        plain_run.segmented_map()


def test_objects_of_an_earlier_run_do_not_stay(run: RunFolder, shared_segmented_room: Any) -> None:
    recording = run.sequence()
    again = RunFolder.create(run.path, overwrite=True)
    again.save(Config(), recording, result_of(shared_segmented_room))
    assert not again.has_objects() and not (run.path / "classifier.npz").exists() and again.votes() is None


def test_votes_of_an_earlier_save_do_not_stay(run: RunFolder) -> None:
    segmented = run.segmented_map()
    segmented.votes = None
    save_objects(run, segmented)
    assert run.segmented_map().votes is None


def test_a_save_that_fails_leaves_a_map_without_objects(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise RunFolderError("cannot write: No space left on device")

    segmented = run.segmented_map()
    monkeypatch.setattr("ggslam.runs.writing.write_bytes", full)
    with pytest.raises(RunFolderError, match="No space"):
        save_objects(run, segmented)
    assert not run.has_objects() and len(run.gaussians()) == len(segmented.gaussians)


def test_files_that_do_not_belong_together(run: RunFolder) -> None:
    rest = votes_for(np.ones(5, np.uint16))
    (run.path / "votes.npz").write_bytes(rest.to_bytes())
    with pytest.raises(RunFolderError, match=r"votes\.npz.* 5$"):
        run.segmented_map()
    (run.path / "votes.npz").write_bytes(b"PK\x03\x04 nonsense")
    with pytest.raises(FormatError, match="votes.npz"):
        run.segmented_map()
    (run.path / "votes.npz").unlink()
    (run.path / "classifier.npz").write_bytes(IdentityClassifier.empty(8).to_bytes())
    with pytest.raises(RunFolderError, match=r"map\.ply.* 8 .*identity_\*.*16"):
        run.segmented_map()
    (run.path / "classifier.npz").unlink()
    with pytest.raises(FormatError, match="classifier.npz"):
        run.segmented_map()


def test_votes_of_the_map_itself(segmented_room: Any) -> None:
    gaussians = segmented_room.gaussians
    gaussians.vote_ids[:, 2], gaussians.vote_weights[:, 2] = 65535, 1.5
    votes = ObjectVotes.of(gaussians)
    gaussians.vote_ids[:] = 0  # a copy
    assert votes.ids.dtype == np.uint16 and (votes.labels() == 65535).all()


# --- export ----------------------------------------------------------------------------------------------------------


def test_export_of_single_objects(run: RunFolder, tmp_path: Path) -> None:
    table, out = run.object_table(), tmp_path / "parts"
    first, second = table.objects[0], table.objects[3]
    message = done("export", run.path, "--objects", f"{first.name},{second.id}", "--out", out)
    assert "2 objects" in message
    names = {object_file_name(first.id, first.name), object_file_name(second.id, second.name)}
    assert {p.name for p in out.iterdir()} == {*names, "objects.json", "map_classifier.npz"}
    part = read_gaussian_ply(out / object_file_name(second.id, second.name))
    assert len(part) == second.gaussians and (part.object_id == second.id).all()
    whole = run.gaussians()
    rows = whole.object_id == second.id
    assert torch.equal(part.means, whole.means[rows]) and torch.equal(part.sh, whole.sh[rows])
    assert torch.equal(part.features, whole.features[rows])
    assert ObjectTable.load(out / "objects.json").objects == [first, second]
    assert len(IdentityClassifier.from_file(out / "map_classifier.npz")) == len(table)


def test_export_of_one_object_to_a_file(run: RunFolder, tmp_path: Path) -> None:
    (first, second), out = run.object_table().objects[:2], tmp_path / "out"
    message = done("export", run.path, "--objects", first.id, "--out", out / "one.ply")
    assert first.label() in message and f"{first.gaussians} Gaussians" in message
    assert (read_gaussian_ply(out / "one.ply").object_id == first.id).all()
    assert {p.name for p in out.iterdir()} == {"one.ply", "one_classifier.npz"}
    several = f"{first.id},{second.id}"
    assert "name a folder" in str(refused("export", run.path, "--objects", several, "--out", out / "two.ply"))
    assert not (out / "two.ply").exists()


def test_export_of_all_objects_plain(run: RunFolder, tmp_path: Path) -> None:
    done("export", run.path, "--objects", "all", "--plain", "--min-opacity", 0.5, "--out", tmp_path / "parts")
    plys = list((tmp_path / "parts").glob("*.ply"))
    assert len(plys) == len(run.object_table()) and not (tmp_path / "parts" / "map_classifier.npz").exists()
    part = read_gaussian_ply(plys[0])
    assert part.features.shape[1] == 0 and not part.object_id.any()


def test_export_in_the_colours_of_the_objects(run: RunFolder, tmp_path: Path) -> None:
    done("export", run.path, "--format", "segmented", "--out", tmp_path / "all.ply")
    colored, whole, palette = read_gaussian_ply(tmp_path / "all.ply"), run.gaussians(), run.object_table().palette()
    assert (tmp_path / "all_classifier.npz").is_file()
    assert torch.equal(colored.log_scales, whole.log_scales) and torch.equal(colored.means, whole.means)
    assert torch.equal(colored.opacity_logits, whole.opacity_logits)
    assert np.abs(255 * colored.rgb.numpy() - palette[whole.object_id.numpy()]).max() < 0.01
    chosen = run.object_table().objects[2]
    one = tmp_path / "one.ply"
    said = done("export", run.path, "--format", "segmented", "--objects", chosen.id, "--plain", "--out", one)
    assert said.strip().endswith("in the colours of 1 object")
    assert len(read_gaussian_ply(one)) == chosen.gaussians and not (tmp_path / "one_classifier.npz").exists()


def test_export_of_the_whole_map(run: RunFolder, plain_run: RunFolder, tmp_path: Path) -> None:
    assert "identities" in done("export", run.path, "--out", tmp_path / "map.ply")
    assert read_gaussian_ply(tmp_path / "map.ply").features.shape[1] == 16
    assert (tmp_path / "map_classifier.npz").is_file()
    done("export", run.path, "--plain", "--out", tmp_path / "plain.ply")
    done("export", plain_run.path, "--out", tmp_path / "none.ply")
    for name in ("plain", "none"):
        assert read_gaussian_ply(tmp_path / f"{name}.ply").features.shape[1] == 0
        assert not (tmp_path / f"{name}_classifier.npz").exists()


def test_exports_that_cannot_be(run: RunFolder, plain_run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "out"
    wrong_name = refused("export", run.path, "--objects", "unicorn", "--out", out)
    assert isinstance(wrong_name, ConfigError) and "unicorn" in str(wrong_name)
    assert "no objects" in str(refused("export", plain_run.path, "--objects", "1", "--out", out))
    assert "no objects" in str(refused("export", plain_run.path, "--format", "segmented", "--out", out))
    assert "not points" in str(refused("export", run.path, "--objects", "1", "--format", "points", "--out", out))
    assert not out.exists()


def test_file_names_are_safe(run: RunFolder) -> None:
    record = run.object_table().objects[0]
    names = {"../../etc/passwd": "etc_passwd", "tasse à café": "tasse_caf", None: "", "..": "", "a" * 300: "a" * 64}
    for name, safe in names.items():
        record = type(record)(**{**vars(record), "name": name})
        assert object_file_name(record.id, record.name) == (f"{record.id}_{safe}.ply" if safe else f"{record.id}.ply")


# --- pictures --------------------------------------------------------------------------------------------------------


def test_rendered_ids_and_identities(run: RunFolder, shared_segmented_room: Any, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    done("render", run.path, "--what", "color,ids,pca", "--frames", "0,4,8", "--out", out)
    names = {f"frame{i:06d}_{kind}.png" for i in (0, 4, 8) for kind in ("color", "ids", "pca")}
    assert {p.name for p in out.iterdir()} == {*names, "legend.png"}
    ids = cv2.imread(str(out / "frame000008_ids.png"))[..., ::-1]
    truth = run.object_table().palette()[shared_segmented_room.frames[1].mask]
    assert (ids == truth).all(-1).mean() > 0.8  # outlines and rims aside
    a, b = (cv2.imread(str(out / f"frame{i:06d}_pca.png")).reshape(-1, 3).astype(int) for i in (0, 4))
    masks = [shared_segmented_room.sequence.frame(i).mask.reshape(-1) for i in (0, 4)]
    largest = np.bincount(masks[0][masks[0] > 0]).argmax()
    colors = [np.median(picture[mask == largest], 0) for picture, mask in zip((a, b), masks, strict=True)]
    assert np.abs(colors[0] - colors[1]).max() < 12  # an object looks the same in every frame
    assert len(np.unique(a // 16, axis=0)) > 10


def test_a_classifier_without_classes_leaves_the_labels_of_the_gaussians(run: RunFolder, tmp_path: Path) -> None:
    segmented = run.segmented_map()
    done("render", run.path, "--what", "ids", "--frames", "8", "--out", tmp_path / "learned")
    segmented.classifier = IdentityClassifier.empty()
    save_objects(run, segmented)
    done("render", run.path, "--what", "ids", "--frames", "8", "--out", tmp_path / "voted")
    learned, voted = (cv2.imread(str(tmp_path / name / "frame000008_ids.png")) for name in ("learned", "voted"))
    assert (learned == voted).all(-1).mean() > 0.9


def test_pictures_of_objects_need_objects(plain_run: RunFolder, tmp_path: Path) -> None:
    assert "no objects" in str(refused("render", plain_run.path, "--what", "color,ids", "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


# --- scores ----------------------------------------------------------------------------------------------------------


def scores_of(run: RunFolder, *options: object) -> tuple[dict[str, Any], str, str]:
    """The segmentation scores, the notes about objects, and what was printed."""
    printed = done("eval", run.path, "--no-lpips", *options)
    metrics = json.loads((run.path / "metrics.json").read_text())
    return metrics["segmentation"], " ".join(n for n in metrics["notes"] if "object" in n), printed


def test_scores_of_a_map_with_true_labels(run: RunFolder) -> None:
    s, notes, printed = scores_of(run)
    assert s["matching"] == "same" and s["supervision"] == "masks" and "masks that supervised the map" in notes
    assert (s["keyframes"]["frames"], s["held_out"]["frames"], s["all"]["frames"]) == (3, 3, 24)
    assert s["keyframes"]["miou"] > 0.8 and s["keyframes"]["accuracy"] > 0.92 and s["held_out"]["accuracy"] > 0.9
    assert 0.3 < s["keyframes"]["boundary_miou"] <= s["keyframes"]["miou"]
    assert abs(s["all"]["votes_miou"] - s["all"]["miou"]) < 0.1  # the same labels
    assert s["all"]["objects"] == len(s["per_object"]) > 10
    assert all(o["name"] and o["matched"] in (int(i), 0) for i, o in s["per_object"].items())
    g = s["gaussians"]
    assert g["accuracy"] > 0.95 and g["accuracy_by_opacity"] > 0.95 and g["votes_accuracy"] == g["accuracy"]
    assert 0.5 * g["gaussians"] < g["labelled"] <= g["gaussians"]
    assert "mIoU" in printed and "lowest IoU" in printed and "labelled right" in printed
    pictures = sorted((run.path / "renders").glob("compare*.png"))
    assert len(pictures) == 6
    assert cv2.imread(str(pictures[0])).shape == (3 * 120 + 2 * 4, 3 * 160 + 2 * 4, 3)


def test_renamed_objects_are_matched(run: RunFolder) -> None:
    before = scores_of(run, "--every", 4)[0]
    segmented = run.segmented_map()
    other = np.append(np.uint16(0), np.random.default_rng(0).permutation(np.arange(1, 65536)).astype(np.uint16))
    ids = other[segmented.gaussians.object_id.numpy()]
    segmented.gaussians.object_id[:] = torch.from_numpy(ids.astype(np.int32))
    segmented.classifier.class_ids = other[segmented.classifier.class_ids]
    segmented.table = ObjectTable.build(segmented.gaussians, segmented.classifier, "geometry")
    segmented.votes = None
    save_objects(run, segmented)
    after, notes, _ = scores_of(run, "--every", 4)
    assert after["matching"] == "assignment" and "did not supervise" in notes
    assert after["all"]["miou"] == pytest.approx(before["all"]["miou"])
    assert after["gaussians"]["accuracy"] == pytest.approx(before["gaussians"]["accuracy"])
    row = cv2.imread(str(sorted((run.path / "renders").glob("compare*.png"))[0]))[-120:]
    true_ids, rendered_ids = row[:, :160], row[:, 164:324]
    assert (true_ids == rendered_ids).all(-1).mean() > 0.8  # matched objects have the same colour
    assert after["all"]["votes_miou"] is None and after["gaussians"]["votes_accuracy"] is None


def copied_masks(sequence: Sequence, to: Path, keep: int = 24) -> Path:
    shutil.copytree(sequence.path / "masks", to)
    for path in sorted(to.iterdir())[keep:]:
        path.unlink()
    return to


def test_masks_from_elsewhere_are_the_truth(run: RunFolder, shared_segmented_room: Any, tmp_path: Path) -> None:
    folder = copied_masks(shared_segmented_room.sequence, tmp_path / "truth", keep=10)
    wrong = np.full((120, 160), 3, np.uint16)
    for number in (0, 8):
        cv2.imwrite(str(folder / f"{number:06d}.png"), wrong)
    cv2.imwrite(str(folder / "000004.png"), np.zeros_like(wrong))
    s, notes, _ = scores_of(run, "--masks", folder, "--every", 2)
    assert str(folder) in notes and "supervised" not in notes
    assert s["all"]["frames"] == 5  # 0, 2, 4, 6, 8: frames without a mask are in no score
    assert s["keyframes"]["frames"] == 2 and s["keyframes"]["objects"] == 1 and s["keyframes"]["accuracy"] < 0.5
    assert s["held_out"]["frames"] == 1 and s["held_out"]["objects"] == 0 and s["held_out"]["miou"] is None


def test_runs_and_recordings_that_lack_something(
    run: RunFolder, plain_run: RunFolder, shared_segmented_room: Any, tmp_path: Path
) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(shared_segmented_room.sequence.path, bare)
    shutil.rmtree(bare / "masks")
    s, notes, printed = scores_of(run, "--sequence", bare, "--every", 4)
    assert s is None and "no masks" in notes and "mIoU" not in printed
    assert cv2.imread(str(next((run.path / "renders").glob("compare*.png")))).shape[0] == 3 * 120 + 2 * 4
    s, notes, _ = scores_of(plain_run, "--every", 4)
    assert s is None and notes == ""
    truth = copied_masks(shared_segmented_room.sequence, tmp_path / "truth")
    assert "no objects" in scores_of(plain_run, "--every", 4, "--masks", truth)[1]
    assert "nowhere" in str(refused("eval", run.path, "--masks", tmp_path / "nowhere"))
