# SPDX-License-Identifier: Apache-2.0
"""Removes Gaussians of an earlier map that a visit's own depth looks through.

A visit that starts in an earlier map trains it further. Objects that were carried away fade slowly, and their haze
would hide what changed behind them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ggslam.errors import GgslamError
from ggslam.jobs.merge.sources import MergeSource
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.merging.coverage import PlacedRun
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sight.counts import SightCounts
from ggslam.sight.margin import Margin
from ggslam.sight.view import View
from ggslam.system.tuning import Tuning


class StaleGaussianTuning(Tuning):
    """When a Gaussian of the earlier map is gone."""

    min_views = 2
    """Fewest keyframes that look through it, and how many times more these are than those that see it."""
    max_replaced = 0.5
    """Share of an object's Gaussians where masks show another object, above which it was replaced."""
    max_own_share = 0.01
    """Largest share of views in which masks still show a replaced object; masks err at outlines."""


def own_keyframes(record: KeyframesRecord) -> Sequence[int]:
    """Numbers of the keyframes of a run's own recording. A run that began in another's map has that one's, too: they
    saw what was there before. All of them if none is its own."""
    own = [number for number, keyframe in enumerate(record.keyframes) if keyframe.frame != FROM_EARLIER_RUN]
    return own or range(len(record.keyframes))


def without_stale_gaussians(source: MergeSource, placed: PlacedRun, notes: list[str]) -> GaussianMap:
    """The map of a run without Gaussians of the map it began with that its own keyframes look through. Objects of that
    map in whose places its own masks always show others have become these: something else stands there. The map as it
    is if the run began with none, or its recording is not there.

    Args:
        source: the run.
        placed: its map, and where its keyframes are.
        notes: get what the user should know.
    """
    gaussians = placed.gaussians
    own = own_keyframes(source.record)
    if len(own) == len(source.record.keyframes):
        return gaussians
    if source.sequence is None:
        notes.append(f"{source.name}: its recording is not there, so the map it began with may hide what went")
        return gaussians
    began = ~np.isin(gaussians.birth_keyframe.numpy(), own)
    rows = np.flatnonzero(began)
    seen = _look(source, placed, own, rows)
    notes += [f"{source.name}: left out: {problem}" for problem in seen.problems]
    stale = rows[seen.counts.is_looked_through(StaleGaussianTuning.min_views, StaleGaussianTuning.min_views)]
    replaced = _find_replaced(gaussians.object_id.numpy()[rows], seen)
    if not len(stale) and not replaced:
        return gaussians
    cleared = gaussians.copy(gaussians.device)
    for old, new in replaced.items():
        # The visit's own Gaussians learned it from those before, unless its masks show it where it went.
        taken = (gaussians.object_id == old) & torch.from_numpy(began | (old not in seen.shown))
        cleared.object_id[taken] = new
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[torch.from_numpy(stale)] = False
    cleared.keep(kept)
    return cleared


@dataclass(frozen=True)
class _Seen:
    """What a visit's keyframes show of n Gaussians.

    Attributes:
        counts: how many look through one, and how many see a surface there...
        alike, other: ...of its object, by their masks; of another one; int [n].
        latest: the other object that was seen last, int [n].
        shown: the objects that masks show anywhere.
        problems: frames that could not be read, and why.
    """

    counts: SightCounts
    alike: np.ndarray
    other: np.ndarray
    latest: np.ndarray
    shown: set[int] = field(default_factory=set)
    problems: list[str] = field(default_factory=list)


def _find_replaced(ids: np.ndarray, seen: _Seen) -> dict[int, int]:
    """Objects, of ids [n], that masks never show where most of their surfaces are seen; and what they show there most.
    """
    found = {}
    for i in np.unique(ids[ids > 0]).tolist():
        own = ids == i
        others = own & (seen.other >= StaleGaussianTuning.min_views)
        if (
            others.sum() > StaleGaussianTuning.max_replaced * own.sum()
            and seen.alike[own].sum() < StaleGaussianTuning.max_own_share * seen.other[own].sum()
        ):
            found[i] = int(np.bincount(seen.latest[others]).argmax())
    return found


def _look(source: MergeSource, placed: PlacedRun, own: Sequence[int], rows: np.ndarray) -> _Seen:
    """What a run's own keyframes, by number, say of some rows of its map."""
    margin, sequence, masks = Margin.of(source.known.noise), source.sequence, source.has_lasting_ids()
    assert sequence is not None
    means = placed.gaussians.means.numpy()[rows].astype(np.float64)
    ids = placed.gaussians.object_id.numpy()[rows].astype(int)
    found = _Seen(SightCounts.none(len(rows)), *np.zeros((3, len(rows)), int))
    for k in own:
        try:
            frame = sequence.frame(source.record.keyframes[k].frame, masks=masks)
            mask = frame.load_mask() if masks else None
        except GgslamError as error:
            found.problems.append(str(error))
            continue
        answers = View.of(frame.depth, frame.camera, placed.T_world_camera[k], margin).classify_points(means)
        found.counts.add(answers)
        if mask is not None:
            found.shown.update(np.unique(mask).tolist())
            shown = answers.at(mask).astype(int)
            other = answers.same & (shown > 0) & (shown != ids)
            found.alike[:] += answers.same & (shown == ids)
            found.other[:] += other
            found.latest[other] = shown[other]
    return found
