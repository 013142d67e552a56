# SPDX-License-Identifier: Apache-2.0
"""The state of each run of a batch, kept in a file beside its folder, `jobs/NAME.json`."""

from __future__ import annotations

import enum
import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from ggslam.errors import FormatError, GgslamError
from ggslam.jobs.batch.manifest import BatchJob, Manifest, model_of, option
from ggslam.runs.checkpoints import has_checkpoints
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.record import RecordFile
from ggslam.runs.records.run_json import RunRecord
from ggslam.system.atomic import make_folder
from ggslam.system.links import refuse_link
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted, printable

_log = logging.getLogger(__name__)


class LogTuning(Tuning):
    """How much of a run's log is read and shown."""

    tail_bytes = 8192
    """Bytes at the end of a log that are read."""
    line_length = 300
    """Characters of its last line that are shown."""


class State(enum.Enum):
    """Of a run."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    SKIPPED = "was done"
    """Finished by an earlier call."""
    FAILED = "failed"


class JobRecord(RecordFile):
    """What became of a run: its arguments, exit code (None: it has begun), seconds and last line."""

    FILE: ClassVar[str] = "job.json"
    words: list[str]
    exit_code: int | None = None
    seconds: float = 0.0
    line: str = ""


@dataclass
class JobState:
    """A run of a batch.

    Attributes:
        job: which.
        out: folder of the batch.
        state: how far it is.
        line: why it failed.
        seconds: that it took.
        begun: when it was seen to be at work first, seconds since 1970.
    """

    job: BatchJob
    out: Path
    state: State = State.WAITING
    line: str = ""
    seconds: float = 0.0
    begun: float = 0.0

    @property
    def run(self) -> Path:
        """Folder of the run."""
        return self.out / "runs" / self.job.name

    @property
    def log(self) -> Path:
        """What the run printed."""
        return self._beside / "log.txt"

    @property
    def _beside(self) -> Path:
        return self.out / "jobs" / self.job.name

    def last_line(self) -> str:
        """The error that the run printed, or else the last thing it said."""
        try:
            with open_untrusted(self.log) as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - LogTuning.tail_bytes))
                text = file.read(LogTuning.tail_bytes).decode(errors="replace")
        except (OSError, FormatError):
            return ""
        lines = [line.strip() for line in text.splitlines()]
        errors = [line.removeprefix("error:").strip() for line in lines if line.startswith("error:")]
        said = errors or [line for line in lines if line]
        return printable(said[-1][:LogTuning.line_length]) if said else ""

    def memory(self) -> JobRecord | None:
        """What an earlier call noted of a run with the same arguments."""
        try:
            record = JobRecord.read_if_there(self._beside)
        except GgslamError as error:
            _log.warning("warning: %s; the run is made again", error)
            return None
        return record if record is not None and tuple(record.words) == self.job.words else None

    def is_whole(self) -> bool:
        """Whether the run's folder has all that was asked for, scores too."""
        try:
            mark = RunRecord.read_if_there(self.run)
            return mark is not None and mark.complete and MetricsRecord.read_if_there(self.run) is not None
        except GgslamError:
            return False

    def arguments(self) -> list[str]:
        """Of `ggslam`: to go on with a run that was cut off, else to make it anew."""
        record = self.memory()
        if record is not None and record.exit_code is None and has_checkpoints(self.run):
            model = model_of(self.job.words)
            return ["run", option("resume"), str(self.run), *([option("set"), f"masks.model={model}"] if model else [])]
        return ["run", *self.job.words, option("out"), str(self.run), option("overwrite")]

    def begin(self) -> None:
        """Notes what is begun.

        Raises:
            RunFolderError: there is a link among the batch's folders, which would lead the run elsewhere.
        """
        for path in (self.run, self.log):
            parts = path.relative_to(self.out).parts
            for depth in range(1, len(parts) + 1):
                refuse_link(self.out.joinpath(*parts[:depth]))
        make_folder(self._beside)
        JobRecord.of({"words": list(self.job.words)}).write(self._beside)
        self.see_begun()

    def see_begun(self) -> None:
        """The run is at work, here or elsewhere."""
        if self.state is not State.RUNNING:
            self.state, self.begun = State.RUNNING, time.time()

    def end(self, exit_code: int, seconds: float, line: str) -> None:
        """Notes what became of it."""
        self.seconds, whole = seconds, exit_code in (0, 3) and self.is_whole()
        self.state, self.line = (State.DONE, "") if whole else (State.FAILED, line or f"exit code {exit_code}")
        JobRecord.of(
            {"words": list(self.job.words), "exit_code": exit_code, "seconds": seconds, "line": self.line}
        ).write(self._beside)


def states_of(manifest: Manifest, retry: bool) -> list[JobState]:
    """All runs of a batch: those that are done are skipped, those that failed stay failed unless `retry`."""
    states = [JobState(job, manifest.out) for job in manifest.jobs]
    for state in states:
        record = state.memory()
        if record is None or record.exit_code is None:
            continue
        if record.exit_code in (0, 3) and state.is_whole():
            state.state, state.seconds = State.SKIPPED, record.seconds
        elif not retry and record.exit_code not in (0, 3):
            state.state, state.line = State.FAILED, record.line
    return states
