# SPDX-License-Identifier: Apache-2.0
"""`ggslam edit` on a small run, and what the other commands make of the result."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ggslam.cli.main import app
from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.edit.edit import Edit
from ggslam.jobs.edit.edits import edit_run
from ggslam.runs.folder import RunFolder


def ggslam(*arguments: object) -> Result:
    """The command line within this process; an error of ours is in `exception`."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def done(*arguments: object) -> str:
    result = ggslam(*arguments)
    assert result.exit_code == 0 and result.exception is None, (result.output, result.exception)
    return result.output


def one_error(result: Result, *words: str) -> None:
    """An error for people, of exit code 2, with these words."""
    assert isinstance(result.exception, GgslamError) and result.exception.exit_code == 2, result
    assert all(word in str(result.exception) for word in words), str(result.exception)


@pytest.fixture(scope="module")
def finished(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the first frames of the generated room, with objects and some scores."""
    out = Path(shutil.copytree(room_run.path, tmp_path_factory.mktemp("edited") / "room"))
    done("eval", out, "--no-lpips", "--every", 6)
    return out


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy to edit in place."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long("all edits in one command, and all commands on what comes of it")
def test_several_edits_at_once_leave_a_whole_run(finished: Path, tmp_path: Path) -> None:
    before, out = contents(finished), tmp_path / "new"
    text = done(
        "edit", finished, "--remove", "vase", "--rename", "rug", "carpet", "--move", "fruit bowl", "0.1 0 -0.2",
        "--rotate", "0 10 0", "--duplicate", "sideboard", "-0.3 0 0", "--recolor", "coffee table", "#3060c0", "--merge",
        "floor", "west wall", "--inpaint", "--out", out,
    )  # fmt: skip
    assert "removed vase" in text and "inpainted" in text and str(out) in text
    assert contents(finished) == before
    names = {record.name for record in RunFolder.open(out).object_table().objects}
    assert {"carpet", "sideboard copy"} <= names and not {"vase", "rug", "west wall"} & names
    expected = {"trajectory.txt", "keyframes.json", "config.yaml", "sequence.json", "timing.json", "run.json",
                "map.ply", "objects.json", "classifier.npz", "votes.npz", "points.ply", "points_grid.ply", "loops.json",
                "renders", "steps.csv", "ground_truth.txt"}  # fmt: skip
    assert {path.name for path in out.iterdir()} == expected
    marker = json.loads((out / "run.json").read_text())
    assert marker["complete"] is True and len(marker["edits"]) == 6
    assert (
        len(RunFolder.open(out).segmented_map().gaussians) == json.loads((out / "timing.json").read_text())["gaussians"]
    )
    pictures = sorted((out / "renders").glob("edit*.png"))
    image = cv2.imread(str(pictures[0]))
    assert 1 <= len(pictures) <= 4 and image.shape[0] > 240 and image.shape[1] > 480
    done("eval", out, "--no-lpips", "--every", 4)
    assert "the map was edited" in " ".join(json.loads((out / "metrics.json").read_text())["notes"])
    done("render", out, "--what", "color,ids,pca", "--frames", "3")
    assert (out / "renders" / "frame000003_ids.png").is_file()
    done("export", out, "--objects", "carpet", "--out", tmp_path / "objects")
    assert [path.name.endswith("carpet.ply") for path in (tmp_path / "objects").glob("*.ply")] == [True]


def test_removal_shows_in_the_render_and_nowhere_else(finished: Path, tmp_path: Path) -> None:
    done("edit", finished, "--remove", "sofa", "--out", tmp_path / "new")
    done("render", finished, "--what", "color,ids", "--frames", "0", "--out", tmp_path / "a")
    done("render", tmp_path / "new", "--what", "color,ids", "--frames", "0", "--out", tmp_path / "b")
    a, b = (cv2.imread(str(tmp_path / name / "frame000000_color.png")).astype(int) for name in ("a", "b"))
    ids = cv2.imread(str(tmp_path / "a" / "frame000000_ids.png"))[..., ::-1]
    sofa = next(r for r in RunFolder.open(finished).object_table().objects if r.name == "sofa")
    there = (ids == sofa.color).all(2)
    around = cv2.dilate(there.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    changed = np.abs(a - b).max(2) > 4
    assert there.sum() > 100 and changed[there].mean() > 0.5
    assert changed[~around].mean() < 0.01


def test_most_of_a_map_is_removed_only_when_that_is_confirmed(finished: Path, tmp_path: Path) -> None:
    table, count = RunFolder.open(finished).object_table(), len(RunFolder.open(finished).gaussians())
    largest = sorted(table.objects, key=lambda record: -record.gaussians)
    most, total = [], 0
    for record in largest:
        most.append(str(record.id))
        total += record.gaussians
        if total > 0.7 * count:
            break
    before, out, objects = contents(finished), tmp_path / "new", ",".join(most)
    one_error(ggslam("edit", finished, "--remove", objects, "--out", out), "of the map", "--yes")
    assert not out.exists() and contents(finished) == before
    edit_run(finished, [Edit("remove", objects)], tmp_path / "asked", confirm=lambda what: f"of {count}" in what)
    with pytest.raises(ConfigError, match="`remove` 3,9,22,31,1,8,33"):
        edit_run(finished, [Edit("remove", objects)], tmp_path / "refused", confirm=lambda _: False)
    assert not (tmp_path / "refused").exists()
    done("edit", finished, "--remove", objects, "--yes", "--out", out)
    left = len(RunFolder.open(out).gaussians())
    assert left == len(RunFolder.open(tmp_path / "asked").gaussians()) < 0.5 * count


def test_in_place(run: Path) -> None:
    scored = json.loads((run / "metrics.json").read_text())
    done("edit", run, "--rename", "sofa", "couch", "--in-place")
    assert json.loads((run / "metrics.json").read_text()) == scored  # a name changes no score
    assert list((run / "renders").glob("compare*.png"))
    done("edit", run, "--remove", "couch", "--in-place")
    assert not (run / "metrics.json").exists() and not list((run / "renders").glob("compare*.png"))
    assert [edit.split(":")[0] for edit in json.loads((run / "run.json").read_text())["edits"]][0].startswith("renamed")
    assert [path.name for path in run.iterdir() if path.name.startswith(".")] == []
    assert "couch" not in {record.name for record in RunFolder.open(run).object_table().objects}


def test_a_disk_that_fills_up_costs_nothing(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, cloud: object) -> None:
        raise RunFolderError(f"cannot write {path}: no space left")

    before = contents(run)
    monkeypatch.setattr("ggslam.runs.saving_parts.write_points_in_parts", full)
    for target in (["--in-place"], ["--out", tmp_path / "new"]):
        one_error(ggslam("edit", run, "--remove", "sofa", *target), "no space left")
    assert contents(run) == before and not (tmp_path / "new").exists()


class Killed(BaseException):
    """Stands for a kill that lets nothing be tidied up."""


@pytest.mark.parametrize("moves", [0, 1, 3, 7])
def test_an_edit_killed_while_files_change_places_is_finished(
    run: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    real, done_moves = Path.replace, []

    def replace(path: Path, target: Path) -> Path:
        if ".staged-" in str(path.parent.name) and target.parent == run:
            if len(done_moves) == moves:
                raise Killed
            done_moves.append(path)
        return real(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        patch.setattr(shutil, "rmtree", _only_in_place)
        with pytest.raises(Killed):
            ggslam("edit", run, "--recolor", "sofa", "red", "--in-place")
    names = {path.name for path in run.iterdir()}
    assert {"map.ply", "objects.json", "classifier.npz", "votes.npz"} <= names
    assert json.loads((run / "run.json").read_text())["complete"] is False
    done("export", run, "--objects", "sofa", "--out", run.parent / "sofa")
    marker = json.loads((run / "run.json").read_text())
    assert marker["complete"] is True and len(marker["edits"]) == 1 and "saving" not in marker
    assert not (run / "metrics.json").exists()
    assert [path.name for path in run.iterdir() if path.name.startswith(".")] == []
    RunFolder.open(run).segmented_map()


_rmtree = shutil.rmtree


def _only_in_place(path: Path, ignore_errors: bool = False) -> None:
    if not Path(path).name.startswith(".staged-"):
        _rmtree(path, ignore_errors)


def test_what_a_killed_edit_left_is_no_obstacle(run: Path, tmp_path: Path) -> None:
    out, left = tmp_path / "new", ".staged-4194304-0123abcd"  # larger than any process id
    for folder in (out, run):
        (folder / left).mkdir(parents=True)
        (folder / left / "map.ply").write_text("half")
    done("edit", run, "--rename", "sofa", "couch", "--out", out)
    done("edit", run, "--rename", "sofa", "couch", "--in-place")
    assert not (out / left).exists() and not (run / left).exists()


def test_inpainting_does_without_the_recording(run: Path, tmp_path: Path) -> None:
    record = json.loads((run / "sequence.json").read_text())
    record["open"]["path"] = str(tmp_path / "gone")
    (run / "sequence.json").write_text(json.dumps(record))
    text = done("edit", run, "--remove", "vase", "--inpaint", "--in-place")
    assert "inpainted without the recording" in text and "gone" in text


def test_wrong_input_is_named_and_changes_nothing(run: Path, tmp_path: Path) -> None:
    before, new = contents(run), tmp_path / "new"
    for words, fault in [
        (["--remove", "999"], "999"),
        (["--remove", "sofaa"], "did you mean sofa"),
        (["--rename", "rug", "sofa"], "has it already"),
        (["--merge", "sofa", "sofa"], "itself"),
        (["--move", "sofa", "1 2"], "three numbers"),
        (["--move", "sofa", "1 2 nan"], "finite"),
        (["--move", "sofa", "1 2 3", "--rotate", "x"], "--rotate"),
        (["--rotate", "1 2 3"], "--rotate"),
        (["--recolor", "sofa", "blurple"], "blurple"),
        (["--remove"], "expected 1 value, found 0"),
        (["--merge", "sofa"], "expected 2 values, found 1"),
        (["--inpaint"], "no edit"),
        (["--remove", "sofa", "--remove", "sofa"], "earlier edit"),
        (["--move", "sofa", "1e6 0 0"], "1000 m"),
        (["--move", "sofa", "1e300 0 0"], "--move"),
        (["--duplicate", "sofa", "0 0 1e300"], "--duplicate"),
        (["--remove", "sofa", "--sequence", tmp_path], "--inpaint"),
        (["--remove", "sofa", "--inpaint", "--sequence", tmp_path / "none"], "none"),
    ]:
        one_error(ggslam("edit", run, *words, "--out", new), fault)
    assert not new.exists() and contents(run) == before
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", run), "--in-place")
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", run / "inner"), "within the run")
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", new, "--in-place"), "contradict")
    one_error(ggslam("edit", tmp_path / "nowhere", "--remove", "sofa"), "nowhere")
    other = Path(shutil.copytree(run, tmp_path / "other"))
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", other), "--overwrite")
    (run / "objects.json").unlink()
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", new), "objects.json: is missing")
    done("verify", run, "--accept")
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", new), "no objects")
    assert not new.exists() and contents(other) == before


@pytest.mark.parametrize(
    ("name", "content"),
    [("keyframes.json", "{}"), ("keyframes.json", '{"keyframes": [], "frames": []}'), ("sequence.json", "{}"),
     ("timing.json", "[]"), ("run.json", "[]"), ("run.json", '{"displaced": {"1": [1]}}'),
     ("objects.json", "[" * 100000 + "]" * 100000)],
)  # fmt: skip
def test_a_damaged_file_is_named_before_the_work(run: Path, tmp_path: Path, name: str, content: str) -> None:
    (run / name).write_text(content)
    one_error(ggslam("edit", run, "--remove", "sofa", "--out", tmp_path / "new"), str(run / name))
    assert not (tmp_path / "new").exists()


def test_objects_that_the_map_lacks_are_refused(run: Path, tmp_path: Path) -> None:
    table = json.loads((run / "objects.json").read_text())
    table["objects"].append({**table["objects"][0], "id": 4242, "name": "ghost"})
    (run / "objects.json").write_text(json.dumps(table))
    done("verify", run, "--accept")
    for words in (["edit", run, "--remove", "ghost"], ["export", run, "--objects", "ghost"]):
        one_error(ggslam(*words, "--out", tmp_path / "new"), "map.ply", "object 4242")


def test_where_the_recording_was_moved_to_is_remembered(run: Path, room: Path, tmp_path: Path) -> None:
    record = json.loads((run / "sequence.json").read_text())
    record["open"]["path"] = str(tmp_path / "gone")
    (run / "sequence.json").write_text(json.dumps(record))
    text = done("edit", run, "--rename", "sofa", "couch", "--inpaint", "--sequence", room, "--in-place")
    assert "without the recording" not in text
    assert json.loads((run / "sequence.json").read_text())["open"]["path"] == str(room.absolute())


def test_what_an_earlier_edit_placed_leaves_no_hole(run: Path) -> None:
    done("edit", run, "--move", "sofa", "0 0.5 -0.5", "--in-place")
    text = done("edit", run, "--remove", "sofa", "--inpaint", "--in-place")
    assert "nothing to inpaint" in text
    assert json.loads((run / "run.json").read_text())["displaced"] == {}


def test_help_has_an_example() -> None:
    text = done("edit", "--help")
    assert "Examples" in text and "--inpaint" in text and "DX DY DZ" in text
