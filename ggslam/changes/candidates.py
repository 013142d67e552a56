# SPDX-License-Identifier: Apache-2.0
"""Candidates for changes: objects of a visit's map, or parts of it that are gone where objects are unknown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ggslam.changes.settings import ChangeSettings
from ggslam.changes.sightings import Evidence

UNNAMED: Final = 1 << 16
"""First label of candidates without an object id: ids are 16 bits."""


@dataclass
class Candidate:
    """Something in the map of one visit.

    Attributes:
        label: an object's id, or from `UNNAMED` on.
        ids: objects of the map that it is made of.
        rows: int [n], its points among those of the visit.
        seen: share of it that the other visit could judge.
        changed: share of that which is not there in the other visit.
        color_apart: how much its colours differ from what the other visit saw at the same places, brightness of the
            whole apart; NaN: it saw nothing there.
    """

    label: int
    ids: tuple[int, ...]
    rows: np.ndarray
    seen: float
    changed: float
    color_apart: float

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class JudgedSurface:
    """The surfaces of a visit's map, and what the other visit saw of them.

    Attributes:
        points: float64 [n, 3], world.
        colors: float32 [n, 3] in [0, 1].
        toward: float32 [n, 3], mean of the unit vectors to the cameras that saw it.
        ids: int64 [n], objects; 0 = none.
        other: what the other visit saw there.
        within: float64 [n], how near surfaces have to be there to be one, metres.
    """

    points: np.ndarray
    colors: np.ndarray
    toward: np.ndarray
    ids: np.ndarray
    other: Evidence
    within: np.ndarray

    def thing(self, label: int, ids: tuple[int, ...], rows: np.ndarray, settings: ChangeSettings) -> Candidate:
        """Some rows as a thing."""
        other = self.other.at(rows)
        gone, there = other.is_gone(settings.min_views), other.is_there(settings.min_views)
        judged = int(gone.sum() + there.sum())
        apart = color_apart(self.colors[rows[there]], other.color[there])
        return Candidate(label, ids, rows, judged / max(1, len(rows)), int(gone.sum()) / max(1, judged), apart)

    def extent(self, thing: Candidate) -> float:
        """A thing's size: the diagonal of the box that holds the middle nine tenths of it, metres."""
        low, high = np.percentile(self.points[thing.rows], [5, 95], axis=0)
        return float(np.linalg.norm(high - low))


def candidates_by_id(judged: JudgedSurface, settings: ChangeSettings) -> list[Candidate]:
    """Every object of the map as a thing, and what is gone of what belongs to none."""
    found = []
    for i in np.unique(judged.ids[judged.ids > 0]).tolist():
        rows = np.flatnonzero(judged.ids == i)
        if len(rows) >= settings.min_points:
            found.append(judged.thing(i, (i,), rows, settings))
    return found + _gone_parts(judged, judged.ids == 0, settings)


def candidates_by_surface(judged: JudgedSurface, settings: ChangeSettings) -> list[Candidate]:
    """What is gone, in connected pieces, each with the whole of those objects that are gone for the most part: an
    object that one visit cut in two is one thing, and of one that the visit took for one with the table the part that
    is gone. Objects that stayed follow, for their looks."""
    found = _gone_parts(judged, np.ones(len(judged.ids), bool), settings)
    taken = {i for thing in found for i in thing.ids}
    for i in np.unique(judged.ids[judged.ids > 0]).tolist():
        rows = np.flatnonzero(judged.ids == i)
        if i not in taken and len(rows) >= settings.min_points:
            found.append(judged.thing(i, (i,), rows, settings))
    return found


def color_apart(one: np.ndarray, other: np.ndarray) -> float:
    """Mean over the channels of the median difference of colours [n, 3] in [0, 1], after the one's brightness was
    brought to the other's: light changes between visits. NaN without any."""
    known = np.isfinite(one).all(1) & np.isfinite(other).all(1)
    if not known.any():
        return float("nan")
    one, other = one[known], other[known]
    gain = np.clip(np.median(other.sum(1)) / max(1e-3, float(np.median(one.sum(1)))), 0.7, 1.4)
    return float(np.median(np.abs(gain * one - other), axis=0).mean())


def _gone_parts(judged: JudgedSurface, among: np.ndarray, settings: ChangeSettings) -> list[Candidate]:
    gone = judged.other.is_gone(settings.min_views)
    whole = _ids_mostly_gone(judged, gone, settings)
    part_of_whole = np.isin(judged.ids, whole)
    rows = np.flatnonzero(among & (gone | part_of_whole) & (judged.other.through + judged.other.present > 0))
    found: list[Candidate] = []
    for piece in connected_pieces(judged.points[rows], settings.linking_m):
        members = rows[piece]
        if gone[members].sum() < settings.min_points:
            continue
        ids, counts = np.unique(judged.ids[members], return_counts=True)
        mine = tuple(ids[np.isin(ids, whole) & (counts >= settings.min_points)].tolist())
        thing = judged.thing(UNNAMED + len(found), mine, members, settings)
        wide = _width(judged.points[members]) >= settings.min_width * float(judged.within[members].mean())
        if wide and thing.changed >= settings.whole:
            found.append(thing)
    return found


def _width(points: np.ndarray) -> float:
    """How wide points [n, 3] lie across their longest direction, metres: of those that are spread evenly the edge."""
    return float(np.sqrt(12 * max(0.0, float(np.linalg.eigvalsh(np.cov(points.T))[1]))))


def _ids_mostly_gone(judged: JudgedSurface, gone: np.ndarray, settings: ChangeSettings) -> np.ndarray:
    size = int(judged.ids.max(initial=0)) + 1
    judgeable = gone | judged.other.is_there(settings.min_views)
    lost = np.bincount(judged.ids[gone], minlength=size)
    known = np.bincount(judged.ids[judgeable], minlength=size)
    mostly = (lost >= settings.whole * np.maximum(known, 1)) & (lost > 0)
    mostly[0] = False
    return np.flatnonzero(mostly)


def connected_pieces(points: np.ndarray, reach: float) -> list[np.ndarray]:
    """Rows of points [n, 3] that hang together by steps of at most `reach` metres, the largest piece first."""
    if not len(points):
        return []
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    count, piece = connected_components(links, directed=False)
    order = np.argsort(piece, kind="stable")
    pieces = np.split(order, np.cumsum(np.bincount(piece, minlength=count))[:-1])
    return sorted(pieces, key=len, reverse=True)
