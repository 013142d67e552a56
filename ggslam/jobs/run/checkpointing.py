# SPDX-License-Identifier: Apache-2.0
"""Decides when a run saves its state, and saves what resuming needs."""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ggslam import __version__
from ggslam.errors import GgslamError, RunFolderError
from ggslam.jobs.progress import Observer
from ggslam.runs.checkpoints import Checkpoints
from ggslam.runs.environment import environment
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe, fingerprint, identity_of
from ggslam.runs.records.start import VERSION, StartRecord, hash_of
from ggslam.scene.frame import Frame
from ggslam.sequences import Sequence
from ggslam.sequences.sequence import SkippedFrame
from ggslam.slam.config import Config, config_to_dict
from ggslam.slam.slam import Slam
from ggslam.system.spent import part
from ggslam.system.tuning import Tuning


class CheckpointIntervalTuning(Tuning):
    """How often a run saves its state if the settings leave it open."""

    share = 1 / 80
    """Largest share of the run's time that saving takes."""
    min_interval_s = 3.0
    """Shortest time between two checkpoints, in seconds."""
    bytes_per_s = 3e8
    """Speed of saving that is assumed until the first checkpoint was timed, in bytes per second."""


class Checkpointing:
    """Saves the state of a run now and then.

    Args:
        checkpoints: of the run.
        every: frames from one to the next; None: as often as takes no more than `CheckpointIntervalTuning.share` of
            the time;
            0: only when the run ends early.
        sequence: the recording.
        observer: receives a note if a checkpoint cannot be saved; the run continues.
    """

    def __init__(self, checkpoints: Checkpoints, every: int | None, sequence: Sequence, observer: Observer) -> None:
        self._checkpoints, self._every, self._sequence, self._observer = checkpoints, every, sequence, observer
        self._frames, self._told = 0, False
        self._last = time.perf_counter()
        self._bytes_a_second = CheckpointIntervalTuning.bytes_per_s
        self._sizes = _FileSizes(sequence)
        self._newest: Frame | None = None

    def after(self, slam: Slam, frame: Frame | None) -> None:
        """Between two steps: saves if it is time to. `frame` is the one that was just processed, if one was."""
        if frame is not None:
            self._frames, self._newest = self._frames + 1, frame
        if self._is_due(slam):
            self.save(slam)

    def _is_due(self, slam: Slam) -> bool:
        if self._every is not None:
            return 0 < self._every <= self._frames
        passed = time.perf_counter() - self._last
        return (
            passed > CheckpointIntervalTuning.min_interval_s
            and CheckpointIntervalTuning.share * passed > _size_of(slam) / self._bytes_a_second
        )

    @part("checkpoints")
    def save(self, slam: Slam) -> None:
        """Saves the state between two steps. If that fails it is said, once, and the run goes on."""
        if not slam.mapper.keyframes:
            return
        start = time.perf_counter()
        slam.times.saved += 1
        try:
            self._checkpoints.save(slam, self._beside())
        except (GgslamError, OSError) as error:
            if not self._told:
                self._observer.note(f"no checkpoint: {error}; the run goes on")
            self._told = True
        self._last = time.perf_counter()
        took = self._last - start
        self._frames, self._bytes_a_second = 0, max(_size_of(slam), 1) / max(took, 1e-3)
        slam.times.checkpoints += took

    def _beside(self) -> dict[str, Any]:
        """What is saved besides the state: how far the recording was read, and what it was like so far."""
        last = -1 if self._newest is None else self._newest.index
        return {
            "next": last + 1, "sizes": self._sizes.up_to(last + 1), "image": _image_of(self._newest),
            "skipped": [asdict(frame) for frame in self._sequence.skipped_frames],
            "mask_problems": [[index, reason] for index, reason in self._sequence.mask_problems.items()],
        }  # fmt: skip

    def go_on(self, beside: dict[str, Any]) -> int:
        """The recording is where it was when this was saved; returns the frame that comes next.

        Raises:
            RunFolderError: it is another one now.
        """
        begin = int(beside["next"])
        sequence = self._sequence
        if begin:
            self._newest = sequence.frame(begin - 1, masks=False) if begin <= len(sequence) else None
            same = _image_of(self._newest) == beside["image"] and self._sizes.up_to(begin) == beside["sizes"]
            if not same:
                raise RunFolderError(
                    f"{sequence.path}: changed since the run was cut off: its frames 0 to {begin - 1} are others now"
                )
        skipped = [SkippedFrame(**values) for values in beside["skipped"]]
        sequence.go_on_after(skipped, {int(index): str(reason) for index, reason in beside["mask_problems"]})
        return begin


def _size_of(slam: Slam) -> float:
    """Bytes of a state, about: nearly all of them are the map's."""
    return slam.map.count * slam.map.bytes_per_gaussian + 4e6


def _image_of(frame: Frame | None) -> str | None:
    if frame is None:
        return None
    return hashlib.sha256(frame.color.tobytes() + frame.depth.tobytes()).hexdigest()


class _FileSizes:
    """A sum over the sizes of the files of the first frames, continued as they get more."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence, self._count, self._sum = sequence, 0, hashlib.sha256()

    def up_to(self, count: int) -> str:
        """Of the frames before `count`, which never falls."""
        for index in range(self._count, count):
            files = self._sequence.files(index)
            for file in (files.color, files.depth, files.mask, files.confidence):
                size = file.stat().st_size if isinstance(file, Path) and file.exists() else -1
                self._sum.update(b"%d " % size)
        self._count = max(count, self._count)
        return self._sum.hexdigest()


def start_record(
    request: SequenceRequest, sequence: Sequence, config: Config, earlier: RunFolder | None, localize_only: bool,
    evaluate: bool, loss: str | None = None,
) -> StartRecord:  # fmt: skip
    """What a run is asked to do."""
    values = config_to_dict(config)
    return StartRecord.of({
        "version": VERSION, "ggslam": __version__,
        "open": describe(request, sequence).open.model_dump(), "recording": identity_of(sequence),
        "config": values, "config_hash": hash_of(values), "evaluate": evaluate,
        "map": None if earlier is None else earlier.path.absolute(),
        "map_fingerprint": None if earlier is None else fingerprint(earlier), "localize_only": localize_only,
        "loss": loss,
        "environment": environment(config.threads),
    })  # fmt: skip
