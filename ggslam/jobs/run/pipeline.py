# SPDX-License-Identifier: Apache-2.0
"""From a recording to a scored run folder: what `ggslam run` does, usable from Python."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ggslam.errors import ConfigError, GgslamError, SequenceError
from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.report.pages import write_report
from ggslam.jobs.run.checkpointing import Checkpointing, start_record
from ggslam.jobs.run.encoding import EncodeRequest, RunEncoding
from ggslam.jobs.run.health import doubt_movers, judge
from ggslam.jobs.run.map_fit import MapFit, located_views, measure_fit
from ggslam.jobs.run.named_loss import NamedLoss
from ggslam.jobs.run.rescue import save_somewhere
from ggslam.jobs.run.resuming import Resumption
from ggslam.jobs.run.run_verdict import judge_result
from ggslam.jobs.run.slam_loop import Follower, SlamLoop, Waiting
from ggslam.jobs.run.start_check import check_depth
from ggslam.runs.checkpoints import Checkpoints
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import LiveRequest, SequenceRequest, describe, open_recording_of
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.timing import EnergyRecord, LatencyRecord, TimingRecord
from ggslam.runs.records.verdict import RunVerdict
from ggslam.runs.starting import ancestors
from ggslam.runs.writing import REPORT_FILE, RunToWrite
from ggslam.sequences import Sequence
from ggslam.sequences.live import LiveSequence
from ggslam.sequences.rig import RigSequence
from ggslam.sequences.verdicts import Verdict
from ggslam.slam.config import Config, load_config, settings_notes
from ggslam.slam.latency import LatencyMeter
from ggslam.slam.result import SlamResult
from ggslam.slam.saved_state import reason_against_saving
from ggslam.system.energy import EnergyMeter
from ggslam.system.folder_lock import folder_lock
from ggslam.system.interrupts import StopRequest, stop_on_request
from ggslam.system.plurals import quantity
from ggslam.system.spent import Spent, part

T = TypeVar("T")


@dataclass(frozen=True)
class RunRequest:
    """A whole run; with `map` in the map of an earlier one, which grows unless `localize_only`. Its state is saved
    after every `checkpoint_every` frames: 0: never; None: as often as it hardly takes time. `check`: look at the
    recording's depth first, and refuse what is certainly wrong with it. `loss`: a loss of the user's own, see
    `named_loss`; it is run. `energy`: count what each part uses. `encode`: what to code the finished run as."""

    sequence: SequenceRequest
    out: Path | None = None
    config: str | None = None
    overrides: list[str] = field(default_factory=list)
    evaluate: bool = True
    overwrite: bool = False
    map: Path | None = None
    localize_only: bool = False
    checkpoint_every: int | None = None
    check: bool = True
    loss: str | None = None
    encode: EncodeRequest | None = None
    energy: bool = False


@dataclass
class RunOutcome:
    """A finished run, or what was saved of one that stopped early (`error` says why). If it could not be saved as it
    should be, `failure` says so, and where it is. `verdicts` tell what seems wrong with it or its recording, `verdict`
    how good it is; None: that could not be told. `energy`: what each part used, if that was asked for; `latency`: of a
    camera, and in real time. `encoded`: a line on the stream that was asked for, `encode_failure`: why there is none.
    """

    folder: RunFolder
    result: SlamResult
    metrics: MetricsRecord | None = None
    error: BaseException | None = None
    failure: GgslamError | None = None
    verdicts: list[Verdict] = field(default_factory=list)
    verdict: RunVerdict | None = None
    encoded: str = ""
    encode_failure: GgslamError | None = None
    energy: EnergyRecord | None = None
    latency: LatencyRecord | None = None

    def headline(self) -> str:
        """One line for people."""
        r = self.result
        rate = r.frames_per_second()
        parts = [quantity(len(r.frames), "frame"), *([f"{rate:.1f} frames/s"] if np.isfinite(rate) else []),
                 quantity(len(r.keyframes), "keyframe"), quantity(r.gaussian_count, "Gaussian")]  # fmt: skip
        counts = Counter(frame.status for frame in r.frames)
        told = [status for status in ("recovered", "doubted", "lost") if counts[status]]
        parts += [f"{quantity(counts[status], 'frame')} {status}" for status in told]
        parts += [f"{quantity(len(r.dropped_frames), 'frame')} dropped"] if r.dropped_frames else []
        closed = sum(event.kind == "closed" for event in r.loop_events)
        parts += [f"{quantity(closed, 'loop')} closed"] if closed else []
        joined = sum(event.kind == "joined" for event in r.loop_events)
        parts += [f"{quantity(joined, 'part')} joined"] if joined else []
        return ", ".join(parts)


def execute(
    request: RunRequest, observer: Observer | None = None, follower: Follower | None = None,
    waiting: Waiting | None = None,
) -> RunOutcome:  # fmt: skip
    """Runs a recording into a run folder. If it stops in the middle (damaged frame, interrupt), what was done is saved
    all the same and the outcome carries the error.

    Args:
        request: what to do.
        observer: receives progress updates.
        follower: does more with each frame.
        waiting: does something while a camera's next frame is waited for.

    Raises:
        GgslamError: nothing could be done at all: settings, recording or output folder at fault.
    """
    config, earlier = load_config(request.config, request.overrides), None
    if request.localize_only and request.map is None:
        raise ConfigError("`localize_only` needs `map`: the run in whose map to localize")
    loss = None if request.loss is None else NamedLoss.load(request.loss)
    if loss is not None and request.localize_only:
        raise ConfigError("`loss` trains the map, which `localize_only` leaves as it is")
    if request.map is not None:
        earlier = RunFolder.open(request.map)
        config = replace(config, sh_degree=earlier.config().sh_degree)
    sequence = request.sequence.open(truth=request.evaluate)
    if request.sequence.masks is not None and not sequence.has_masks:
        raise SequenceError(f"{request.sequence.masks}: none of the masks there belongs to a frame of this run")
    out = request.out if request.out is not None else Path("runs") / sequence.name
    if earlier is not None and out.resolve() in ancestors(earlier):
        raise ConfigError(f"`out` {out}: is the map to start in, or one that this comes from; choose another folder")
    if request.encode is not None:
        request.encode.check(out, _inputs(request.sequence, earlier), request.overwrite)
    observer = observer or SilentObserver()
    for note in settings_notes(config, request.config, request.overrides):
        observer.note(note)
    verdicts = check_depth(sequence, observer) if request.check else None
    folder = RunFolder.create(out, overwrite=request.overwrite)
    with stop_on_request() as stop, folder_lock(folder.path):
        run = _Run(request, config, sequence, earlier, folder, observer, follower, stop, loss, waiting, verdicts)
        return run.run(None)


def resume(
    run: Path, observer: Observer | None = None, follower: Follower | None = None, *, recording: Path | None = None,
    evaluate: bool | None = None, checkpoint_every: int | None = None, model: str | None = None,
    loss: str | None = None, energy: bool = False, encode: EncodeRequest | None = None, waiting: Waiting | None = None,
) -> RunOutcome:  # fmt: skip
    """Goes on with a run that was cut off, from its newest checkpoint. A synchronous run on the CPU becomes what it
    would have become, bit for bit.

    Args:
        run: its folder.
        observer: receives progress updates.
        follower: does more with each frame.
        recording: where the recording is now, if it was moved.
        evaluate: score the run; None: as it was asked to.
        checkpoint_every: as of `RunRequest`.
        model: the model of masks that the run was begun with, if it was with one: it is run like a program, and the
            folder may come from somebody else.
        loss: name of the user's own loss that the run was begun with, likewise. What it remembers is not saved.
        energy: count what each part uses from now on.
        encode: what to code the finished run as; a run does not remember what it was to be coded as.
        waiting: as of `execute`.

    Raises:
        GgslamError: there is nothing to go on from; the recording is another one; the run was made with another
            version; `model` or `loss` is not the run's.
    """
    folder = RunFolder.open_unfinished(run)
    with stop_on_request() as stop, folder_lock(folder.path):
        found = Resumption.of(folder, recording, evaluate, model, loss)
        if encode is not None:
            encode.check(folder.path, _inputs(found.request, found.earlier), None)
        asked = RunRequest(
            found.request, folder.path, evaluate=found.start.evaluate if evaluate is None else evaluate,
            localize_only=found.start.localize_only, checkpoint_every=checkpoint_every, loss=loss,
            energy=energy, encode=encode,
        )  # fmt: skip
        own = None if loss is None else NamedLoss.load(loss)
        observer = observer or SilentObserver()
        run_again = _Run(
            asked, found.config, found.sequence, found.earlier, folder, observer, follower, stop, own, waiting
        )  # fmt: skip
        return run_again.run(found)


@dataclass
class _Run:
    """A run about to be made; see `RunRequest`. `depth`: what `check_depth` said; None: it was not asked."""

    request: RunRequest
    config: Config
    sequence: Sequence | LiveSequence
    earlier: RunFolder | None
    folder: RunFolder
    observer: Observer
    follower: Follower | None
    stop: StopRequest
    loss: NamedLoss | None = None
    waiting: Waiting | None = None
    depth: list[Verdict] | None = None
    fit: MapFit | None = None
    saw_all: bool = False
    told: list[str] = field(default_factory=list)
    spent: Spent | None = None
    latency: LatencyMeter | None = None

    def run(self, resumption: Resumption | None) -> RunOutcome:
        """From the first frame, or from where it was, to the report."""
        if not self.request.energy:
            return self._run(resumption)
        self.spent = Spent(EnergyMeter())
        with self.spent.count_parts("reading and the rest"):
            return self._run(resumption)

    def _run(self, resumption: Resumption | None) -> RunOutcome:
        folder, sequence, observer = self.folder, self.sequence, self.observer
        for warning in sequence.warnings:
            observer.note(warning)
        checkpoints = Checkpoints(folder.path)
        try:
            checkpointing = self._make_checkpointing(checkpoints, resumption)
            loop = SlamLoop(
                sequence, self.config, observer, folder, self.earlier, not self.request.localize_only, self.follower,
                self.waiting, checkpointing, self.stop, loss=self.loss,
            )  # fmt: skip
            if resumption is not None and checkpointing is not None:
                loop.resume = lambda slam: resumption.restore(slam, checkpoints, checkpointing, observer)
            result, error = loop.run()
            self.saw_all, self.told, self.latency = loop.saw_all, loop.told, loop.latency
        except GgslamError:  # before the first frame: settings that do not fit the recording, a model that is none
            if resumption is None:
                checkpoints.remove()
                folder.discard()
            raise
        finally:
            # However it ends: whoever has the folder next finds nobody at work in it.
            checkpoints.close()
        if not result.keyframes:
            checkpoints.remove()
            folder.discard()
            reason = result.frames[0].reason if result.frames else "no frame could be read"
            raise error if error is not None else SequenceError(f"{sequence.path}: could not start a map: {reason}")
        outcome = self._save(result, error)
        self._look_at(outcome)
        if error is None and outcome.failure is None:
            checkpoints.remove()
        with self._code_within(outcome, complete=True):
            return outcome

    def _make_checkpointing(self, checkpoints: Checkpoints, resumption: Resumption | None) -> Checkpointing | None:
        """What saves the state; None: nothing does."""
        every, sequence = self.request.checkpoint_every, self.sequence
        reason = reason_against_saving(self.config)
        if isinstance(sequence, LiveSequence):
            reason = "its frames come from a camera"
        elif self.config.realtime_fps:
            reason = "it is made in real time"
        if reason is not None and every != 0:
            self.observer.note(f"no checkpoints are made, so an interrupted run cannot be resumed: {reason}")
        if reason is not None or (every == 0 and resumption is None) or not isinstance(sequence, Sequence):
            return None
        if resumption is None:
            request = self.request
            checkpoints.begin(
                start_record(
                    request.sequence, sequence, self.config, self.earlier, request.localize_only, request.evaluate,
                    request.loss,
                )  # fmt: skip
            )
        return Checkpointing(checkpoints, every, sequence, self.observer)

    def _save(self, result: SlamResult, error: BaseException | None) -> RunOutcome:
        """Writes the folder, or if that cannot be, another one."""
        described = describe(self.request.sequence, self.sequence, self.earlier)
        lacking = _objects_notes(self.sequence, result, self.config, self.earlier)
        verdicts = self._or_note(lambda: judge(self.sequence, result, self.depth)) or []
        result.notes = doubt_movers(result.notes, verdicts)
        for text in [*LoopsRecord.of_result(result).notes(), *described.notes(), *lacking, *result.notes]:
            if text not in self.told:
                self.observer.note(text)
        names = {**_names(self.earlier), **self.sequence.instance_names}
        scored = self.request.evaluate and error is None and self._frames_stay()
        wanted = (*((MetricsRecord.FILE, "frames.csv") if scored else ()), REPORT_FILE)
        told = None if error is None else repr(error)
        try:
            run = RunToWrite(
                self.config, described, result, told, names, wanted, verdicts, loss=self.request.loss
            )  # fmt: skip
            with part("writing"):
                folder, failure = save_somewhere(self.folder, run)
            if (folder.path / "map.ply").is_file():
                self.fit = self._or_note(lambda: self._fit(result, folder))
        finally:
            result.close()
        return RunOutcome(folder, result, error=error or failure, failure=failure, verdicts=verdicts)

    def _fit(self, result: SlamResult, folder: RunFolder) -> MapFit | None:
        """How well the map shows the keyframes, or the frames that were only located in it."""
        in_view, sequence = folder.map_in_parts().in_view, self.sequence
        if self.request.localize_only and isinstance(sequence, Sequence) and not isinstance(sequence, RigSequence):
            return measure_fit(located_views(sequence, result), in_view, exposed=False)
        return measure_fit(result.keyframes, in_view)

    def _or_note(self, look: Callable[[], T]) -> T | None:
        """What a look at run, map or recording tells; None: it failed, which must not cost the run."""
        try:
            return look()
        except Exception as error:
            self.observer.note(f"the run could not be judged: {error!r}")
            return None

    @contextmanager
    def _code_within(self, outcome: RunOutcome, complete: bool) -> Iterator[bool]:
        """The run is coded while the block runs, and waited for: of streams if it is not complete yet, of containers if
        it is. Yields whether that is so."""
        request, reason = self.request.encode, outcome.error or outcome.failure
        if request is None or request.needs_complete_run is not complete:
            yield False
            return
        if reason is not None:
            self.observer.note(f"{request.out}: not written: the run did not end, or was not saved as a whole")
            yield False
            return
        encoding = RunEncoding(request, outcome.folder)
        try:
            yield True
        finally:
            with part("coding"):
                try:
                    outcome.encoded = encoding.wait()
                except GgslamError as error:
                    outcome.encode_failure = error

    def _frames_stay(self) -> bool:
        """Whether the frames of the run can be read again."""
        return isinstance(self.sequence, Sequence) or self.sequence.record is not None

    def _look_at(self, outcome: RunOutcome) -> None:
        """Scores, verdict and report; of a run that could not be saved as it should be the verdict alone."""
        kept = None
        with self._code_within(outcome, complete=False) as beside:
            if outcome.failure is None:
                kept = self._score(outcome, "scoring and coding" if beside else "scoring")
        outcome.verdict = self._or_note(lambda: self._verdict(outcome))
        if outcome.failure is not None:
            return
        if outcome.verdict is not None:
            with self.folder.change_files(RunVerdict.FILE):
                outcome.verdict.write(self.folder.path)
        outcome.energy = None if self.spent is None else EnergyRecord.of_spent(self.spent)
        outcome.latency = self._latency_record()
        counted = {"energy": outcome.energy, "latency": outcome.latency}
        if update := {name: record for name, record in counted.items() if record is not None}:
            with self.folder.change_files(TimingRecord.FILE):
                self.folder.timing().model_copy(update=update).write(self.folder.path)
        write_report(self.folder, kept)

    def _latency_record(self) -> LatencyRecord | None:
        sequence = self.sequence
        if self.latency is None:
            return None
        if isinstance(sequence, LiveSequence):
            since = sequence.since or "arrival"
            return LatencyRecord.of_meter(self.latency, since, sequence.counts(), sequence.reasons())
        return LatencyRecord.of_meter(self.latency, "due")

    def _score(self, outcome: RunOutcome, name: str) -> Sequence | None:
        """Scores a run that ended, if that was asked for and its frames can be read again; returns its recording.

        Args:
            name: of the part that this counts for.
        """
        sequence, error = self.sequence, outcome.error
        kept = sequence if isinstance(sequence, Sequence) else None if error else _kept_recording(self.folder, sequence)
        if kept is not None and len(outcome.result.moving):
            kept.moving = outcome.result.moving
        if self.request.evaluate and error is None:
            if kept is None:
                self.observer.note("not scored: the frames of a live camera are kept with `record` only")
            else:
                with part(name):
                    outcome.metrics = score_run(self.folder, kept, self.observer)
        return kept

    def _verdict(self, outcome: RunOutcome) -> RunVerdict:
        folder = outcome.folder
        table = folder.object_table() if folder.has_objects() else None
        live = self.sequence if isinstance(self.sequence, LiveSequence) else None
        recording = str(self.request.sequence.path if live is None else live.record or "")
        cut = outcome.error is not None and outcome.error is not outcome.failure
        return judge_result(
            outcome.result, outcome.verdicts, self.fit, table, outcome.metrics, recording,
            cut and not self.saw_all, cut and self.saw_all,
        )  # fmt: skip


def _inputs(recording: SequenceRequest, earlier: RunFolder | None) -> list[Path]:
    """Folders that a run reads, or keeps frames in."""
    record = recording.record if isinstance(recording, LiveRequest) else None
    named = (recording.path, recording.masks, record, None if earlier is None else earlier.path)
    return [path for path in named if path is not None]


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
