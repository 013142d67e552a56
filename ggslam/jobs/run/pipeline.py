# SPDX-License-Identifier: Apache-2.0
"""From a recording to a scored run folder: what `ggslam run` does, usable from Python."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from ggslam.cuda.availability import kernels_to_compile
from ggslam.errors import ConfigError, DeviceError, GgslamError, SequenceError
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.report.pages import write_report
from ggslam.jobs.score.run import score_run
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe, open_recording_of
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.starting import ancestors, start_in_map
from ggslam.scene.frame import Frame
from ggslam.sequences import Sequence
from ggslam.sequences.live import LiveSequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.realtime import RealtimeSlam
from ggslam.slam.result import SlamResult, StepReport, tracked_poses
from ggslam.slam.slam import Slam
from ggslam.system.interrupts import delay_interrupts
from ggslam.system.staging import new_staging


@dataclass(frozen=True)
class RunRequest:
    """A whole run; with `map` in the map of an earlier one, which grows unless `localize_only`."""

    sequence: SequenceRequest
    out: Path | None = None
    config: str | None = None
    overrides: list[str] = field(default_factory=list)
    evaluate: bool = True
    overwrite: bool = False
    map: Path | None = None
    localize_only: bool = False


@dataclass
class RunOutcome:
    """A finished run, or what was saved of one that stopped early (`error` says why)."""

    folder: RunFolder
    result: SlamResult
    metrics: MetricsRecord | None = None
    error: BaseException | None = None

    def headline(self) -> str:
        """One line for people."""
        r = self.result
        rate = r.frames_per_second()
        parts = [f"{len(r.frames)} frames", *([f"{rate:.1f} frames/s"] if np.isfinite(rate) else []),
                 f"{len(r.keyframes)} keyframes", f"{r.gaussian_count} Gaussians"]  # fmt: skip
        counts = Counter(frame.status for frame in r.frames)
        parts += [f"{counts[status]} frames {status}" for status in ("recovered", "lost") if counts[status]]
        parts += [f"{len(r.dropped_frames)} frames dropped"] if r.dropped_frames else []
        closed = sum(event.kind == "closed" for event in r.loop_events)
        parts += [f"{closed} loop{'s' if closed > 1 else ''} closed"] if closed else []
        return ", ".join(parts)


Follower = Callable[[Slam, Frame, StepReport], None]
"""Is called after every frame, in the thread that tracks."""


def execute(request: RunRequest, observer: Observer | None = None, follower: Follower | None = None) -> RunOutcome:
    """Runs a recording into a run folder. If it stops in the middle (damaged frame, interrupt), what was done is saved
    all the same and the outcome carries the error.

    Args:
        request: what to do.
        observer: is told how it goes on.
        follower: does more with each frame.

    Raises:
        GgslamError: nothing could be done at all: settings, recording or output folder at fault.
    """
    observer = observer or SilentObserver()
    config, earlier = load_config(request.config, request.overrides), None
    if request.localize_only and request.map is None:
        raise ConfigError("`localize_only` needs `map`: the run in whose map to localize")
    if request.map is not None:
        earlier = RunFolder.open(request.map)
        config = replace(config, sh_degree=earlier.config().sh_degree)
    sequence = request.sequence.open()
    if request.sequence.masks is not None and not sequence.has_masks:
        raise SequenceError(f"{request.sequence.masks}: none of the masks there belongs to a frame of this run")
    out = request.out if request.out is not None else Path("runs") / sequence.name
    if earlier is not None and out.resolve() in ancestors(earlier):
        raise ConfigError(f"`out` {out}: is the map to start in, or one that this comes from; choose another folder")
    folder = RunFolder.create(out, overwrite=request.overwrite)
    for warning in sequence.warnings:
        observer.note(warning)
    try:
        result, error = run_slam(sequence, config, observer, earlier, not request.localize_only, follower, folder)
    except GgslamError:  # before the first frame: settings that do not fit the recording, a model that is none
        folder.discard()
        raise
    if not result.keyframes:
        folder.discard()
        reason = result.frames[0].reason if result.frames else "no frame could be read"
        raise error if error is not None else SequenceError(f"{sequence.path}: no map could be begun: {reason}")
    described = describe(request.sequence, sequence, earlier)
    lacking = _objects_notes(sequence, result, config, earlier)
    for text in [*LoopsRecord.of_result(result).notes(), *described.notes(), *lacking, *result.notes]:
        observer.note(text)
    with delay_interrupts():
        names = {**_names(earlier), **sequence.instance_names}
        try:
            folder.save(config, described, result, None if error is None else repr(error), names)
        finally:
            result.close()
    outcome = RunOutcome(folder, result, error=error)
    kept = sequence if isinstance(sequence, Sequence) else None if error else _kept_recording(folder, sequence)
    if request.evaluate and error is None:
        if kept is None:
            observer.note("not scored: the frames of a live camera are kept with `record` only")
        else:
            outcome.metrics = score_run(folder, kept, observer)
    write_report(folder, kept)
    return outcome


def _objects_notes(
    sequence: Sequence | LiveSequence, result: SlamResult, config: Config, earlier: RunFolder | None
) -> list[str]:
    """Why no objects were learned although there are masks."""
    wanted = sequence.has_masks and config.identity.enabled and config.masks.source != "none"
    if not wanted or result.objects is not None:
        return []
    if earlier is not None and not earlier.has_objects():
        return [f"no objects were learned: the map of {earlier.path} has none"]
    return ["no objects were learned: the masks of the keyframes label nothing"]


def _kept_recording(folder: RunFolder, sequence: LiveSequence) -> Sequence | None:
    """What a live run recorded, if it did."""
    return None if sequence.record is None else open_recording_of(folder)


def _names(earlier: RunFolder | None) -> dict[int, str]:
    """Names of the objects of the run that this one began with."""
    if earlier is None or not earlier.has_objects():
        return {}
    return {o.id: o.name for o in earlier.object_table().objects if o.name is not None}


def run_slam(
    sequence: Sequence | LiveSequence, config: Config, observer: Observer, earlier: RunFolder | None = None,
    growing: bool = True, follower: Follower | None = None, folder: RunFolder | None = None,
) -> tuple[SlamResult, BaseException | None]:  # fmt: skip
    """The loop over a recording, synchronous or in real time as the settings say; with `earlier` in that run's map,
    which grows or stays as it is. What does not fit into a limit of memory goes to a hidden folder in `folder`.

    Raises:
        GgslamError: settings or map do not fit the recording; or the disk is full of what does not fit into memory:
            then the trajectory is in `folder`, and the map is lost.
    """
    error: BaseException | None = None
    paging = new_staging(folder.path) if config.memory_limit_mb and folder is not None else None
    if config.device != "cpu" and kernels_to_compile():
        observer.note("compiling the CUDA kernels, once: about a minute")
    slam = Slam(sequence.camera, config, sequence.has_masks, paging)
    if earlier is not None:
        start_in_map(slam, earlier, growing)
    observer.begin("track + map" if growing else "localize", len(sequence))

    def report(frame: Frame, step: StepReport) -> None:
        observer.frame(step)
        if follower is not None:
            follower(slam, frame, step)

    frames = sequence.stream(masks="lazy")  # only those of keyframes are read
    try:
        if config.realtime_fps > 0:
            RealtimeSlam(slam, config.realtime_fps).run(frames, report)
        else:
            for frame in frames:
                report(frame, slam.step(frame))
        if config.refine_iterations:
            observer.begin("refine", config.refine_iterations)
        return slam.finish(observer.advance), None
    except (Exception, KeyboardInterrupt) as stopped:  # whatever it is: finished work is saved, then it is raised
        error = _for_people(stopped)
    try:
        with delay_interrupts():
            result = _what_there_is(slam)
    except KeyboardInterrupt as again:  # by now there is the result
        error = again
    except Exception as failure:  # the disk is full, and what is there goes to make room
        slam.close()
        if folder is not None and slam.frames:
            stamps = np.array([frame.timestamp for frame in slam.frames])
            folder.save_trajectory(stamps, _last_poses(slam), repr(failure))
            observer.note(f"the map is lost; the trajectory of {len(stamps)} frames is in {folder.path}")
        raise
    return result, error


def _for_people(stopped: BaseException) -> BaseException:
    """The error as it is told to people."""
    if isinstance(stopped, torch.cuda.OutOfMemoryError):
        return DeviceError(f"the GPU's memory is full: {str(stopped).partition('. GPU')[0]}")
    return stopped


def _what_there_is(slam: Slam) -> SlamResult:
    """Where the memory of a GPU is full there is none for the last identity steps either: then without them."""
    try:
        return slam.result()
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        return slam.result()


def _last_poses(slam: Slam) -> np.ndarray:
    """T_world_camera of all frames; of keyframes that a GPU which failed will not tell, as they were tracked."""
    try:
        poses = [keyframe.T_world_camera for keyframe in slam.mapper.keyframes]
    except Exception:
        poses = list(slam.surface.poses)
    return tracked_poses(slam.frames, poses)
