# SPDX-License-Identifier: Apache-2.0
"""Merges finished runs into one. `ggslam merge` calls this."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.jobs.merge.clock import Clock
from ggslam.jobs.merge.joint_folder import joint_folder
from ggslam.jobs.merge.joint_poses import find_joint_poses, place_maps
from ggslam.jobs.merge.merged_run import MergedRun
from ggslam.jobs.merge.seams import train_seams
from ggslam.jobs.merge.sources import MergeSource
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.merging.coverage import Coverage, PlacedRun
from ggslam.merging.joint_graph import JointPoses
from ggslam.merging.joint_map import append_map
from ggslam.merging.objects import UnitedObjects
from ggslam.merging.ownership import Ownership
from ggslam.merging.settings import MergeSettings
from ggslam.native.loader import NativeContext
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import fingerprint
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.interrupts import delay_interrupts


@dataclass
class MergeOutcome:
    """Result of a merge.

    Attributes:
        folder: the merged run.
        poses: what became of the links between the runs.
        gaussians: of the merged map.
        doubles: Gaussians of each run that were left out, because another run measured their places better.
        united: (id, number of the run, its own id there) of objects that an earlier run has as well.
        trained: keyframes at the seams that were trained on.
        steps: optimisation steps made on them.
        seconds: by part: read, ground, graph, join, train, write.
        notes: what the user should know.
    """

    folder: RunFolder
    poses: JointPoses
    gaussians: int = 0
    doubles: list[int] = field(default_factory=list)
    united: list[tuple[int, int, int]] = field(default_factory=list)
    trained: int = 0
    steps: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def shared_objects(self) -> int:
        """Things that more than one run has."""
        return len({thing for thing, _, _ in self.united})


def merge_runs(
    runs: ListOf[str | Path], out: str | Path, *, overwrite: bool = False, settings: MergeSettings | None = None,
    observer: Observer | None = None,
) -> MergeOutcome:  # fmt: skip
    """Merges finished runs into one, in the world of the first one.

    Args:
        runs: folders of two runs or more, or containers of them (`map.ggz`). What the runs have in common is the first
            one's that has it.
        out: folder of the merged run.
        overwrite: replace a run that is already at `out`.
        settings: see there.
        observer: receives progress updates.

    Returns:
        What came of it.

    Raises:
        ConfigError: fewer than two runs, one given twice (also as a copy or a container), `out` is one of them, or
            a run has too little ground in common with the others; the message names it and the best that was found.
        RunFolderError: a run is damaged or has no places, or `out` cannot be written.
        MissingDependency: gtsam is not installed.
    """
    clock, context, settings = Clock(), NativeContext(None), settings or MergeSettings()
    with joint_folder(runs, out, overwrite, context, clock, "merged") as (sources, folder):
        _refuse_copies(sources)
        return _Merge(sources, folder, settings, observer or SilentObserver(), context, clock).run()


def _refuse_copies(sources: list[MergeSource]) -> None:
    """A run and its container, or a copy of it, would count its frames twice."""
    known: dict[str, MergeSource] = {}
    for source in sources:
        first = known.setdefault(fingerprint(source.folder), source)
        if first is not source:
            raise ConfigError(f"{source.name}: is the same run as {first.name}; a run is not merged with itself")


def _bare_runs(sources: list[MergeSource], objects: UnitedObjects) -> list[str]:
    """Notes on the runs that have no objects, where others have some."""
    if objects.supervision is None:
        return []
    without = [source.name for source in sources if source.objects is None]
    return [f"{name}: has no objects; what it measured best belongs to none in the merged map" for name in without]


@dataclass
class _Merge:
    """A merge in progress."""

    sources: list[MergeSource]
    folder: RunFolder
    settings: MergeSettings
    observer: Observer
    context: NativeContext
    clock: Clock

    def run(self) -> MergeOutcome:
        """From places to a run folder."""
        sources, notes = self.sources, list[str]()
        poses = find_joint_poses(sources, self.settings, self.context, self.observer, self.clock.lap)
        outcome = MergeOutcome(self.folder, poses, seconds=self.clock.seconds, notes=notes)
        placed = place_maps(sources, poses)
        objects = UnitedObjects(self.settings.uniting)
        seams = self._find_seams(placed)
        gaussians = self._join(placed, objects, outcome)
        self.clock.lap("join")
        steps = self.settings.steps * (len(sources) - 1)
        trained = train_seams(sources, placed, seams, gaussians, objects, steps, self.context, self.observer)
        outcome.trained, outcome.steps = trained.count, trained.steps
        notes += trained.notes
        self.clock.lap("train")
        notes += objects.notes + _bare_runs(sources, objects)
        outcome.gaussians, outcome.united = len(gaussians), objects.united
        merged = MergedRun(sources, poses, trained.keyframes, gaussians, objects, outcome.doubles, outcome.steps)
        with delay_interrupts():
            merged.save(self.folder, self.clock.seconds)
        notes += merged.notes
        self.clock.lap("write")
        return outcome

    def _find_seams(self, placed: list[PlacedRun]) -> list[np.ndarray]:
        """Which keyframes of each run see what another run's map shows, bool [K] each."""
        coverage, seams = Coverage(self.settings.seams, self.context), []
        for number, run in enumerate(placed):
            shares = [coverage.shared_views(other.gaussians, run) for k, other in enumerate(placed) if k != number]
            seams.append(np.max(shares, axis=0) >= self.settings.seams.share)
        return seams

    def _join(self, placed: list[PlacedRun], objects: UnitedObjects, outcome: MergeOutcome) -> GaussianMap:
        """One map of all, with one set of objects: of each run what lies where it measured best."""
        base = GaussianMap(placed[0].gaussians.sh_degree, placed[0].gaussians.feature_channels)
        known = [source.known for source in self.sources]
        ownership = Ownership(known, outcome.poses.of(known), self.settings.seams.voxel * known[0].scale)
        kept = []
        for number, (source, run) in enumerate(zip(self.sources, placed, strict=True)):
            objects.add(base, run.gaussians, source.run_objects())
            kept.append(ownership.of(run.gaussians.means.numpy()) == number)
            outcome.doubles.append(int((~kept[-1]).sum()))
            append_map(base, run.gaussians, source.first_keyframe)
        base.keep(torch.from_numpy(np.concatenate(kept)))
        return base
