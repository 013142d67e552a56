# SPDX-License-Identifier: Apache-2.0
"""A run's folder says which files are its own; what is mixed, damaged or incomplete is refused or said aloud."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_line import ggslam, refuse, succeed

from ggslam.errors import RunFolderError
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs import publishing
from ggslam.runs.folder import RunFolder
from ggslam.runs.manifest import names_in
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.verification import verify_run
from ggslam.system import staging

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "identity.final_passes=0"]


@pytest.fixture
def run(room_run: RunFolder, tmp_path: Path) -> Path:
    """A copy of a run, to be spoilt."""
    return Path(shutil.copytree(room_run.path, tmp_path / "run"))


def test_everything_is_in_the_manifest(room_run: RunFolder) -> None:
    files = room_run.mark().files
    assert files is not None and sorted(files) == names_in(room_run.path)
    assert {"map.ply", "trajectory.txt", "points.ply", "config.yaml", "report.html"} <= set(files)
    assert "all files match the manifest" in succeed("verify", room_run.path)
    assert room_run.mark().complete and room_run.mark().missing == []


@pytest.mark.parametrize("name", ["map.ply", "trajectory.txt", "keyframes.json", "objects.json", "votes.npz"])
def test_a_file_of_another_run_is_refused(run: Path, name: str, room: Path) -> None:
    with (run / name).open("ab") as file:
        file.write(b"\n")
    new = run.parent / "new"
    for words in (["export", run, "--format", "trajectory", "--out", new], ["eval", run], ["report", run],
                  ["view", run, "--html", new], ["render", run], ["run", room, "--map", run, "--out", new],
                  ["encode", run, new]):  # fmt: skip
        refuse(ggslam(*words), f"{run / name}: expected", "bytes, found", "`ggslam verify`")
    done = ggslam("verify", run)
    assert done.returncode == 2 and f"{name}: expected" in done.stdout
    assert f"{name}: changed, damaged or missing" in done.stdout


def test_content_is_checked_by_verify(run: Path) -> None:
    data = bytearray((run / "map.ply").read_bytes())
    data[-1] ^= 1
    (run / "map.ply").write_bytes(data)
    done = ggslam("verify", run)
    assert done.returncode == 2 and "map.ply: checksum" in done.stdout
    assert "all files match the manifest" in succeed("verify", run, "--accept")
    RunFolder.open(run)


def test_what_a_run_can_do_without_is_only_said(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    (run / "points.ply").unlink()
    (run / "config.yaml").write_text((run / "config.yaml").read_text() + "\n")
    (run / "mine.txt").write_text("x")
    RunFolder.open(run)
    said = " ".join(caplog.messages)
    assert "points.ply: is missing" in said and "config.yaml: expected" in said and "mine.txt" not in said
    done = ggslam("verify", run)
    assert done.returncode == 2 and "mine.txt: not in the manifest" in done.stdout


def test_a_map_that_came_later_is_refused(run: Path) -> None:
    mark = json.loads((run / "run.json").read_text())
    del mark["files"]["votes.npz"]
    (run / "run.json").write_text(json.dumps(mark))
    with pytest.raises(RunFolderError, match=r"votes\.npz: .*manifest"):
        RunFolder.open(run)


def test_names_outside_the_folder_are_refused(run: Path) -> None:
    (run.parent / "secret").write_text("x")
    mark = json.loads((run / "run.json").read_text())
    for name in ("../secret", "/etc/passwd", "a//b", "./run.json"):
        mark["files"] = {name: {"bytes": 1, "sha256": ""}}
        (run / "run.json").write_text(json.dumps(mark))
        with pytest.raises(RunFolderError, match="no name of a file in the folder"):
            RunFolder.open(run)


def test_runs_of_before_there_was_a_manifest(run: Path, room: Path) -> None:
    mark = json.loads((run / "run.json").read_text())
    del mark["files"], mark["missing"]
    (run / "run.json").write_text(json.dumps(mark))
    assert "no manifest" in succeed("verify", run)
    succeed("eval", run, "--no-lpips", "--every", 6)
    assert "files" not in json.loads((run / "run.json").read_text())


def test_what_is_written_later_joins(run: Path) -> None:
    succeed("eval", run, "--no-lpips", "--every", 6)
    succeed("report", run, "--plots", run / "plots")
    succeed("render", run, "--frames", "0", "--what", "depth")
    files = RunFolder.open(run).mark().files
    assert files is not None and {"metrics.json", "frames.csv", "report.html"} <= set(files)
    assert "renders/frame000000_depth.png" in files and any(name.startswith("plots/") for name in files)
    assert verify_run(run).good
    succeed("edit", run, "--rename", "sofa", "couch", "--in-place")
    assert verify_run(run).good
    succeed("edit", run, "--remove", "couch", "--in-place")
    found = verify_run(run)
    assert found.good and found.others == [] and "metrics.json" not in (found.mark.files or {})


def test_an_interrupted_change_is_told(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(KeyboardInterrupt), RunFolder(run).change_files("metrics.json", "renders"):
        mark = RunFolder(run).mark()
        assert "metrics.json" not in (mark.files or {})
        (run / "metrics.json").write_text("{}")
        shutil.copytree(run, run.parent / "killed")
        raise KeyboardInterrupt
    assert "metrics.json" in (RunFolder.open(run).mark().files or {})
    RunFolder.open(run.parent / "killed")
    assert any("metrics.json: is not in the manifest" in text for text in caplog.messages)


class Killed(BaseException):
    """Stands for a kill that lets nothing be tidied up."""


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names_in(folder)}


@pytest.mark.parametrize("moment", ["writing", 0, 1, 4, 9])
def test_a_kill_during_overwrite_leaves_one_run(
    run: Path, room: Path, monkeypatch: pytest.MonkeyPatch, moment: str | int
) -> None:
    """The old run until all of the new one is on the disk, then the new one; never parts of both."""
    before, moves, real = contents(run), [], Path.replace

    def replace(path: Path, target: Path) -> Path:
        if path.parent.name.startswith(".staged-") and target.parent == run:
            if len(moves) == moment:
                raise Killed
            moves.append(path)
        return real(path, target)

    def no_sync(folder: Path) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        if moment == "writing":
            patch.setattr(publishing, "sync_all", no_sync)
        patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises(Killed):
            few = RunRequest(SequenceRequest(room, stop=3), run, overrides=FEW, evaluate=False, overwrite=True)
            execute(few)
    if moment == "writing":
        assert contents(run) == before
        assert len(RunFolder.open(run).trajectory()) == 10
        return
    copy = Path(shutil.copytree(run, run.parent / "copy"))  # as a backup of this moment would be
    for folder in (run, copy):
        succeed("export", folder, "--format", "trajectory", "--out", run.parent / "t.txt")
        assert len(RunFolder.open(folder).trajectory()) == 3
        mark = RunFolder.open(folder).mark()
        assert not mark.complete and mark.missing == ["report.html"]  # it was killed before that
        assert not (folder / "metrics.json").exists() and not verify_run(folder).problems


def test_files_that_were_to_change_places_are_gone(run: Path) -> None:
    mark: dict[str, Any] = json.loads((run / "run.json").read_text())
    mark["saving"] = {"from": ".staged-1-01234567", "stale": []}
    (run / "run.json").write_text(json.dumps(mark))
    with pytest.raises(RunFolderError, match="saving was interrupted, and what was to be put into place is gone"):
        RunFolder.open(run)
    assert staging.is_being_saved(run, "run.json")
