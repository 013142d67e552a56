# SPDX-License-Identifier: Apache-2.0
"""What a store remembers of a run that filled it: its recording, settings and keyframes, so that cells can be trained,
and their surfaces fused, from the images again."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection
from functools import lru_cache

from ggslam.errors import ConfigError, GgslamError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recorded
from ggslam.runs.records.visit import VisitRecord
from ggslam.sequences import Sequence
from ggslam.slam.config import config_to_dict
from ggslam.submaps.grid import GridStore
from ggslam.submaps.visit_files import read_visit, visit_file, write_visit
from ggslam.system.untrusted_files import printable

_log = logging.getLogger(__name__)


def remember_run(store: GridStore, folder: RunFolder) -> None:
    """Writes the record of the visit that was begun. A run whose own records are damaged can be stored, but not be
    trained any further.

    Raises:
        RunFolderError: the record cannot be written.
    """
    try:
        record = _record_of(folder)
    except GgslamError as error:
        _log.warning("warning: %s; what is stored of the run cannot be refined", printable(str(error)))
        return
    write_visit(store, json.dumps(record.values()).encode())


def _record_of(folder: RunFolder) -> VisitRecord:
    record = folder.keyframes()
    known = [keyframe for keyframe in record.keyframes if keyframe.frame != FROM_EARLIER_RUN]
    return VisitRecord(
        run=str(folder.path.absolute()), sequence=folder.sequence(), config=config_to_dict(folder.config()),
        keyframes=known, poses=record.poses(),
    )  # fmt: skip


def read_record(store: GridStore, visit: str) -> VisitRecord | None:
    """The record of a visit; None: it has none, because it was no run or the store is older.

    Raises:
        FormatError: it is damaged.
    """
    data = read_visit(store, visit)
    return None if data is None else VisitRecord.parse(data, str(visit_file(store.path, visit)))


def records_of_store(store: GridStore, visits: Collection[str | None] | None = None) -> list[VisitRecord]:
    """What is known of the runs that filled a store, in the order of their visits.

    Args:
        store: open.
        visits: those to look at; None: all.

    Raises:
        ConfigError: nothing, or the recording of one is not there any more; says which.
        FormatError: a record is damaged.
    """
    records = []
    for visit in store.visits():
        record = read_record(store, visit) if visits is None or visit in visits else None
        if record is None:
            continue
        try:
            open_recorded(record.sequence, record.run)
        except GgslamError as error:
            raise ConfigError(f"{store.path}: the recording of visit {visit!r} is needed: {error}") from None
        records.append(record)
    if not records:
        raise ConfigError(
            f"{store.path}: nothing is known of the recordings that it is from: make it again from its runs"
        )
    return records


def recording_text(record: VisitRecord) -> str:
    """What a worker needs to open the recording of a visit: JSON of the record, without the poses of all frames."""
    return json.dumps(record.model_copy(update={"poses": {}}).values())


@lru_cache(maxsize=8)
def recording_of(text: str) -> Sequence:
    """The recording that `recording_text` tells of; a process opens it once.

    Raises:
        GgslamError: it cannot be read.
    """
    known = VisitRecord.parse(text, "visit")
    try:
        return open_recorded(known.sequence, known.run)
    except OSError as error:
        raise GgslamError(f"{known.run}: its recording cannot be read: {error}") from None
