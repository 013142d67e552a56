# SPDX-License-Identifier: Apache-2.0
"""The objects that a grid store knows, and what each visit found of them: one file beside the cells.

    objects.json      written whole, after the cells of a visit

A visit that was cut off before has cells and is not in the file; so have stores of older programs no file.
"""

from __future__ import annotations

import json
from dataclasses import asdict, field
from typing import Annotated, Final, Literal

import numpy as np
import pydantic
from pydantic.dataclasses import dataclass

from ggslam.errors import FormatError
from ggslam.scene.object_names import object_label
from ggslam.scene.oriented_box import Number, OrientedBox, Vector
from ggslam.scene.poses import motion_of, to_matrix
from ggslam.submaps.cell_keys import LIMIT
from ggslam.submaps.grid import GridStore
from ggslam.system.atomic import write_bytes
from ggslam.system.untrusted_files import FileTuning, read_untrusted

OBJECTS_FILE = "objects.json"
VERSION: Final = 1
"""Version of the file's format."""
Kind = Literal["added", "removed", "moved", "look", "unseen"]
_Coordinate = Annotated[int, pydantic.Field(ge=-LIMIT, le=LIMIT)]
_Cell = tuple[_Coordinate, _Coordinate, _Coordinate]
_Row = tuple[Number, Number, Number, Number]
FiniteMatrix = tuple[_Row, _Row, _Row, _Row]


@dataclass(frozen=True)
class StoredObject:
    """An object of a store; also one that is gone.

    Attributes:
        id: 1 to 65535.
        name: None if nobody named it.
        box: as the last run that saw it had it, store's world.
        gaussians: how many of the cells' Gaussians are its.
        cells: those that they lie in, sorted.
        first_seen, last_seen: visits.
        gone_since: the visit that found it gone; None: it is there, as far as is known.
    """

    id: Annotated[int, pydantic.Field(ge=1, le=65535)]
    name: str | None
    box: OrientedBox
    gaussians: Annotated[int, pydantic.Field(ge=0)]
    cells: list[_Cell]
    first_seen: str
    last_seen: str
    gone_since: str | None = None

    def label(self) -> str:
        """For people."""
        return object_label(self.id, self.name)


@dataclass(frozen=True)
class ObjectEvent:
    """What a visit found of an object.

    Attributes:
        kind: what happened to it; unseen: the visit hardly looked at it, and nothing is claimed.
        id: None: something without an id.
        name: None if nobody named it.
        cells: that hold it, or held it before, sorted.
        middle: of it before, metres, store's world; None: it was not there, or has no id.
        T_new_old: of what moved: point now = `T_new_old` times point before, store's world.
        turn_known: whether its turn is known; None: not told.
        confidence: 0 to 1; None: not told.
        look: whether its colours changed.
    """

    kind: Kind
    id: int | None
    name: str | None
    cells: list[_Cell] = field(default_factory=list)
    middle: Vector | None = None
    T_new_old: FiniteMatrix | None = None
    turn_known: bool | None = None
    confidence: float | None = None
    look: bool = False

    def label(self) -> str:
        """For people."""
        if self.id is None:
            return self.name or "something without an id"
        return object_label(self.id, self.name)

    def motion(self) -> tuple[float, float] | None:
        """Metres that its middle went and degrees that it turned; None: it did not move, or its middle is unknown."""
        if self.T_new_old is None or self.middle is None:
            return None
        return motion_of(np.array(self.T_new_old), np.array(self.middle))


@dataclass(frozen=True)
class VisitObjects:
    """What a visit found.

    Attributes:
        visit: its name.
        run: folder of the run that filled it.
        states: fingerprints of the runs whose visits its map shows, oldest first.
        compared: how its objects were compared with those before: there were none (`first`), by the history of an
            updated run, by the maps of two runs, or not at all (None).
        own_ids: whether its ids are unrelated to the store's; its objects are not listed then.
        events: what happened.
        notes: what is to be known.
    """

    visit: str
    run: str
    states: list[str]
    compared: Literal["first", "history", "runs"] | None
    own_ids: bool = False
    events: list[ObjectEvent] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class StoreObjects:
    """Content of the file: visits in the order of time, objects by rising id."""

    version: int = VERSION
    visits: list[VisitObjects] = field(default_factory=list)
    objects: list[StoredObject] = field(default_factory=list)

    def present(self) -> list[StoredObject]:
        """Objects that are there, as far as is known."""
        return [known for known in self.objects if known.gone_since is None]

    def events_since(self, visits: list[str]) -> list[ObjectEvent]:
        """What these visits together did to each object, by rising id; what came and went is left out."""
        by_id: dict[int, list[ObjectEvent]] = {}
        nameless: list[ObjectEvent] = []
        for entry in self.visits:
            for event in entry.events if entry.visit in visits else []:
                if event.id is None:
                    nameless.append(event)
                else:
                    by_id.setdefault(event.id, []).append(event)
        joined = [join_events(by_id[i]) for i in sorted(by_id)]
        return [event for event in joined if event is not None] + nameless


def join_events(events: list[ObjectEvent]) -> ObjectEvent | None:
    """What several visits, in the order of time, did to one object together; None: it came and went."""
    first, last = events[0], events[-1]
    told = [event for event in events if event.kind != "unseen"]
    cells = sorted({key for event in events for key in event.cells})
    if not told:
        return ObjectEvent("unseen", last.id, last.name, cells, first.middle)
    came, gone = told[0].kind == "added", told[-1].kind == "removed"
    if came and gone:
        return None
    if came or gone:
        kind: Kind = "added" if came else "removed"
        middle = None if came else told[0].middle
        return ObjectEvent(kind, last.id, last.name, cells, middle, confidence=_least(told))
    T, moves = np.eye(4), [event for event in told if event.T_new_old is not None]
    for event in moves:
        T = np.array(event.T_new_old) @ T
    look = any(event.look for event in told)
    if any(event.kind in ("added", "removed") for event in told):  # away for a while: how it lies now is not told
        return ObjectEvent("moved", last.id, last.name, cells, None, None, None, _least(told), look)
    turns = [event.turn_known for event in moves]
    turn = False if False in turns else None if None in turns or not turns else True
    matrix = to_matrix(T) if moves else None
    return ObjectEvent(
        "moved" if moves else "look", last.id, last.name, cells, told[0].middle, matrix, turn, _least(told), look
    )


def _least(events: list[ObjectEvent]) -> float | None:
    told = [event.confidence for event in events if event.confidence is not None]
    return min(told) if told else None


def read_objects(store: GridStore) -> StoreObjects | None:
    """What a store knows of objects; None: nothing, as no run with objects filled it or it is of an older program.

    Raises:
        FormatError: the file is damaged, or of a newer program.
    """
    path = store.path / OBJECTS_FILE
    if path.is_symlink():
        raise FormatError(f"{path}: is a link; a store holds none")
    if not path.exists():
        return None
    return parse_objects(read_untrusted(path, FileTuning.max_text_bytes), str(path))


def parse_objects(content: bytes, path: str) -> StoreObjects:
    """The content of the file; `path` is for messages. Raises FormatError as `read_objects`."""
    try:
        values = json.loads(content)
        if isinstance(values, dict) and values.get("version") != VERSION:
            raise ValueError(f"version {values.get('version')!r:.20}, this program reads version {VERSION}")
        return pydantic.TypeAdapter(StoreObjects).validate_python(values)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "top level"
        raise FormatError(f"{path}: {place}: {first['msg']}") from None
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: cannot be read: {error}") from None


def write_objects(store: GridStore, objects: StoreObjects) -> None:
    """Writes the file of a store that is open for writing.

    Raises:
        RunFolderError: it cannot be written.
    """
    write_bytes(store.path / OBJECTS_FILE, objects_to_bytes(objects), fsync=True, follow=False)


def objects_to_bytes(objects: StoreObjects) -> bytes:
    """Content of the file."""
    return json.dumps(asdict(objects), indent=1).encode()
