# SPDX-License-Identifier: Apache-2.0
"""A program of somebody who uses ggslam and checks it by `mypy --strict`; CI does, and nothing runs it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import ggslam


def whole_day(recording: Path, later: Path, out: Path) -> float:
    """A run, and everything that can be done with it."""
    outcome: ggslam.RunOutcome = ggslam.run_recording(recording, out / "run", overrides=["seed=1"], stop=100)
    run: ggslam.RunFolder = outcome.folder
    poses: np.ndarray = run.trajectory().T_world_camera
    gaussians: ggslam.GaussianMap = run.gaussians()
    view: ggslam.RenderBuffers = ggslam.render(gaussians, run.sequence().camera, T_world_camera=poses[0])
    edited = ggslam.edit_run(run, [ggslam.Edit("remove", "mug"), ggslam.Edit("move", "7", "0 0 0.5")], out / "edited")
    found = ggslam.localize_recording(run.path, later, out / "found", near="0 0 2")
    volumes = ggslam.fuse_volumes(run.path, out / "volumes", occupancy=0.05, esdf=True)
    both = ggslam.merge_runs([run.path, out / "second"], out / "both")
    changes = ggslam.find_changes(run.path, out / "second")
    newer = ggslam.update_run(run.path, out / "second", out / "newer")
    finer = ggslam.refine_run(run.path)
    compared = ggslam.compare_maps(run.path, finer.folder.path, "none")
    names = [record.label() for record in run.object_table().objects]
    print(view.image.shape, edited.notes, volumes.files, both.notes, changes.seconds, newer.gaussians, names)
    share: float = found.summary()["located_share"]
    return share + compared.scores.accuracy_m


def by_hand(recording: Path) -> np.ndarray:
    """Frame by frame."""
    sequence: ggslam.Sequence = ggslam.open_sequence(recording, stride=2)
    slam = ggslam.Slam(sequence.camera, ggslam.load_config(None, ["mapping.iterations_per_frame=1"]), False)
    for frame in sequence:
        report: ggslam.StepReport = slam.step(frame)
        print(frame.index, report.frame.status, report.gaussians)
    result: ggslam.SlamResult = slam.finish()
    return result.trajectory()
