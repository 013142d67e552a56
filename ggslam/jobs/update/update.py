# SPDX-License-Identifier: Apache-2.0
"""Brings a run up to date with a later visit. `ggslam update` calls this."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from ggslam.changes.map_update import NEW, OLD, Fate, MapUpdate
from ggslam.changes.settings import ChangeSettings
from ggslam.jobs.changes.changes import ChangesOutcome, compare_placed, write_changes
from ggslam.jobs.merge.clock import Clock
from ggslam.jobs.merge.joint_folder import joint_folder
from ggslam.jobs.merge.joint_poses import find_joint_poses, place_maps
from ggslam.jobs.merge.merged_run import MergedRun
from ggslam.jobs.merge.seams import train_seams
from ggslam.jobs.merge.sources import MergeSource
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.update.histories import history_after
from ggslam.merging.coverage import Coverage, PlacedRun
from ggslam.merging.joint_graph import JointPoses
from ggslam.merging.joint_map import append_map
from ggslam.merging.objects import ToldIds, UnitedObjects
from ggslam.merging.ownership import Ownership
from ggslam.merging.settings import MergeSettings
from ggslam.native.loader import NativeContext
from ggslam.runs.folder import RunFolder
from ggslam.runs.writing import CHANGES_FOLDER
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import transform_points
from ggslam.system.interrupts import delay_interrupts
from ggslam.system.tuning import Tuning


class UpdateTuning(Tuning):
    """Which older keyframes are still trained on."""

    max_changed_points = 20
    """Points of changed surface that an older keyframe may show."""


@dataclass
class UpdateOutcome:
    """Result of an update.

    Attributes:
        folder: the run that shows the latest state.
        poses: what became of the links between the runs.
        changes: what changed between the visits.
        gaussians: of the map.
        kept: Gaussians of the older and of the newer run that are in it.
        gone: Gaussians of the older run that showed what is not there any more.
        trained: keyframes that were trained on.
        steps: optimisation steps made on them.
        seconds: by part: read, ground, graph, compare, join, train, write.
        notes: what the user should know.
    """

    folder: RunFolder
    poses: JointPoses
    changes: ChangesOutcome
    gaussians: int = 0
    kept: tuple[int, int] = (0, 0)
    gone: int = 0
    trained: int = 0
    steps: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def update_run(
    old: str | Path, new: str | Path, out: str | Path, *, overwrite: bool = False, ids: bool | None = None,
    merging: MergeSettings | None = None, settings: ChangeSettings | None = None, observer: Observer | None = None,
) -> UpdateOutcome:  # fmt: skip
    """Brings a run up to date by a later visit: the map of the latest state, in the world of the older run.

    Args:
        old, new: folders of the runs, or containers of them (`map.ggz`).
        out: folder of the updated run.
        overwrite: replace a run that is already at `out`.
        ids: whether one object id means one thing in both runs; None: that is found out.
        merging, settings: see there.
        observer: receives progress updates.

    Raises:
        ConfigError: `out` is one of the runs, or they have too little ground in common; the message tells the best that
            was found.
        RunFolderError: a run is damaged or has no places, or `out` cannot be written.
        MissingDependency: gtsam is not installed.
    """
    clock, context = Clock(), NativeContext(None)
    with joint_folder([old, new], out, overwrite, context, clock, "compared") as (sources, folder):
        update = _Update(
            sources, folder, merging or MergeSettings(), settings or ChangeSettings(), observer or SilentObserver(),
            context, clock, ids,
        )  # fmt: skip
        return update.run()


@dataclass
class _Update:
    """An update in progress."""

    sources: list[MergeSource]
    folder: RunFolder
    merging: MergeSettings
    settings: ChangeSettings
    observer: Observer
    context: NativeContext
    clock: Clock
    ids: bool | None

    def run(self) -> UpdateOutcome:
        """From places to a run folder."""
        sources = self.sources
        poses = find_joint_poses(sources, self.merging, self.context, self.observer, self.clock.lap)
        placed = place_maps(sources, poses)
        changes = compare_placed(sources, placed, poses, self.settings, self.context, self.observer, self.ids)
        self.clock.lap("compare")
        outcome = UpdateOutcome(self.folder, poses, changes, seconds=self.clock.seconds)
        map_update = MapUpdate(changes.detector, changes.table.found, self.settings)
        seams = self._find_seams(placed, map_update)
        objects = UnitedObjects(self.merging.uniting)
        gaussians = self._join(placed, objects, map_update, outcome)
        self.clock.lap("join")
        trained = train_seams(
            sources, placed, seams, gaussians, objects, self.merging.steps, self.context, self.observer
        )
        outcome.trained, outcome.steps = trained.count, trained.steps
        self.clock.lap("train")
        outcome.notes += trained.notes + objects.notes + changes.table.found.notes
        outcome.gaussians = len(gaussians)
        history = history_after(sources, changes.table.found, objects, set(gaussians.object_id.unique().tolist()))
        left_out = [source.gaussian_count - kept for source, kept in zip(sources, outcome.kept, strict=True)]
        merged = MergedRun(
            sources, poses, trained.keyframes, gaussians, objects, left_out, outcome.steps,
            {OLD: map_update.holds(self._measured_points(poses, OLD))}, past=1, history=history,
        )  # fmt: skip
        with delay_interrupts():
            merged.save(self.folder, self.clock.seconds, lambda staged: self._write_changes(changes, staged))
        outcome.notes += merged.notes
        self.clock.lap("write")
        return outcome

    def _write_changes(self, changes: ChangesOutcome, staged: Path) -> None:
        write_changes(changes, staged / CHANGES_FOLDER, *(source.place for source in self.sources))

    def _measured_points(self, poses: JointPoses, number: int) -> np.ndarray:
        """Points that a run's keyframes measured, world, float64 [n, 3]."""
        known = self.sources[number].known
        T_world_camera = poses.of([source.known for source in self.sources])[number]
        return np.concatenate([
            transform_points(points.astype(float), T) for points, T in zip(known.points, T_world_camera, strict=True)
        ])  # fmt: skip

    # --- one map -----------------------------------------------------------------------------------------------------

    def _join(
        self, placed: list[PlacedRun], objects: UnitedObjects, map_update: MapUpdate, outcome: UpdateOutcome
    ) -> GaussianMap:
        """What both maps hold of the latest state, with one set of objects."""
        new = placed[NEW].gaussians
        old = placed[OLD].gaussians.copy(new.device)  # pictures show it as it was
        came, fate = map_update.came(new), map_update.renew(old)
        base = GaussianMap(old.sh_degree, old.feature_channels)
        objects.add(base, old, self.sources[OLD].run_objects())
        append_map(base, old, self.sources[OLD].first_keyframe)
        known = base.copy(base.device)
        known.keep(torch.from_numpy(~fate.gone | fate.moved))
        objects.add(known, new, self.sources[NEW].run_objects(), self._told_ids(map_update))
        append_map(base, new, self.sources[NEW].first_keyframe)
        kept = self._choose(outcome.poses, (old, new), fate, came, map_update)
        outcome.gone, outcome.kept = int(fate.gone.sum()), (int(kept[OLD].sum()), int(kept[NEW].sum()))
        base.keep(torch.from_numpy(np.concatenate(kept)))
        return base

    def _choose(
        self, poses: JointPoses, maps: tuple[GaussianMap, GaussianMap], fate: Fate, came: np.ndarray,
        map_update: MapUpdate,
    ) -> list[np.ndarray]:
        """Which Gaussians of both maps stay, bool [N] each."""
        known = [source.known for source in self.sources]
        ownership = Ownership(known, poses.of(known), self.merging.seams.voxel * known[0].scale, map_update.weights)
        owners = [ownership.of(gaussians.means.numpy()) for gaussians in maps]
        return [~fate.gone & ((owners[OLD] == OLD) | fate.moved), came | (owners[NEW] == NEW)]

    def _told_ids(self, map_update: MapUpdate) -> ToldIds:
        """What the changes tell of the newer run's ids."""
        objects = self.sources[OLD].objects
        history = None if objects is None else objects.table.history
        gone = frozenset() if history is None else frozenset(history.ids_gone())
        if map_update.found.ids_believed:
            return ToldIds({}, all=True)
        pairs = {
            i: change.old.ids[0] for change in map_update.found.changes if change.old and change.new and change.old.ids
            for i in change.new.ids
        }  # fmt: skip
        added = {i for change in map_update.found.changes if change.new and change.old is None for i in change.new.ids}
        lost = {i for change in map_update.found.changes if change.old and change.new is None for i in change.old.ids}
        return ToldIds(pairs, frozenset(added), taken=gone | lost)

    # --- training ----------------------------------------------------------------------------------------------------

    def _find_seams(self, placed: list[PlacedRun], map_update: MapUpdate) -> list[np.ndarray]:
        """Which keyframes are trained on, bool [K] of each run: those of the newer one that see what the older map
        shows, or what changed; and those of the older one that see the newer map and nothing that changed."""
        coverage, share = Coverage(self.merging.seams, self.context), self.merging.seams.share
        shared = [coverage.shared_views(placed[1 - k].gaussians, run) >= share for k, run in enumerate(placed)]
        changed = [
            map_update.shows_changes(run.cameras, run.T_world_camera, UpdateTuning.max_changed_points) for run in placed
        ]
        return [shared[OLD] & ~changed[OLD], shared[NEW] | changed[NEW]]
