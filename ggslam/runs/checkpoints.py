# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a run, in the folder `checkpoints` of its folder: what it takes to go on after a crash.

    start.json         what the run was asked to do
    state-000012.bin   the state after some frame; the newest two are kept
    kept-000012.bin    what never changes and was new then (images, points and features of keyframes, poses of frames)

A file appears under its name when it is on the disk as a whole; each has a sum, and a state knows the sums of the files
that it needs. So whatever ends the program, the newest state that is there and whole is good.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import FormatError, RunFolderError
from ggslam.runs.records.start import VERSION, StartRecord
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam
from ggslam.system.array_file import PendingFile, WrittenFile, read_array_file, write_array_file
from ggslam.system.atomic import make_folder, sync_folder
from ggslam.system.kept_arrays import KeptArrays
from ggslam.system.links import refuse_link, refuse_links_below, remove_folder
from ggslam.system.tuning import Tuning

FOLDER = "checkpoints"
_STATE = re.compile(r"state-(\d{6,})\.bin")
_KEPT = re.compile(r"kept-(\d{6,})\.bin")


class CheckpointTuning(Tuning):
    """How many states are kept."""

    states = 2
    """Newest states that are kept."""


def has_checkpoints(run: Path) -> bool:
    """Whether a run's folder has what it takes to go on with it."""
    return (run / FOLDER / StartRecord.FILE).is_file()


@dataclass(frozen=True)
class _State:
    """A state as it was read."""

    number: int
    values: dict[str, Any]
    arrays: list[np.ndarray]
    kept: KeptArrays


class Checkpoints:
    """The checkpoints of one run.

    Args:
        run: the run's folder.

    Raises:
        RunFolderError: its folder of checkpoints, or something in it, is a link.
    """

    def __init__(self, run: Path) -> None:
        self.folder = run / FOLDER
        refuse_links_below(self.folder)
        self._kept = KeptArrays(self.folder)
        self._number = 0
        self._states: list[int] = []
        """Numbers of the states that are there, rising."""
        self._helper: ThreadPoolExecutor | None = None
        self._finishing: Future[None] | None = None

    # --- writing -----------------------------------------------------------------------------------------------------

    def begin(self, start: StartRecord) -> None:
        """Makes the folder; what an earlier run left there goes.

        Raises:
            RunFolderError: it cannot be written to.
        """
        self.remove()
        make_folder(self.folder)
        start.write(self.folder)

    def save(self, slam: Slam, more: dict[str, Any]) -> None:
        """Writes the state of a run between two steps. Another thread waits for the disk.

        Args:
            slam: the run.
            more: plain values to be given back with it.

        Raises:
            RunFolderError: this state or the one before could not be written; earlier ones are there still.
        """
        self.settle()
        refuse_link(self.folder)
        self._number += 1
        self._kept.begin(self._number)
        tree, arrays = describe_state(slam, self._kept)
        kept = self._kept.write()
        known = {**self._kept.files, **({} if kept is None else {self._number: kept.written})}
        files = [[number, known[number].size, known[number].crc] for number in sorted(self._kept.used)]
        values = {"version": VERSION, "state": tree, "kept": files, "more": more}
        try:
            state = write_array_file(self._path(self._number), values, arrays)
        except BaseException:
            if kept is not None:
                kept.discard()
            raise
        self._kept.commit(kept)
        if self._helper is None:
            self._helper = ThreadPoolExecutor(1, thread_name_prefix="checkpoints")
        self._finishing = self._helper.submit(self._finish, self._number, state, kept)

    def _path(self, number: int) -> Path:
        return self.folder / f"state-{number:06d}.bin"

    def _finish(self, number: int, state: PendingFile, kept: PendingFile | None) -> None:
        """Waits for the disk, and removes states that are older than the newest two."""
        if kept is not None:
            kept.finish()
        state.finish()
        sync_folder(self.folder)
        self._states.append(number)
        for old in self._states[: -CheckpointTuning.states]:
            self._path(old).unlink(missing_ok=True)
        del self._states[: -CheckpointTuning.states]

    def settle(self) -> None:
        """Waits until the last state is on the disk.

        Raises:
            RunFolderError: it could not be written.
        """
        finishing, self._finishing = self._finishing, None
        if finishing is None:
            return
        try:
            finishing.result()
        except BaseException:
            # What the state's file of kept arrays was to hold is written again with the next state.
            self._kept = KeptArrays(self.folder)
            raise

    def close(self) -> None:
        """Ends the other thread, after what it was given: nothing is written or removed afterwards."""
        if self._helper is not None:
            self._helper.shutdown()
            self._helper = None

    def remove(self) -> None:
        """Removes all of it: the run is complete."""
        self.close()
        remove_folder(self.folder)

    # --- reading -----------------------------------------------------------------------------------------------------

    def start(self) -> StartRecord:
        """What the run was asked to do.

        Raises:
            RunFolderError: there are no checkpoints, or the record is damaged.
        """
        return StartRecord.read(self.folder)

    def restore(self, slam: Slam, note: Callable[[str], None]) -> dict[str, Any]:
        """Brings a fresh `Slam` to the newest state that is whole; saving goes on after it.

        Args:
            slam: of the same recording and settings.
            note: is told of states that are damaged.

        Returns:
            The plain values that `save` was given; empty if there is no state yet: the run begins anew.

        Raises:
            RunFolderError: no state is whole.
        """
        problems: list[str] = []
        for state in self._newest(problems.append):
            try:
                restore_state(slam, state.values["state"], state.arrays, state.kept)
            except FormatError as error:
                raise RunFolderError(f"{self._path(state.number)}: {error}") from None
            for problem in problems:
                note(f"{problem}; going on from the checkpoint before")
            self._go_on_after(state)
            return dict(state.values["more"])
        if problems:
            raise RunFolderError(f"no checkpoint is whole: {problems[0]}")
        return {}

    def _go_on_after(self, state: _State) -> None:
        """The next state is written after this one; those that were damaged go."""
        self._kept = state.kept
        self._kept.close()
        there = self._numbers(_STATE)
        self._number = max([state.number, *there, *self._numbers(_KEPT)])
        self._states = sorted(number for number in there if number <= state.number)
        for number in there:
            if number > state.number:
                self._path(number).unlink(missing_ok=True)

    def _newest(self, tell: Callable[[str], None]) -> Iterator[_State]:
        """States that are whole, the newest first; of others it is told what is wrong."""
        for number in sorted(self._numbers(_STATE), reverse=True):
            kept = KeptArrays(self.folder)
            try:
                values, arrays = read_array_file(self._path(number))
                if values["version"] != VERSION:
                    raise FormatError(f"{self.folder}: made by another version of ggslam")
                kept.open({n: WrittenFile("", size, crc) for n, size, crc in values["kept"]})
                state = _State(number, values, arrays, kept)
            except FormatError as error:
                tell(str(error))
            except (LookupError, TypeError, ValueError) as error:
                tell(f"{self.folder}: state {number} is damaged: {error!r}")
            else:
                yield state

    def _numbers(self, pattern: re.Pattern[str]) -> list[int]:
        names = [path.name for path in self.folder.iterdir()] if self.folder.is_dir() else []
        return [int(match[1]) for name in names if (match := pattern.fullmatch(name))]
