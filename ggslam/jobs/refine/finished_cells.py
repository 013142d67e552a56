# SPDX-License-Identifier: Apache-2.0
"""Keeps trained cells in a store within the store's folder, until all are trained and replace the old cells together.

    map.grid/refining/        its visits: a name made of all that the work depends on, and "finished" at its end
    map.grid/.refining-*      one that is done with, and being deleted

Whatever ends the program, the next call finds the cells that were done, or goes on putting them into the store.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from ggslam.errors import GgslamError, RunFolderError
from ggslam.jobs.submaps.stores import StoreMakingTuning
from ggslam.submaps.cell_files import wait_for_disk
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore
from ggslam.system.atomic import write_failure
from ggslam.system.links import refuse_link, remove_folder

FOLDER = "refining"
_FINISHED = "finished"
_GONE = f".{FOLDER}-*"


class CellsDone:
    """Parts of cells that wait to be put into a store.

    Args:
        store: open for writing.
        part: the part that is made anew.
    """

    def __init__(self, store: GridStore, part: str) -> None:
        self._store, self._part = store, part
        self.path = store.path / FOLDER
        self._done: GridStore | None = None
        self._cut_off = _tidy(store.path)
        if self.path.is_dir():
            try:
                self._done = GridStore.open(self.path, write=True)
            except GgslamError:  # cut off while it was made
                remove_folder(self.path)

    def close(self) -> None:
        """Lets others write to it."""
        if self._done is not None:
            self._done.close()
            self._done = None

    def is_finished(self) -> bool:
        """Whether an earlier call did all cells, and was cut off while they were put into the store, or afterwards."""
        return self._cut_off or (self._done is not None and _FINISHED in self._done.visits())

    def begin(self, work: str) -> bool:
        """Begins, or goes on with the same work; False if there was other work, which is thrown away.

        Raises:
            RunFolderError: it cannot be written.
        """
        other = self._done is not None and self._done.visits()[:1] not in ([], [work])
        if other:
            self._throw_away()
        if self._done is None:
            self._done = GridStore.create(self.path, self._store.settings)
        self._done.begin_visit(work)
        return not other

    def __contains__(self, key: CellKey) -> bool:
        return self._done is not None and key in self._done

    def put(self, key: CellKey, data: bytes, count: int) -> None:
        """A cell is done. Raises RunFolderError if it cannot be written."""
        assert self._done is not None
        self._done.put(key, {self._part: data}, counts={self._part: count})

    def finish(self) -> int:
        """Puts the cells into the store; returns how many were changed.

        Raises:
            RunFolderError: the store cannot be written; the next call goes on.
            FormatError: a cell that was done is damaged.
        """
        if self._done is None and self._cut_off:  # they are all there
            return 0
        assert self._done is not None
        self._done.begin_visit(_FINISHED)
        changed, waiting = 0, list[CellWrite]()
        for write in self._changes(self._done):
            waiting.append(write)
            changed += 1
            if len(waiting) == StoreMakingTuning.cells_at_once:
                self._store.put_cells(waiting)
                waiting = []
        self._store.put_cells(waiting)
        self._throw_away()
        return changed

    def _changes(self, done: GridStore) -> Iterator[CellWrite]:
        for key in done.cells():
            new, old = done.cell(key).parts[self._part], self._store.cell(key).parts.get(self._part)
            if old is None or (old.bytes, old.crc) != (new.bytes, new.crc):
                yield CellWrite(key, {self._part: done.get(key, self._part)}, counts={self._part: new.count})

    def _throw_away(self) -> None:
        """In one step, so that nobody finds half of it and takes it for work to go on with, or to begin anew."""
        self.close()
        refuse_link(self.path)
        gone = self.path.with_name(f".{FOLDER}-{os.getpid()}-{secrets.token_hex(4)}")
        try:
            self.path.rename(gone)
            wait_for_disk(self.path.parent)
        except OSError as error:
            raise write_failure(self.path, error) from error
        shutil.rmtree(gone, ignore_errors=True)


def is_cut_off(store: Path) -> bool:
    """Whether a call that worked on a store was cut off, be it while it tidied up."""
    return (store / FOLDER).is_dir() or any(store.glob(_GONE))


def _tidy(store: Path) -> bool:
    """Deletes what an earlier call was about to when it was cut off; whether there was something.

    Raises:
        RunFolderError: it cannot be deleted.
    """
    found = list(store.glob(_GONE))
    for left in found:
        remove_folder(left)
        if left.exists():
            raise RunFolderError(f"{left}: is not needed any more and cannot be deleted; please delete it")
    return bool(found)
