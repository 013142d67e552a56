# SPDX-License-Identifier: Apache-2.0
"""Merges the objects of several maps: one id for each object, one classifier, all names and votes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.mapping.votes import merge_votes
from ggslam.objects.encoding import code_of, with_class
from ggslam.objects.same_object import LabelledVoxels, find_counterparts, sizes_of
from ggslam.objects.settings import IDS, SameObjectSettings
from ggslam.objects.table import ObjectTable, Observation, Supervision
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier
from ggslam.system.tuning import Tuning


class SmallObjectTuning(Tuning):
    """Which objects are compared in finer voxels, too."""

    small = 4
    """Those that fill fewer voxels than this many times the number that two objects have to share."""


_SUREST: tuple[Supervision, ...] = ("geometry", "model", "associated masks", "masks")
"""What taught objects, the least sure first: a merged map's are as sure as the least sure of them."""


@dataclass(frozen=True)
class RunObjects:
    """Objects of a run.

    Attributes:
        table: the objects.
        classifier: of identity vectors.
        source: masks whose ids are constant in time come from here; runs of one source call one thing by one id. None:
            ids mean nothing outside the run.
        first_frame: what the run's frames count from in the whole.
    """

    table: ObjectTable
    classifier: IdentityClassifier
    source: str | None
    first_frame: int


@dataclass(frozen=True)
class ToldIds:
    """What somebody knows of a run's ids before surfaces are compared.

    Attributes:
        names: what some of its ids are called in the runs before.
        new: ids of things that no run before has; they get ids that nothing had.
        all: whether its other ids mean what they mean in the runs before, or something that these do not have.
        taken: ids of things that are not there any more.
    """

    names: Mapping[int, int]
    new: frozenset[int] = frozenset()
    all: bool = False
    taken: frozenset[int] = frozenset()


@dataclass
class UnitedObjects:
    """The objects of the runs so far.

    Attributes:
        classifier: of identity vectors.
        supervision: what taught them.
        names, observations: by id.
        ids: of each run, what its ids are called now; empty for a run without objects.
        united: (id, number of the run, its own id there) of objects that were there already.
        notes: what the user should know.
    """

    settings: SameObjectSettings
    classifier: IdentityClassifier = field(default_factory=lambda: IdentityClassifier.empty(IDENTITY_CHANNELS))
    supervision: Supervision | None = None
    names: dict[int, str] = field(default_factory=dict)
    observations: dict[int, Observation] = field(default_factory=dict)
    ids: list[dict[int, int]] = field(default_factory=list)
    united: list[tuple[int, int, int]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _sources: list[str | None] = field(default_factory=list)
    _learned: dict[str | None, list[int]] = field(default_factory=dict)

    def add(
        self, base: GaussianMap, gaussians: GaussianMap, objects: RunObjects | None, told: ToldIds | None = None
    ) -> None:
        """The objects of the next run join those of the runs before; its Gaussians get their ids, votes and identity
        vectors.

        Args:
            base: the map so far, of the runs before.
            gaussians: the run's map in the same world; changed.
            objects: of the run; None: it has none.
            told: what is known of the run's ids.

        Raises:
            ConfigError: there are more than 65,535 objects.
        """
        if objects is None:
            self.ids.append({})
            self._sources.append(None)
            return
        first = self.supervision is None
        ids = {i: i for i in objects.table.ids()} if first else self._match(base, gaussians, objects, told)
        self.ids.append(ids)
        self._sources.append(objects.source)
        self._take_words(objects, ids)
        if first:
            self.classifier = objects.classifier
            self._learned = {objects.source: objects.classifier.class_ids.tolist()}
        else:
            self._relabel(base, gaussians, objects, ids)

    def table(self, gaussians: GaussianMap) -> ObjectTable:
        """The objects of the finished map."""
        present = set(np.unique(gaussians.object_id.numpy()).tolist())
        seen = {i: observation for i, observation in self.observations.items() if i in present}
        assert self.supervision is not None
        return ObjectTable.build(gaussians, self.classifier, self.supervision, self.names, seen)

    # --- which is which ----------------------------------------------------------------------------------------------

    def _match(
        self, base: GaussianMap, gaussians: GaussianMap, objects: RunObjects, told: ToldIds | None
    ) -> dict[int, int]:
        """What the run's ids are called."""
        known = set(self.observations) | set(self.names) | set(self.classifier.class_ids.tolist())
        known |= {i for of_run in self.ids for i in of_run.values()}
        own = objects.table.ids()
        found = self._by_source(objects) if told is None else None
        if found is None:
            all_told = told is not None and told.all
            found = {i: i for i in own} if all_told else self._by_surface(base, gaussians)
        if told is not None:
            found = {i: name for i, name in found.items() if i not in told.new} | dict(told.names)
        ids = {i: found[i] for i in own if i in found}
        objects_before = {i for of_run in self.ids for i in of_run.values()}
        self.united += [(new, len(self.ids), old) for old, new in ids.items() if new in objects_before]
        taken = known | set(ids.values()) | (set() if told is None else told.taken)
        free = iter([i for i in range(1, IDS) if i not in taken and i not in own])
        for i in own:
            if i not in ids:
                ids[i] = i if i not in taken else next(free, 0)
                taken.add(ids[i])
        if 0 in ids.values():
            raise ConfigError(f"the runs have more than {IDS - 1} objects together")
        return ids

    def _by_source(self, objects: RunObjects) -> dict[int, int] | None:
        """What ids of the same masks are called already; None if no run before was taught by them."""
        of_source = [k for k, source in enumerate(self._sources) if source is not None and source == objects.source]
        if not of_source:
            return None
        called = {i: name for k in reversed(of_source) for i, name in self.ids[k].items()}
        too_little_seen = self._learned.get(objects.source, [])  # by the first run, for its map to have them
        return {i: i for i in too_little_seen} | called

    def _by_surface(self, base: GaussianMap, gaussians: GaussianMap) -> dict[int, int]:
        voxel = self.settings.voxel
        first, second = LabelledVoxels.of_map(base, voxel), LabelledVoxels.of_map(gaussians, voxel)
        found = {pair.second: pair.first for pair in find_counterparts(first, second, self.settings)}
        small = [
            np.flatnonzero(sizes_of(voxels) < SmallObjectTuning.small * self.settings.min_shared)
            for voxels in (first, second)
        ]
        for finer in (voxel / 2, voxel / 4):  # small things fill too few voxels
            maps = [LabelledVoxels.of_map(g, finer, only) for g, only in zip((base, gaussians), small, strict=True)]
            more = {pair.second: pair.first for pair in find_counterparts(maps[0], maps[1], self.settings)}
            found = {**more, **found}
        return found

    # --- what they are called ----------------------------------------------------------------------------------------

    def _take_words(self, objects: RunObjects, ids: Mapping[int, int]) -> None:
        """Names, observations, supervision."""
        if self.supervision is None or _SUREST.index(objects.table.supervision) < _SUREST.index(self.supervision):
            self.supervision = objects.table.supervision
        for record in objects.table.objects:
            new = ids[record.id]
            if record.name is not None:
                kept = self.names.setdefault(new, record.name)
                if kept != record.name:
                    both = f"{kept} in one run and {record.name} in another"
                    self.notes.append(f"object {new} is called {both}; {kept} stays")
            if record.first_frame is not None and record.last_frame is not None:
                seen = Observation(
                    record.first_frame + objects.first_frame, record.last_frame + objects.first_frame, record.views
                )
                old = self.observations.get(new)
                self.observations[new] = seen if old is None else _both(old, seen)

    def _relabel(self, base: GaussianMap, gaussians: GaussianMap, objects: RunObjects, ids: Mapping[int, int]) -> None:
        """A run's Gaussians get ids, votes and vectors of the whole."""
        table = np.zeros(IDS, np.int32)
        table[list(ids)] = list(ids.values())
        alias = torch.from_numpy(table)
        gaussians.object_id[:] = alias[gaussians.object_id.long()]
        if gaussians.vote_ids.shape[1]:
            merge_votes(gaussians, alias)
        features = base.features.numpy()
        for new in sorted(set(ids.values()) - set(self.classifier.class_ids.tolist())):
            self.classifier = with_class(self.classifier, new, features)
        labels = gaussians.object_id.numpy()
        gaussians.features[torch.from_numpy(labels == 0)] = 0
        for new in np.unique(labels[labels > 0]).tolist():
            rows = torch.from_numpy(labels == new)
            gaussians.features[rows] = torch.from_numpy(code_of(base, self.classifier, new))


def _both(one: Observation, other: Observation) -> Observation:
    """When something was seen that was seen by two runs."""
    return replace(
        one, first_frame=min(one.first_frame, other.first_frame), last_frame=max(one.last_frame, other.last_frame),
        views=one.views + other.views,
    )  # fmt: skip
