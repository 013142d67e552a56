# SPDX-License-Identifier: Apache-2.0
"""SLAM whose map does not fit into its budget of memory."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from kept import generated_recording

from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.point_ply import read_points
from ggslam.formats.trajectory import read_tum
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.map_points import map_points
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.submaps.grid import GridStore

PLENTY = "memory_limit_mb=100000"
SMALL = [PLENTY, "paging.budget_mb=2.9", "paging.cell=0.5", "paging.keep_radius=0.5", "paging.view_margin=1"]
PLAIN = ["mapping.iterations_per_frame=1", "identity.enabled=false"]
REFINED = "refine_iterations=20"
BEGINNING = 26
"""Frames until some of what was seen first is on disk, if the map may take..."""
LESS = [*SMALL, "paging.budget_mb=1.5"]


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera that turns in the generated room: what it saw first goes out of view. 44 frames of 80x60."""
    few = {"frames": 44, "width": 80, "height": 60, "seed": 0, "trajectory": "pan"}
    return generated_recording(tmp_path_factory, "turning", **few)


def slam_over(recording: Path, *overrides: str, stop: int | None = None) -> Slam:
    sequence = open_sequence(recording, stop=stop)
    slam = Slam(sequence.camera, load_config(None, [*PLAIN, *overrides]), sequence.has_masks)
    for frame in sequence.stream(masks="lazy"):
        slam.step(frame)
    return slam


def executed(recording: Path, out: Path, *overrides: str, stop: int | None = None) -> RunOutcome:
    sequence = SequenceRequest(recording, stop=stop)
    return execute(RunRequest(sequence, out, overrides=[*PLAIN, *overrides], evaluate=False))


def held_out_psnr(outcome: RunOutcome, recording: Path) -> float:
    metrics = score_run(outcome.folder, open_sequence(recording), SilentObserver(), lpips=False, every=4)
    return metrics.images.held_out.psnr


@pytest.fixture(scope="module")
def unlimited(turning: Path, tmp_path_factory: pytest.TempPathFactory) -> RunOutcome:
    return executed(turning, tmp_path_factory.mktemp("runs") / "unlimited", REFINED)


@pytest.fixture(scope="module")
def of_one_color(turning: Path, tmp_path_factory: pytest.TempPathFactory) -> RunOutcome:
    """Without what a limit that is reached leaves out."""
    return executed(turning, tmp_path_factory.mktemp("runs") / "of_one_color", REFINED, "sh_degree=0")


@pytest.fixture(scope="module")
def limited(turning: Path, tmp_path_factory: pytest.TempPathFactory) -> RunOutcome:
    return executed(turning, tmp_path_factory.mktemp("runs") / "limited", REFINED, *SMALL)


def test_a_limit_that_is_not_reached_changes_nothing(turning: Path, unlimited: RunOutcome) -> None:
    free, bound = unlimited.result, slam_over(turning, REFINED, PLENTY).finish()
    assert bound.cells is None
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "updates"):
        assert getattr(free.gaussians, name).numpy().tobytes() == getattr(bound.gaussians, name).numpy().tobytes()
    assert free.trajectory().tobytes() == bound.trajectory().tobytes()
    bound.close()


@pytest.mark.long("a whole run")
def test_a_limit_that_is_reached_keeps_the_map(turning: Path, of_one_color: RunOutcome, limited: RunOutcome) -> None:
    paging = json.loads((limited.folder.path / "timing.json").read_text())["paging"]
    assert paging["moved_out"] > 500
    assert paging["most_resident"] < 0.95 * limited.result.gaussian_count
    assert held_out_psnr(limited, turning) > held_out_psnr(of_one_color, turning) - 0.3
    assert limited.result.gaussian_count == pytest.approx(of_one_color.result.gaussian_count, rel=0.1)


def test_the_run_folder_is_complete_and_nothing_else_is_left(limited: RunOutcome) -> None:
    folder = limited.folder.path
    gaussians, index = read_gaussian_ply(folder / "map.ply"), json.loads((folder / "map_cells.json").read_text())
    assert len(gaussians) == index["gaussians"] == limited.result.gaussian_count
    for cell in index["cells"]:
        means = gaussians.means.numpy()[cell["start"] : cell["start"] + cell["count"]]
        assert (np.floor(means / 0.5 + 0.5) == cell["cell"]).all()
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]


def test_points_are_those_of_the_whole_map(limited: RunOutcome, tmp_path: Path) -> None:
    written = read_points(limited.folder.path / "points.ply")
    copy = Path(shutil.copytree(limited.folder.path, tmp_path / "whole"))
    (copy / "map_cells.json").unlink()
    whole = join_clouds(map_points(copy, written.voxel_size))
    order = np.lexsort(written.grid.T[::-1])
    assert len(whole) > 1000 and np.array_equal(written.grid[order], whole.grid)
    assert np.abs(written.points[order] - whole.points).max() < 1e-5
    difference = written.colors[order].astype(int) - whole.colors
    assert np.abs(difference).max() <= 1 and np.allclose(written.origin, whole.origin)


def test_a_view_of_the_cells_on_disk_is_the_view_of_the_map(limited: RunOutcome) -> None:
    parts, whole = limited.folder.map_in_parts(), limited.folder.gaussians()
    assert parts is not None
    keyframe, rasterizer = limited.result.keyframes[-1], CpuRasterizer()
    T_camera_world = inverse(keyframe.T_world_camera)
    full = rasterizer.forward(whole, keyframe.camera, T_camera_world).image.numpy().copy()
    seen = parts.in_view(keyframe.camera, T_camera_world)
    assert len(seen) < len(whole)
    assert np.abs(rasterizer.forward(seen, keyframe.camera, T_camera_world).image.numpy() - full).max() < 1e-5


@pytest.mark.long("a whole run, with objects")
def test_objects_of_a_map_on_disk(turning: Path, tmp_path: Path) -> None:
    """A row more than 100 bytes longer, so with the same budget more has to go."""
    objects = ["identity.enabled=true", "identity.final_passes=1", "identity.pixels=1000"]
    outcome = executed(turning, tmp_path / "objects", *SMALL, *objects, stop=BEGINNING)
    segmented = outcome.folder.segmented_map()
    assert outcome.result.cells is not None and outcome.result.cells.count > 500 and outcome.result.objects is not None
    ids = segmented.gaussians.object_id.numpy()
    counts = {record.id: record.gaussians for record in segmented.table.objects}
    assert counts == {i: n for i, n in enumerate(np.bincount(ids).tolist()) if i and n} and len(counts) > 3
    votes = segmented.votes
    assert votes is not None and (votes.labels() == ids)[votes.labels() > 0].mean() > 0.9


@pytest.mark.long("the mapper computes for as long as the recording lasts")
def test_real_time(turning: Path, tmp_path: Path) -> None:
    outcome = executed(turning, tmp_path / "live", *LESS, "refine_iterations=5", "realtime_fps=20", stop=BEGINNING)
    assert outcome.error is None and outcome.result.cells is not None
    assert len(read_gaussian_ply(outcome.folder.path / "map.ply")) == outcome.result.gaussian_count > 2000


@pytest.mark.long("a whole run")
def test_gaussians_on_disk_follow_a_correction(turning: Path) -> None:
    """All keyframes are moved, each its own way: what is on disk moves as what is in memory does."""
    slam = slam_over(turning, *LESS, stop=BEGINNING)
    pager = slam.pager
    assert pager is not None and pager.cells is not None and pager.on_disk > 500
    whole = GaussianMap(0)
    for part in [slam.map, *(part for _, part in pager.cells.parts())]:
        whole.append(part.take(torch.arange(len(part))))
    rng = np.random.default_rng(0)
    moves = np.stack([se3_exp(0.3 * rng.normal(size=6)) for _ in slam.mapper.keyframes])
    move_with_keyframes(whole, moves)
    slam.mapper.move_keyframes(moves)
    pager.move_keyframes(moves)
    found = np.concatenate([slam.map.means.numpy(), *(part.means.numpy() for _, part in pager.cells.parts())])
    assert np.array_equal(*(np.sort(means.view("f4,f4,f4").ravel()) for means in (found, whole.means.numpy())))
    slam.finish().close()


@pytest.mark.long("a second whole run")
def test_a_limited_run_repeats(turning: Path, limited: RunOutcome, tmp_path: Path) -> None:
    again = executed(turning, tmp_path / "again", REFINED, *SMALL)
    for name in ("map.ply", "trajectory.txt", "map_cells.json"):
        assert (again.folder.path / name).read_bytes() == (limited.folder.path / name).read_bytes(), name


def test_a_limit_below_the_program_is_refused(turning: Path) -> None:
    with pytest.raises(ConfigError, match=r"memory_limit_mb=50\b.*\d+ MB"):
        Slam(open_sequence(turning).camera, load_config(None, ["memory_limit_mb=50"]))


def test_an_interrupt_keeps_what_was_done(
    turning: Path, limited: RunOutcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C arrives twice while cells are written to disk."""
    real, calls = GridStore.put_cells, []

    def put(store: GridStore, writes) -> None:
        calls.append(writes)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)
        real(store, writes)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(GridStore, "put_cells", put)
    outcome = executed(turning, tmp_path / "stopped", *LESS)
    folder = outcome.folder.path
    assert isinstance(outcome.error, KeyboardInterrupt) and 5 < len(outcome.result.frames) < 44
    run = json.loads((folder / "run.json").read_text())
    assert run["complete"] is False and "KeyboardInterrupt" in run["stopped_by"]
    means = read_gaussian_ply(folder / "map.ply").means.numpy()
    assert len(means) == outcome.result.gaussian_count and len(np.unique(means, axis=0)) > 0.99 * len(means)
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_full_disk_is_named_and_the_trajectory_kept(
    turning: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def put(store: GridStore, writes) -> None:
        raise RunFolderError("cannot write cells: No space left on device")

    monkeypatch.setattr(GridStore, "put_cells", put)
    with pytest.raises(RunFolderError, match="No space left on device"):
        executed(turning, tmp_path / "full", *SMALL)
    left = sorted(path.name for path in (tmp_path / "full").iterdir())
    assert left == ["run.json", "trajectory.txt"]  # the map is lost, where the camera was is not
    assert len(read_tum(tmp_path / "full" / "trajectory.txt")) > 5
    assert "No space left" in json.loads((tmp_path / "full" / "run.json").read_text())["stopped_by"]


def test_what_a_killed_run_left_goes_with_the_next_one(turning: Path, tmp_path: Path) -> None:
    left = tmp_path / "run" / ".staged-999999999-0123abcd" / "keyframes"
    left.mkdir(parents=True)
    (left / "keyframe000000.npz").write_bytes(b"x")
    outcome = executed(turning, tmp_path / "run", PLENTY, stop=3)
    assert outcome.error is None and not [p for p in outcome.folder.path.iterdir() if p.name.startswith(".")]


def test_a_map_made_before_is_taken_whole(turning: Path, limited: RunOutcome, tmp_path: Path) -> None:
    request = RunRequest(SequenceRequest(turning), tmp_path / "on", None, [*PLAIN, *SMALL], map=limited.folder.path)
    with pytest.raises(ConfigError, match=r"memory_limit_mb.*`map`"):
        execute(request)


def test_gaussians_on_disk_get_another_exposure(turning: Path) -> None:
    slam, gain = slam_over(turning, *SMALL), np.array([2.0, 0.5, 3.0])
    assert slam.pager is not None and slam.pager.on_disk > 500
    cells = slam.pager.cells
    before = {key: part.rgb.numpy().copy() for key, part in cells.parts()}
    slam.mapper.residency.scale_colors(gain)
    after = {key: part.rgb.numpy() for key, part in cells.parts()}
    assert before.keys() == after.keys()
    assert all(np.abs(after[key] - gain * before[key]).max() < 1e-5 for key in before)
    slam.close()
