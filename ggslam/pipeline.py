# SPDX-License-Identifier: Apache-2.0
"""From a recording to a scored run folder: what `ggslam run` does, usable from Python."""

from __future__ import annotations

import signal
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ggslam.config import Config, load_config
from ggslam.errors import GgslamError, RunFolderError, SequenceError
from ggslam.progress import Observer, SilentObserver
from ggslam.realtime import RealtimeSlam
from ggslam.run_folder import RunFolder, json_ready
from ggslam.scoring import score_run
from ggslam.sequences import Sequence, open_sequence
from ggslam.slam import Slam, SlamResult


@dataclass(frozen=True)
class SequenceRequest:
    """Which part of which recording, and how to read it; see `open_sequence`."""

    path: Path
    format: str | None = None
    start: int = 0
    stop: int | None = None
    stride: int = 1
    scale: float = 1.0
    masks: Path | None = None
    depth_scale: float | None = None
    on_bad_frame: str = "error"

    def open(self) -> Sequence:
        """Opens the recording.

        Raises:
            SequenceError: it cannot be read.
        """
        return open_sequence(
            self.path, format=self.format, start=self.start, stop=self.stop, stride=self.stride, scale=self.scale,
            masks=self.masks, depth_scale=self.depth_scale, on_bad_frame=self.on_bad_frame,  # type: ignore[arg-type]
        )  # fmt: skip


@dataclass(frozen=True)
class RunRequest:
    """A whole run."""

    sequence: SequenceRequest
    out: Path | None = None
    config: str | None = None
    overrides: list[str] = field(default_factory=list)
    evaluate: bool = True
    overwrite: bool = False


@dataclass
class RunOutcome:
    """A finished run, or what was saved of one that stopped early (`error` says why)."""

    folder: RunFolder
    result: SlamResult
    metrics: dict[str, Any] | None = None
    error: BaseException | None = None

    def headline(self) -> str:
        """One line for people."""
        r = self.result
        parts = [f"{len(r.frames)} frames", f"{r.frames_per_second():.1f} frames/s", f"{len(r.keyframes)} keyframes",
                 f"{len(r.gaussians)} Gaussians"]  # fmt: skip
        counts = Counter(frame.status for frame in r.frames)
        parts += [f"{counts[status]} frames {status}" for status in ("recovered", "lost") if counts[status]]
        parts += [f"{len(r.dropped_frames)} frames dropped"] if r.dropped_frames else []
        return ", ".join(parts)


def execute(request: RunRequest, observer: Observer | None = None) -> RunOutcome:
    """Runs a recording into a run folder. If it stops in the middle (damaged frame, interrupt), what was done is saved
    all the same and the outcome carries the error.

    Raises:
        GgslamError: nothing could be done at all: settings, recording or output folder at fault.
    """
    observer = observer or SilentObserver()
    config = load_config(request.config, request.overrides)
    sequence = request.sequence.open()
    if request.sequence.masks is not None and not sequence.has_masks:
        raise SequenceError(f"{request.sequence.masks}: none of the masks there belongs to a frame of this run")
    out = request.out if request.out is not None else Path("runs") / sequence.name
    folder = RunFolder.create(out, overwrite=request.overwrite)
    for warning in sequence.warnings:
        observer.note(warning)
    try:
        result, error = run_slam(sequence, config, observer)
    except GgslamError:  # before the first frame: settings that do not fit the recording, a model that is none
        folder.discard()
        raise
    if not result.keyframes:
        folder.discard()
        reason = result.frames[0].reason if result.frames else "no frame could be read"
        raise error if error is not None else SequenceError(f"{sequence.path}: no map could be begun: {reason}")
    for skipped in sequence.skipped:
        observer.note(f"skipped: {skipped.reason}")
    for problem in sequence.mask_problems.values():
        observer.note(f"mask not used: {problem}")
    if sequence.has_masks and config.identity.enabled and config.masks.source != "none" and result.objects is None:
        observer.note("no objects were learned: the masks of the keyframes label nothing")
    with uninterrupted():
        names = sequence.instance_names
        folder.save(config, describe(request.sequence, sequence), result, None if error is None else repr(error), names)
    outcome = RunOutcome(folder, result, error=error)
    if request.evaluate and error is None:
        outcome.metrics = score_run(folder, sequence, observer)
    return outcome


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits until the block is done (in the main thread; elsewhere it does not arrive anyway)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if arrived:
        raise KeyboardInterrupt


def run_slam(sequence: Sequence, config: Config, observer: Observer) -> tuple[SlamResult, BaseException | None]:
    """The loop over a recording, synchronous or in real time as the settings say."""
    observer.begin("track + map", len(sequence))
    error: BaseException | None = None
    slam = Slam(sequence.camera, config, sequence.has_masks)
    try:
        if config.realtime_fps > 0:
            RealtimeSlam(slam, config.realtime_fps).run(sequence.stream(masks="lazy"), observer.frame)
        else:
            _run_synchronous(slam, sequence, observer)
        if config.refine_iterations:
            observer.begin("refine", config.refine_iterations)
        return slam.finish(observer.advance), None
    except (Exception, KeyboardInterrupt) as stopped:  # whatever it is: finished work is saved, then it is raised
        error = stopped
    return slam.result(), error


def _run_synchronous(slam: Slam, sequence: Sequence, observer: Observer) -> None:
    for frame in sequence.stream(masks="lazy"):  # only those of keyframes are read
        observer.frame(slam.step(frame))


def describe(request: SequenceRequest, sequence: Sequence) -> dict[str, Any]:
    """What `sequence.json` holds: how to open the recording again, and its camera."""
    masks = None if request.masks is None else request.masks.absolute()
    values = {**asdict(request), "path": request.path.absolute(), "masks": masks}
    return {
        "open": values, "format": sequence.format, "camera": asdict(sequence.camera), "frames": len(sequence),
        "warnings": sequence.warnings, "skipped": [asdict(skipped) for skipped in sequence.skipped],
        "mask_problems": sequence.mask_problems,
    }  # fmt: skip


def open_recording_of(folder: RunFolder, path: Path | None = None, masks: Path | None = None) -> Sequence:
    """Opens the recording of a run again, as the run did.

    Args:
        folder: of the run.
        path: where the recording is now, if it was moved.
        masks: folder of masks to use instead of those that the run had.

    Raises:
        SequenceError: it is not there any more.
        RunFolderError: the run does not say which it was.
    """
    try:
        record = folder.read_json("sequence.json")
        values = dict(record["open"])
        values["path"] = Path(path if path is not None else values["path"])
        used = masks if masks is not None else values["masks"]
        values["masks"] = None if used is None else Path(used)
        request = SequenceRequest(**values)
    except (KeyError, TypeError) as error:
        raise RunFolderError(f"{folder.path / 'sequence.json'}: not as ggslam writes it: {error!r}") from None
    sequence = request.open()
    found = {"frames": len(sequence), "camera": asdict(sequence.camera)}
    expected = {name: record.get(name) for name in found}
    if json_ready(found) != expected:
        raise RunFolderError(f"{sequence.path}: not the recording of {folder.path}: expected {expected}, found {found}")
    return sequence
