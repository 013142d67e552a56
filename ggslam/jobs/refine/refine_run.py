# SPDX-License-Identifier: Apache-2.0
"""Trains the map of a finished run further on its keyframes. `ggslam refine RUN` calls this."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.geometry.scene_size import scene_scale
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.refine.settings import RefineSettings
from ggslam.mapping.finished import StillMapper
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, make_keyframe
from ggslam.mapping.scale import scale_settings
from ggslam.native.loader import NativeContext
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.runs.copied_files import copy_files
from ggslam.runs.folder import RunFolder
from ggslam.runs.publishing import publish_run
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.movers import MOVER_FILES
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.saving_parts import save_points
from ggslam.runs.writing import RUN_FILES, TRUTH_FILE, write_objects
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sequences import Sequence
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.slam.step_log import STEPS_FILE
from ggslam.system.folder_lock import folder_lock
from ggslam.system.interrupts import delay_interrupts

_STAY = ("trajectory.txt", "config.yaml", "sequence.json", "loops.json", STEPS_FILE, TRUTH_FILE, PLACES_FILE,
         *MOVER_FILES)  # fmt: skip
"""Files that are true of the refined run as well; keyframes.json and timing.json with a change."""


@dataclass
class RunRefinement:
    """Result of refining a run.

    Attributes:
        folder: the refined run.
        keyframes: that it was trained on.
        steps: optimisation steps.
        before, after: PSNR of keyframes, or some of them, before the first step and after the last one, mean in dB.
        seconds: that it took.
        notes: what the user should know.
    """

    folder: RunFolder
    keyframes: int
    steps: int
    before: float
    after: float
    seconds: float
    notes: list[str] = field(default_factory=list)


def refine_run(
    run: str | Path, out: str | Path | None = None, *, settings: RefineSettings | None = None,
    recording: Path | None = None, overwrite: bool = False, observer: Observer | None = None,
) -> RunRefinement:  # fmt: skip
    """Trains the map of a finished run further on its keyframes; poses, exposures and objects stay.

    Args:
        run: its folder.
        out: folder of the refined run; None: in place, at once when all of it is written.
        settings: how; of a run only steps and seed count.
        recording: where the recording is now, if it was moved.
        overwrite: replace a run that is already at `out`.
        observer: receives progress updates.

    Raises:
        ConfigError: the run was edited, or it has no keyframes of its recording.
        SequenceError: the recording is not there any more.
        RunFolderError: files of the run are missing or damaged, or it cannot be written.
    """
    start, settings, source = time.perf_counter(), settings or RefineSettings(), RunFolder.open(Path(run))
    if source.mark().edits and not (source.path / PLACES_FILE).is_file():
        raise ConfigError(f"{source.path}: was edited, and its recording does not show that: refine first, then edit")
    target = source if out is None or Path(out).resolve() == source.path.resolve() else None
    if target is None:
        assert out is not None
        if source.path.resolve() in Path(out).resolve().parents:
            raise ConfigError(f"`out` {out}: lies in the run; choose another folder")
        target = RunFolder.create(Path(out), overwrite)
    try:
        with folder_lock(target.path):
            return _refine(source, target, settings, recording, observer or SilentObserver(), start)
    except BaseException:
        target.discard()
        raise


def _refine(
    source: RunFolder, target: RunFolder, settings: RefineSettings, recording: Path | None, observer: Observer,
    start: float,
) -> RunRefinement:  # fmt: skip
    sequence, record = open_recording_of(source, recording), source.keyframes()
    observer.begin("read keyframes", len(record.keyframes))
    keyframes, valid = _read_keyframes(source, sequence, observer)
    scene = source.segmented_map() if source.has_objects() else None
    gaussians = source.gaussians(with_moments=True)
    scale = scene_scale(keyframes[0].depth_m()) if keyframes else 1.0  # as the run itself did
    config = source.config()
    trained_by = scale_settings(config.mapping, scale)
    mapper = StillMapper(gaussians, trained_by, NativeContext(), keyframes, valid, config.fits_view_colors)
    observer.begin("refine", settings.steps)
    before, after = mapper.train(settings.steps, [settings.seed], observer.advance)
    refined = None if scene is None else SegmentedMap(gaussians, scene.classifier, scene.table, scene.votes)
    seconds = time.perf_counter() - start
    with delay_interrupts():
        _save(source, target, gaussians, refined, {k.frame_index: k.iterations for k in keyframes}, seconds)
    notes = ["scores were not made anew: `ggslam eval` makes them"] if source.metrics() is not None else []
    return RunRefinement(target, len(keyframes), settings.steps, before, after, time.perf_counter() - start, notes)


def _read_keyframes(
    source: RunFolder, sequence: Sequence, observer: Observer
) -> tuple[list[Keyframe], list[np.ndarray | None]]:
    """With their images, and where these show something; those of other recordings are left out."""
    keyframes, known, valid = list[Keyframe](), source.keyframes().keyframes, list[np.ndarray | None]()
    for done, record in enumerate(known, 1):
        if record.frame != FROM_EARLIER_RUN:
            frame = sequence.frame(record.frame, masks=False)
            keyframe = make_keyframe(len(keyframes), frame, record.T_world_camera)
            keyframe.exposure = record.known_exposure
            keyframes.append(keyframe)
            valid.append(frame.valid)
        observer.advance(done, len(known))
    if not keyframes:
        raise ConfigError(f"{source.path}: none of its keyframes is of its recording")
    return keyframes, valid


def _save(
    source: RunFolder, target: RunFolder, gaussians: GaussianMap, scene: SegmentedMap | None, steps: dict[int, int],
    seconds: float,
) -> None:  # fmt: skip
    """Writes the refined run; `steps`: made on each frame."""

    def write(staged: Path) -> RunRecord:
        copy_files(source.path, staged, _STAY)
        record = source.keyframes()
        changed = [
            k.model_copy(update={"iterations": k.iterations + steps.get(k.frame, 0)}) for k in record.keyframes
        ]
        record.model_copy(update={"keyframes": changed}).write(staged)
        timing = source.timing()
        timing.model_copy(update={
            "refine_iterations": timing.refine_iterations + sum(steps.values()),
            "refinement_s": timing.refinement_s + seconds,
        }).write(staged)  # fmt: skip
        if scene is None:
            write_gaussian_ply(staged / "map.ply", gaussians)
        else:
            write_objects(staged, scene)
        save_points(staged)
        return source.mark()

    publish_run(target.path, write, RUN_FILES, f"{target.path}: the refined run cannot be written")
