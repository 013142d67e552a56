# SPDX-License-Identifier: Apache-2.0
"""The command line as people use it, on a small generated recording."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
import torch
from command_line import ggslam, refuse
from kept import points_in_voxels_of

from ggslam.cli import main
from ggslam.cli.run_command import _print
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.point_ply import read_points
from ggslam.formats.trajectory import read_tum
from ggslam.jobs.run.pipeline import RunOutcome
from ggslam.runs.folder import RunFolder


def in_a_process(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ggslam.cli.main", *map(str, arguments)]
    # Not in the checkout, whose package has no compiled core: the installed one is to be tested.
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tempfile.gettempdir())


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is written where the tests were started."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def finished(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the generated room."""
    out = tmp_path_factory.mktemp("runs") / "room"
    with points_in_voxels_of(0.01):  # as users have it
        done = ggslam("run", room, "--scale", 0.5, "--out", out, "--refine", 20, "--threads", 2)
    assert done.returncode == 0, done.stderr
    return out


def test_a_run_leaves_everything_it_promises(finished: Path) -> None:
    names = ["trajectory.txt", "keyframes.json", "map.ply", "points.ply", "points_grid.ply", "config.yaml",
             "sequence.json", "timing.json", "metrics.json", "frames.csv", "run.json"]  # fmt: skip
    assert [name for name in names if not (finished / name).is_file()] == []
    assert len(list((finished / "renders").glob("*.png"))) == 6
    assert [p.name for p in finished.iterdir() if p.name.startswith(".")] == []  # no temporary files
    assert len(read_tum(finished / "trajectory.txt")) == 24
    assert {read_points(finished / name).voxel_size for name in ("points.ply", "points_grid.ply")} == {0.01}
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["map"]["gaussians"] == len(read_gaussian_ply(finished / "map.ply"))


def test_the_keys_others_rely_on_hold_sensible_numbers(finished: Path) -> None:
    m = json.loads((finished / "metrics.json").read_text())
    t = m["trajectory"]
    assert 0 < t["ate_mean_m"] <= t["ate_rmse_m"] < 0.03 and t["ate_raw_rmse_m"] < 0.05
    assert 0 < t["rpe_trans_m"] < 0.02 and 0 < t["rpe_rot_deg"] < 1
    assert m["images"]["held_out"]["frames"] == 3 and m["images"]["all"]["frames"] == 24
    for name in ("keyframes", "all", "held_out"):
        scores = m["images"][name]
        assert 20 < scores["psnr"] < 50 and 15 < scores["psnr_unmasked"] < 50
        assert 0.6 < scores["ssim"] < 1 and 0 < scores["depth_l1_m"] < 0.1
    assert m["speed"]["frames_per_s"] > 0 and m["speed"]["tracking_ms"] > 0
    assert m["speed"]["mapping_iteration_ms"] > 0
    assert 4 <= m["speed"]["iterations_per_frame"] < 5  # 4 a frame, 10 on the first
    assert m["memory"]["peak_rss_mb"] > 50


def test_the_commands_that_a_run_suggests_can_be_copied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = SimpleNamespace(path=tmp_path / ("it's a long name " * 8))
    nothing = {
        "metrics": None, "error": None, "verdicts": (), "verdict": None, "energy": None, "latency": None, "encoded": "",
    }  # fmt: skip
    outcome = SimpleNamespace(folder=folder, headline=lambda: "24 frames", **nothing)
    _print(cast(RunOutcome, outcome))
    shown = capsys.readouterr().out.splitlines()[-2:]
    view, export = (shlex.split(line.removeprefix("next:"), comments=True) for line in shown)
    assert view[:3] == ["ggslam", "view", str(folder.path)]
    assert export == ["ggslam", "export", str(folder.path), "--format", "mesh", "--out", "mesh.ply"]


def test_held_out_frames_are_never_keyframes(finished: Path) -> None:
    record = json.loads((finished / "keyframes.json").read_text())
    assert not {k["frame"] for k in record["keyframes"]} & {4, 12, 20}
    assert len(record["frames"]) == 24


@pytest.mark.long("a whole run, to the bit: every stage has to take part")
def test_the_same_run_again_is_the_same_to_the_bit(finished: Path, room: Path, tmp_path: Path) -> None:
    done = ggslam("run", room, "--scale", 0.5, "--out", tmp_path / "again", "--refine", 20, "--no-eval", "--threads", 1)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "again" / "map.ply").read_bytes() == (finished / "map.ply").read_bytes()
    assert (tmp_path / "again" / "trajectory.txt").read_bytes() == (finished / "trajectory.txt").read_bytes()


def test_eval_render_export(finished: Path, tmp_path: Path) -> None:
    before = json.loads((finished / "metrics.json").read_text())
    scored = Path(shutil.copytree(finished, tmp_path / "scored"))
    assert ggslam("eval", scored, "--no-lpips", "--every", 2).returncode == 0
    after = json.loads((scored / "metrics.json").read_text())
    assert after["trajectory"] == before["trajectory"] and after["images"]["all"]["frames"] == 12
    done = ggslam("render", finished, "--frames", "0,5", "--what", "color,depth,alpha", "--width", 200,
                  "--out", tmp_path / "pictures")  # fmt: skip
    assert done.returncode == 0, done.stderr
    pictures = sorted((tmp_path / "pictures").glob("*.png"))
    assert len(pictures) == 6 and cv2.imread(str(pictures[0])).shape[:2] == (150, 200)
    done = ggslam("export", finished, "--format", "ply", "--min-opacity", 0.5, "--out", tmp_path / "a" / "map.ply")
    assert done.returncode == 0, done.stderr
    assert 0 < len(read_gaussian_ply(tmp_path / "a" / "map.ply")) < after["map"]["gaussians"]
    assert ggslam("export", finished, "--format", "points", "--out", tmp_path / "clouds").returncode == 0
    assert (tmp_path / "clouds" / "points_grid.ply").is_file()
    assert ggslam("export", finished, "--format", "trajectory", "--out", tmp_path / "t.txt").returncode == 0
    assert len(read_tum(tmp_path / "t.txt")) == 24


@pytest.mark.long("runs as long as the recording lasts")
def test_realtime_keeps_pace(room: Path, tmp_path: Path) -> None:
    done = ggslam("run", room, "--out", tmp_path / "run", "--scale", 0.5, "--realtime", 12, "--stop", 14,
                  "--no-eval")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert ggslam("eval", tmp_path / "run", "--no-lpips", "--every", 4).returncode == 0
    m = json.loads((tmp_path / "run" / "metrics.json").read_text())
    frames = json.loads((tmp_path / "run" / "keyframes.json").read_text())["frames"]
    assert m["speed"]["frames_per_s"] < 16
    assert len(frames) + m["speed"]["dropped_frames"] == 14
    assert m["images"]["held_out"]["psnr"] > 20


@pytest.mark.long("a process that loads everything")
def test_a_process_of_its_own(room: Path, tmp_path: Path) -> None:
    done = in_a_process("run", room, "--out", tmp_path / "run", "--stop", 3, "--iterations", 1, "--no-eval")
    assert done.returncode == 0 and "3 frames" in " ".join(done.stdout.split()), done  # lines may break anywhere
    done = in_a_process("inspect", tmp_path / "nowhere")  # a command that loads little
    assert done.returncode == 2 and "nowhere" in " ".join(done.stderr.split()) and "Traceback" not in done.stderr


def copy_of(room: Path, to: Path) -> Path:
    shutil.copytree(room, to)
    return to


def depth_files(folder: Path) -> list[Path]:
    return sorted((folder / "depth").iterdir())


@pytest.mark.parametrize("more", [("--device", "cuda"), ("--set", "device=cuda"), ("--config", "DEVICE.yaml")])
def test_a_device_that_cannot_be_had(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: tuple[str, str]
) -> None:
    monkeypatch.setenv("GGSLAM_NVCC", str(tmp_path / "absent"))  # so that it cannot on a machine with a GPU, either
    (tmp_path / "DEVICE.yaml").write_text("device: cuda\n")
    more = (more[0], str(tmp_path / more[1])) if more[0] == "--config" else more
    refuse(ggslam("run", room, "--out", tmp_path / "run", *more), "error: device: cuda: the cuda backend")
    assert not (tmp_path / "run").exists()


def test_a_full_gpu_is_said_plainly(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fails() -> None:
        raise torch.cuda.OutOfMemoryError("tried to allocate 2 GiB")

    monkeypatch.setattr(main, "app", fails)
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 1
    assert capsys.readouterr().err.startswith("error: the GPU's memory is full: tried to allocate 2 GiB; ")


def test_missing_depth_file(room: Path, tmp_path: Path) -> None:
    folder = copy_of(room, tmp_path / "room")
    victim = depth_files(folder)[3]
    victim.unlink()
    refuse(ggslam("run", folder, "--out", tmp_path / "run"), victim.name)


def test_truncated_png_stops_the_run_but_keeps_what_was_done(room: Path, tmp_path: Path) -> None:
    folder = copy_of(room, tmp_path / "room")
    victim = depth_files(folder)[10]
    victim.write_bytes(victim.read_bytes()[:-200])
    few = ["--iterations", 1, "--scale", 0.5]
    refuse(ggslam("run", folder, "--out", tmp_path / "run", *few), victim.name)
    assert len(read_tum(tmp_path / "run" / "trajectory.txt")) == 10
    assert json.loads((tmp_path / "run" / "run.json").read_text())["complete"] is False
    done = ggslam("run", folder, "--out", tmp_path / "skipped", "--skip-bad-frames", "--no-eval", "--stop", 14, *few)
    assert done.returncode == 0, done.stderr
    assert len(read_tum(tmp_path / "skipped" / "trajectory.txt")) == 13


def test_depth_of_another_size(room: Path, tmp_path: Path) -> None:
    folder = copy_of(room, tmp_path / "room")
    victim = depth_files(folder)[2]
    cv2.imwrite(str(victim), np.full((77, 50), 1000, np.uint16))
    refuse(ggslam("run", folder, "--out", tmp_path / "run"), victim.name, "50x77")


def test_folders_that_are_no_recordings(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    refuse(ggslam("run", tmp_path / "empty", "--out", tmp_path / "run"), "empty")
    refuse(ggslam("run", tmp_path / "nowhere", "--out", tmp_path / "run"), "nowhere")
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("hello")
    refuse(ggslam("inspect", tmp_path / "letters"), "letters")
    assert not (tmp_path / "run").exists()


def test_output_folder_that_cannot_be_used(room: Path, finished: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    refuse(ggslam("run", room, "--out", tmp_path / "file" / "run"), "file")
    refuse(ggslam("run", room, "--out", "/proc/ggslam"), "/proc/ggslam")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("precious")
    refuse(ggslam("run", room, "--out", tmp_path / "thesis", "--overwrite"), "thesis")
    refuse(ggslam("run", room, "--out", finished), "--overwrite")


def test_wrong_arguments(room: Path, finished: Path, tmp_path: Path) -> None:
    refuse(ggslam("run", room, "--set", "mapping.iteration=3"), "mapping.iteration", "did you mean")
    refuse(ggslam("run", room, "--config", "swift"), "swift", "default")
    refuse(ggslam("run", room, "--start", 100, "--out", tmp_path / "run"), "0 to 23")
    refuse(ggslam("run", room, "--scale", "0.01", "--out", tmp_path / "run"), "scale: 0.01 leaves images of")
    refuse(ggslam("eval", tmp_path), "is an empty folder")
    refuse(ggslam("run", room, "--set", "mapping={", "--out", tmp_path / "run"), "mapping={")
    refuse(ggslam("run", room, "--set", "mapping.insertion.opacity=.nan", "--out", tmp_path / "run"), "opacity")
    refuse(ggslam("run", room, "--set", "mapping.pruning.every_keyframes=0", "--out", tmp_path / "r"), "every_keyf")
    refuse(ggslam("run", tmp_path / "wei[/b]rd"), "wei[/b]rd")
    refuse(ggslam("render", finished, "--frames", "99"), "99")
    refuse(ggslam("render", finished, "--what", "normals"), "normals")
    refuse(ggslam("export", finished, "--format", "points", "--voxel", -1, "--out", tmp_path / "x"), "voxel")


def test_damaged_run_folder(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    data = (folder / "map.ply").read_bytes()
    (folder / "map.ply").write_bytes(data[: len(data) // 2])
    refuse(ggslam("render", folder), "map.ply")
    (folder / "keyframes.json").write_text("{")
    refuse(ggslam("eval", folder), "keyframes.json")


def test_scores_are_of_the_run_s_own_recording(finished: Path, room: Path, tmp_path: Path) -> None:
    moved = copy_of(room, tmp_path / "moved")
    assert ggslam("eval", finished, "--sequence", moved, "--no-lpips", "--every", 6).returncode == 0
    for name in ("rgb", "depth", "masks"):
        sorted((moved / name).iterdir())[-1].unlink()
    done = ggslam("eval", finished, "--sequence", moved)
    assert done.returncode == 2 and "Traceback" not in done.stderr


def test_a_stopped_run_can_be_scored(room: Path, tmp_path: Path) -> None:
    folder = copy_of(room, tmp_path / "room")
    victim = depth_files(folder)[8]
    victim.write_bytes(victim.read_bytes()[:-200])
    refuse(ggslam("run", folder, "--out", tmp_path / "run", "--iterations", 1, "--scale", 0.5), victim.name)
    done = ggslam("eval", tmp_path / "run", "--no-lpips")
    assert done.returncode == 0, done.stderr
    m = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert m["images"]["all"]["frames"] == 8 and m["images"]["all"]["frames_without_pose"] == 0
    assert any("ends at frame 7" in note for note in m["notes"])


def test_other_shares_of_held_out_frames(room: Path, tmp_path: Path) -> None:
    done = ggslam("run", room, "--out", tmp_path / "run", "--scale", 0.5, "--stop", 9, "--iterations", 1, "--no-loops",
                  "--set", "evaluation.held_out_every=4")  # fmt: skip
    assert done.returncode == 0, done.stderr
    m = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert m["images"]["held_out"]["frames"] == 2  # frames 4 and 8; frame 0 has to be a keyframe
    assert m["tracking"]["ok"] + m["tracking"].get("degenerate", 0) == 8
    settings = RunFolder.open(tmp_path / "run").config()
    assert not settings.loops.enabled and settings.mapping.iterations_per_frame == 1
