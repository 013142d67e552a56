# SPDX-License-Identifier: Apache-2.0
"""Runs and `ggslam inspect` say what is wrong with a recording, and nothing of one that is well."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_line import ggslam

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.metrics import ImageScoresRecord
from ggslam.sequences import inspect_sequence, open_sequence
from ggslam.sequences.camera_doubts import judge_intrinsics
from ggslam.sequences.verdicts import judge_times, usual_scale
from ggslam.slam.result import SlamResult
from ggslam.slam.verdicts import judge_path, judge_run

FAST = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=1", "loops.enabled=false"]


def verdicts_of(recording: Path, **how: object) -> dict[str, str]:
    """Texts by code."""
    sequence = open_sequence(recording, **how)  # type: ignore[arg-type]
    return {verdict.code: verdict.text for verdict in inspect_sequence(sequence).verdicts}


def with_camera(room: Path, folder: Path, **factors: float) -> Path:
    """The recording with intrinsics times these."""
    shutil.copytree(room, folder)
    path = folder / "camera.yaml"
    camera = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**camera, **{name: camera[name] * factors[name] for name in factors}}))
    return folder


@pytest.mark.long("looks three recordings over")
def test_recordings_that_are_well(room: Path, shared_data: Path) -> None:
    assert verdicts_of(room) == {}
    for name in ("livingroom", "redkitchen"):
        assert verdicts_of(shared_data / name, scale=0.5, stop=60) == {}


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_focal_length(shared_data: Path, tmp_path: Path, factor: float) -> None:
    source = shared_data / "livingroom"
    (tmp_path / "results").symlink_to(source / "results")
    shutil.copy(source / "traj.txt", tmp_path)
    camera = json.loads((source / "cam_params.json").read_text())
    right = camera["camera"]["fx"]
    camera["camera"] |= {"fx": factor * right, "fy": factor * right}
    (tmp_path / "cam_params.json").write_text(json.dumps(camera))
    told = verdicts_of(tmp_path, scale=0.5, stop=60)
    assert float(told["intrinsics"].partition("with fx ")[2].split()[0]) == pytest.approx(right, rel=0.2)


def test_pixels_that_are_not_square(room: Path, tmp_path: Path) -> None:
    assert "mean pixels 0.50 times as wide" in verdicts_of(with_camera(room, tmp_path / "room", fx=2.0))["intrinsics"]


def test_implausible_intrinsics(room: Path) -> None:
    camera = open_sequence(room).camera
    assert judge_intrinsics(camera) == []
    for wrong, words in (
        (replace(camera, fx=20 * camera.fx, fy=20 * camera.fy), "angle of view 4 degrees"),
        (replace(camera, cx=0.1 * camera.width), "the principal point lies 40% of the image away"),
    ):
        assert words in judge_intrinsics(wrong)[0].text


@pytest.mark.parametrize(("factor", "scale"), [(5, 1000.0), (0.2, 1000.0), (10, 1000.0), (1000, 1000.0)])
def test_wrong_depth_scale_is_named(shared_data: Path, factor: float, scale: float) -> None:
    told = verdicts_of(shared_data / "redkitchen", scale=0.25, stop=60, depth_scale=1000 / factor)
    assert f"try `depth_scale` {scale:g}" in told["depth_scale"]


def test_usual_scales_are_preferred() -> None:
    assert [usual_scale(s) for s in (980.0, 5200.0, 6600.0, 0.099, 700.0)] == [1000, 5000, 6553.5, 0.1, 700]


def test_colour_and_depth_out_of_step(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "livingroom"
    shutil.copy(source / "cam_params.json", tmp_path)
    shutil.copy(source / "traj.txt", tmp_path)
    (tmp_path / "results").mkdir()
    for k in range(40):
        for name, number in (("frame", k), ("depth", k + 2)):
            found = next((source / "results").glob(f"{name}{number:06d}.*"))
            (tmp_path / "results" / f"{name}{k:06d}{found.suffix}").symlink_to(found)
    told = verdicts_of(tmp_path, scale=0.5)
    assert "depth fits the colour of 2 or more frames after it better" in told["step"]


def test_time_that_goes_back_or_jumps() -> None:
    times = np.arange(100) / 30
    assert judge_times(times) == []
    back = times.copy()
    back[40:] -= 0.5
    assert [v.code for v in judge_times(back)] == ["time"] and "frame 40: -0.467 s" in judge_times(back)[0].text
    same, longer = judge_times(np.full(40, 5.0)), judge_times(np.r_[np.full(40, 5.0), 6.0])
    assert [v.code for v in same] == ["time"] and "all 40 time stamps are the same, 5 s; delete them" in same[0].text
    assert "sort the recording" in longer[0].text
    gap = np.delete(times, range(50, 80))
    assert [v.code for v in judge_times(gap)] == ["frames_missing"]
    assert "about 30 frames are missing in 1 gap " in judge_times(gap)[0].text
    assert judge_times(np.delete(times, 50)) == []


@pytest.fixture(scope="module")
def well(room: Path, tmp_path_factory: pytest.TempPathFactory) -> SlamResult:
    out = tmp_path_factory.mktemp("well")
    outcome = execute(RunRequest(SequenceRequest(room, scale=0.5), out=out / "run", overrides=FAST, evaluate=False))
    assert outcome.verdicts == [] and outcome.folder.mark().verdicts == []
    return outcome.result


def test_dropped_and_lost_frames(well: SlamResult) -> None:
    assert judge_run(well) == []
    assert "10 of 34 frames were dropped" in judge_run(replace(well, dropped_frames=list(range(10))))[0].text
    lost = [replace(f, status="lost") if k > 15 else f for k, f in enumerate(well.frames)]
    assert [v.code for v in judge_run(replace(well, frames=lost))] == ["lost"]


def test_a_jump_is_said(well: SlamResult) -> None:
    frames = [replace(f, status="doubted") if k == 7 else f for k, f in enumerate(well.frames)]
    (verdict,) = judge_run(replace(well, frames=frames))
    assert verdict.code == "jump" and f"(the first: {frames[7].frame_index})" in verdict.text


def test_degenerate_frames(well: SlamResult) -> None:
    frames = [replace(f, status="degenerate") for f in well.frames]
    assert [v.code for v in judge_run(replace(well, frames=frames))] == ["degenerate"]


def test_a_path_of_another_length_than_the_true_one(well: SlamResult, room: Path) -> None:
    truth = open_sequence(room).ground_truth
    assert truth is not None and judge_path(well, truth, 1000.0) == []
    small = truth.copy()
    small[:, :3, 3] /= 5
    found = judge_path(well, small, 1000.0)
    assert [v.code for v in found] == ["depth_scale"] and "try `depth_scale` 5000" in found[0].text


def bare_wall(folder: Path, frames: int = 16) -> Path:
    """A camera that goes along a white wall, 1.5 m away."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for k in range(frames):
        cv2.imwrite(str(folder / "rgb" / f"{k:06d}.png"), np.full((120, 160, 3), 200, np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{k:06d}.png"), np.full((120, 160), 1500, np.uint16))
    camera = {"width": 160, "height": 120, "fx": 140.0, "fy": 140.0, "cx": 79.5, "cy": 59.5, "depth_scale": 1000.0}
    (folder / "camera.yaml").write_text(yaml.safe_dump(camera))
    return folder


def test_a_bare_wall_is_told_and_strict_runs_fail(tmp_path: Path) -> None:
    wall = bare_wall(tmp_path / "wall")
    fast = [word for setting in FAST for word in ("--set", setting)]
    done = ggslam("run", wall, "--out", tmp_path / "run", "--no-eval", "--strict", *fast)
    assert done.returncode == 3
    assert "wrong:" in done.stdout and "show one bare surface and no texture" in done.stdout
    run = RunFolder.open(tmp_path / "run")
    told = run.mark().verdicts
    assert [v.code for v in told] == ["textureless"] and run.mark().complete
    assert told[0].text in (run.path / "report.html").read_text()


def dimmed(room: Path, folder: Path, gain: Callable[[int], float]) -> Path:
    """The recording with the colours of each frame times a gain."""
    shutil.copytree(room, folder)
    for k, path in enumerate(sorted((folder / "rgb").iterdir())):
        image = cv2.imread(str(path)).astype(np.float32) * gain(k)
        cv2.imwrite(str(path), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return folder


STEPS = ["mapping.iterations_per_frame=8"]


@pytest.fixture(scope="module")
def scores_of_the_room(room: Path, tmp_path_factory: pytest.TempPathFactory) -> ImageScoresRecord:
    out = tmp_path_factory.mktemp("scored") / "run"
    outcome = execute(RunRequest(SequenceRequest(room, scale=0.5), out=out, overrides=STEPS))
    assert outcome.verdicts == [] and outcome.metrics is not None and outcome.metrics.images.all is not None
    assert all((k.exposure == [1.0, 0.0]).all() for k in outcome.result.keyframes)
    return outcome.metrics.images.all


@pytest.mark.long("runs a recording and scores it")
@pytest.mark.parametrize(
    ("gain", "more"),
    [(lambda k: 0.4 if k >= 12 else 1.0, []), (lambda k: 1 - 0.6 * k / 23, ["mapping.exposure.change=0.12"])],
    ids=["jump", "drift"],
)
def test_changes_of_exposure_are_compensated(
    room: Path, scores_of_the_room: ImageScoresRecord, tmp_path: Path, gain: Callable[[int], float],
    more: list[str],
) -> None:  # fmt: skip
    recording = dimmed(room, tmp_path / "recording", gain)
    dimmed_request = SequenceRequest(recording, scale=0.5)
    outcome = execute(RunRequest(dimmed_request, out=tmp_path / "run", overrides=[*STEPS, *more]))
    assert [verdict.code for verdict in outcome.verdicts] == ["exposure"]
    assert outcome.metrics is not None and outcome.metrics.images.all is not None
    dim, well = outcome.metrics.images.all, scores_of_the_room
    assert well.psnr is not None and well.psnr_exposed is None
    assert dim.psnr is not None and dim.psnr_exposed is not None
    assert dim.psnr_exposed > well.psnr - 1
    assert dim.psnr < well.psnr - 5  # as recorded


def test_a_run_that_cannot_be_judged_is_saved(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Verdicts come before the map is saved, and must not cost it."""

    def fail(*_: object) -> None:
        raise RuntimeError("no idea")

    monkeypatch.setattr("ggslam.jobs.run.pipeline.judge", fail)
    outcome = execute(RunRequest(SequenceRequest(room, stop=2), tmp_path / "run", overrides=FAST, evaluate=False))
    assert outcome.error is None and outcome.failure is None and outcome.verdicts == []
    assert len(RunFolder.open(tmp_path / "run").gaussians()) > 1000
