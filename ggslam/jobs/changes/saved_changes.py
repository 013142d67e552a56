# SPDX-License-Identifier: Apache-2.0
"""Reads a folder that `ggslam changes` wrote, and describes the changes for pages."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError, RunFolderError
from ggslam.objects.history import History
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.changes import ChangeRecord, ChangesRecord
from ggslam.runs.writing import CHANGES_FOLDER
from ggslam.scene.oriented_box import Vector
from ggslam.system.images import PictureLimits, read_picture
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import refuse_links


class SavedChangesTuning(Tuning):
    """How many pictures of changes are read."""

    pictures = 12
    """Pictures that a page shows."""
    max_pixels = 16_000_000
    """Largest picture that is read, in pixels: two views of 8 megapixels. `PictureLimits.max_pixels` limits the whole
    page."""


@dataclass(frozen=True)
class ChangesShown:
    """What a page shows of changes.

    Attributes:
        record: changes.json.
        pictures: both visits with boxes, uint8 [H, W, 3], by the number of the change.
        history: of the run's objects; None: it has none.
        middles: [3] of the run's objects, world, by id: where they are now.
        left_out: changes whose pictures are there and not shown.
        unreadable: names of pictures that are missing or damaged.
    """

    record: ChangesRecord
    pictures: dict[int, np.ndarray] = field(default_factory=dict)
    history: History | None = None
    middles: dict[int, Vector] = field(default_factory=dict)
    left_out: int = 0
    unreadable: list[str] = field(default_factory=list)


def changes_of(folder: RunFolder, most: int = SavedChangesTuning.pictures) -> ChangesShown | None:
    """What `ggslam update` noted in a run's folder, with so many pictures; None: it is no updated run.

    Raises:
        RunFolderError, FormatError: a file is damaged.
    """
    place = folder.path / CHANGES_FOLDER
    if not (place / ChangesRecord.FILE).is_file():
        return None
    shown = read_changes(place, most)
    if not folder.has_objects():
        return shown
    table = folder.object_table()
    middles = {record.id: record.centroid for record in table.objects}
    return ChangesShown(shown.record, shown.pictures, table.history, middles, shown.left_out, shown.unreadable)


def read_changes(place: Path, most: int = SavedChangesTuning.pictures) -> ChangesShown:
    """A folder that `ggslam changes` wrote, with so many pictures.

    Raises:
        ConfigError: there is no changes.json.
        RunFolderError: it is damaged, or holds a link out of it or what is no regular file.
    """
    refuse_links(place, RunFolderError)
    record = ChangesRecord.read_if_there(place)
    if record is None:
        raise ConfigError(f"{place}: holds no {ChangesRecord.FILE}; `ggslam changes OLD NEW --out FOLDER` writes one")
    named = [number for number, change in enumerate(record.changes) if change.picture]
    found, unreadable, left = dict[int, np.ndarray](), list[str](), PictureLimits.max_pixels
    for number in named[:most]:
        name = Path(record.changes[number].picture).name
        try:
            found[number] = read_picture(place / name, min(SavedChangesTuning.max_pixels, left), RunFolderError)
        except RunFolderError:
            unreadable.append(name)  # without it the table still tells
        else:
            left -= found[number].shape[0] * found[number].shape[1]
    return ChangesShown(record, found, left_out=len(named[most:]), unreadable=unreadable)


def word_of_kind(change: ChangeRecord) -> str:
    """What happened, for people."""
    return "changed its look" if change.kind == "look" else change.kind


def motion_words(change: ChangeRecord) -> tuple[str, str]:
    """How far something moved, cm, and how far it turned, degrees; "-" of what did not."""
    if change.moved_m is None or change.turned_deg is None:
        return "-", "-"
    return f"{100 * change.moved_m:.1f}", f"{change.turned_deg:.1f}" if change.turn_known else "not known"


def sentence_of(change: ChangeRecord) -> str:
    """A change in a line."""
    by, turned = motion_words(change)
    motion = ""
    if by != "-":
        motion = f" by {by} cm, turn {turned}" if turned == "not known" else f" by {by} cm, turned by {turned} deg"
    return f"{change.name}: {word_of_kind(change)}{motion}"
