# SPDX-License-Identifier: Apache-2.0
"""The history of objects from visit to visit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import pydantic

from ggslam.scene.poses import Matrix, to_matrix

Number = Annotated[int, pydantic.Field(ge=0)]
"""Of a visit in `History.visits`."""
_UNMOVED: Matrix = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))


@dataclass(frozen=True)
class VisitRecord:
    """A visit: the folder of its run, and the fingerprint that tells this run from another one in the same folder."""

    run: str
    fingerprint: str


@dataclass(frozen=True)
class ObjectPast:
    """An object from visit to visit.

    Attributes:
        id: 1 to 65535.
        name: None if nobody named it.
        first_seen, last_seen: visits.
        gone_since: the visit that found it gone; None: it is there, as far as is known.
        T_now_first: 4x4 by the number of each visit that saw the object: how it lay then against where it was first
            seen, world of the map: point then = `T_now_first` times point at first.
    """

    id: Annotated[int, pydantic.Field(ge=1, le=65535)]
    name: str | None
    first_seen: Number
    last_seen: Number
    gone_since: Number | None = None
    T_now_first: dict[Number, Matrix] = field(default_factory=dict)


@dataclass(frozen=True)
class History:
    """What became of objects; those that are gone are in it, too.

    Attributes:
        visits: in the order of time.
        objects: by rising id.
    """

    visits: list[VisitRecord] = field(default_factory=list)
    objects: list[ObjectPast] = field(default_factory=list)

    @staticmethod
    def of_first(visit: VisitRecord, names: Mapping[int, str | None]) -> History:
        """After one visit, which saw these objects, by id."""
        objects = [ObjectPast(i, name, 0, 0, T_now_first={0: _UNMOVED}) for i, name in sorted(names.items())]
        return History([visit], objects)

    def ids_gone(self) -> set[int]:
        """Objects that are not there any more."""
        return {past.id for past in self.objects if past.gone_since is not None}

    def after_visit(
        self, visit: VisitRecord, seen: Mapping[int, str | None], gone: Iterable[int],
        T_new_old: Mapping[int, np.ndarray],
    ) -> History:  # fmt: skip
        """After one visit more.

        Args:
            visit: the visit.
            seen: names of the objects that it saw, by id.
            gone: ids of objects that it found gone.
            T_new_old: [4, 4] of those of the former that it found moved.
        """
        number, past = len(self.visits), {p.id: p for p in self.objects}
        for i, name in seen.items():
            own = past.get(i, ObjectPast(i, name, number, number))
            T = np.array(own.T_now_first[own.last_seen]) if own.T_now_first else np.eye(4)
            now = {**own.T_now_first, number: to_matrix(T_new_old[i] @ T if i in T_new_old else T)}
            past[i] = replace(own, name=own.name or name, last_seen=number, gone_since=None, T_now_first=now)
        for i in set(gone) & set(past):
            past[i] = replace(past[i], gone_since=number)
        return History([*self.visits, visit], [past[i] for i in sorted(past)])
