# SPDX-License-Identifier: Apache-2.0
"""Writes a merged run: an ordinary run folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam import __version__
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.trajectory import write_tum
from ggslam.jobs.merge.sources import MergeSource, joint_config
from ggslam.jobs.merge.truth import truth_transforms
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.merging.joint_graph import JointPoses
from ggslam.merging.objects import UnitedObjects
from ggslam.objects.history import History
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.runs.environment import environment
from ggslam.runs.folder import RunFolder
from ggslam.runs.publishing import publish_run
from ggslam.runs.recordings import fingerprint, read_moving
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.run_json import MergedRecord, RunRecord
from ggslam.runs.records.sequence import PartRecord, SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.runs.saving_parts import save_points
from ggslam.runs.writing import RUN_FILES, TRUTH_FILE, write_objects
from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sequences.moving_pixels import MOVERS_FILE, MovingPixels
from ggslam.slam.config import save_config
from ggslam.slam.saved_places import KEYFRAME_CAMERAS, PLACES_FILE, camera_row
from ggslam.system.atomic import write_bytes
from ggslam.system.process_memory import peak_memory_mb

_STACKED = (
    "surface_counts", "surface_reach", "surface_points", "surface_normals", "loops_median_depths",
    "loops_places_counts", "loops_places_descriptors", "loops_places_points", "loops_places_codes",
)  # fmt: skip
"""Arrays of places.npz that do not change when runs are put behind one another."""
_SUMS = ("wall_s", "tracking_s", "loops_s", "beside_s", "refinement_s", "checkpoints_s")
_MAPPING_SUMS = ("insertion", "forward", "loss", "backward", "identity", "identity_finish", "iterations", "keyframes")


@dataclass
class MergedRun:
    """A merged run about to be written.

    Attributes:
        sources: the runs.
        poses: where their keyframes were put.
        keyframes: of all runs, with their final poses and exposures.
        gaussians: the map; `birth_keyframe` counts `keyframes`.
        objects: of the map.
        doubles: Gaussians of each run that were left out.
        steps: optimisation steps at the seams.
        holds: by number of a source, which of the points that its keyframes measured still hold, bool [n]; of other
            sources all.
        past: how many of the sources, the first ones, show an earlier state than the map.
        history: of the objects; None: the map is of one state.
        notes: what the user should know.
    """

    sources: list[MergeSource]
    poses: JointPoses
    keyframes: list[Keyframe]
    gaussians: GaussianMap
    objects: UnitedObjects
    doubles: list[int]
    steps: int
    holds: Mapping[int, np.ndarray] = field(default_factory=dict)
    past: int = 0
    history: History | None = None
    notes: list[str] = field(default_factory=list)

    def save(
        self, folder: RunFolder, seconds: Mapping[str, float], more: Callable[[Path], None] = lambda folder: None
    ) -> None:
        """Writes all files, each whole or not at all.

        Args:
            folder: where to.
            seconds: that the merge has taken so far, by part.
            more: writes further files into a folder.

        Raises:
            RunFolderError: a file cannot be written.
        """

        def write(staged: Path) -> RunRecord:
            self._write_records(staged, seconds)
            self._write_map(staged)
            write_bytes(staged / PLACES_FILE, self._places())
            moving = MovingPixels.concatenate((s.first_frame, read_moving(s.folder.path)) for s in self.sources)
            if len(moving):
                write_bytes(staged / MOVERS_FILE, arrays_to_bytes(**moving.to_arrays()))
            save_points(staged)
            more(staged)
            return self._mark()

        publish_run(folder.path, write, RUN_FILES, f"{folder.path}: the merged run cannot be written")

    def _mark(self) -> RunRecord:
        merged = [
            MergedRecord(
                run=source.place, fingerprint=fingerprint(source.folder),
                frames=len(source.record.frames), keyframes=len(source.known), gaussians=source.gaussian_count,
                double=double, objects=ids or None,
            )
            for source, double, ids in zip(self.sources, self.doubles, self.objects.ids, strict=True)
        ]  # fmt: skip
        made_with = {**environment(), "device": "cpu"}
        return RunRecord(
            ggslam=__version__, complete=True, environment=made_with, merged=merged, updated=self.past > 0
        )

    # --- records -----------------------------------------------------------------------------------------------------

    def _write_records(self, folder: Path, seconds: Mapping[str, float]) -> None:
        sources = self.sources
        save_config(joint_config(sources, self.gaussians), folder / "config.yaml")
        record = self._keyframes_record()
        record.write(folder)
        times, poses = np.concatenate([s.times() for s in sources]), self._frame_poses(record)
        write_tum(folder / "trajectory.txt", times, poses)
        transforms = self._write_truth(folder, times, poses)
        self._sequence_record(transforms).write(folder)
        self._loops_record().write(folder)
        self._timing_record(seconds).write(folder)

    def _keyframes_record(self) -> KeyframesRecord:
        keyframes, frames = [], []
        for source in self.sources:
            for k, old in enumerate(source.record.keyframes):
                new = self.keyframes[source.first_keyframe + k]
                frame = FROM_EARLIER_RUN if old.frame == FROM_EARLIER_RUN else old.frame + source.first_frame
                keyframes.append(old.model_copy(update={
                    "index": new.index, "frame": frame,
                    "timestamp": None if old.timestamp is None else old.timestamp + source.time_shift_s,
                    "T_world_camera": new.T_world_camera, "exposure": new.exposure,
                    "iterations": old.iterations + new.iterations,
                }))  # fmt: skip
            for f in source.record.frames:
                frames.append(f.model_copy(update={
                    "frame": f.frame + source.first_frame, "keyframe": f.keyframe + source.first_keyframe,
                    "timestamp": None if f.timestamp is None else f.timestamp + source.time_shift_s,
                }))  # fmt: skip
        return KeyframesRecord(keyframes=keyframes, frames=frames)

    @staticmethod
    def _frame_poses(record: KeyframesRecord) -> np.ndarray:
        """T_world_camera of all frames, float64 [n, 4, 4], NaN where lost."""
        known, unknown = record.poses(), np.full((4, 4), np.nan)
        return np.array([known.get(f.frame, unknown) for f in record.frames]).reshape(-1, 4, 4)

    def _write_truth(self, folder: Path, times: np.ndarray, poses: np.ndarray) -> list[np.ndarray | None]:
        """Writes the true poses of all frames, in the world of the first recording's; returns what brought each
        recording's there."""
        ends = np.cumsum([len(source.record.frames) for source in self.sources])[:-1]
        truth = [source.true_poses() for source in self.sources]
        transforms = truth_transforms(np.split(poses, ends), truth)
        rows = [
            np.full((len(source.record.frames), 4, 4), np.nan) if own is None or T is None else T @ own
            for source, own, T in zip(self.sources, truth, transforms, strict=True)
        ]
        if any(T is not None for T in transforms):
            write_tum(folder / TRUTH_FILE, times, np.concatenate(rows))
        for source, T in zip(self.sources, transforms, strict=True):
            if T is not None and not np.array_equal(T, np.eye(4)):
                self.notes.append(
                    f"{source.name}: the true poses of its recording are in another world than the first one's; they "
                    "were brought there by the merged trajectory: scores do not tell how the runs lie to each other"
                )
        return transforms

    def _sequence_record(self, transforms: list[np.ndarray | None]) -> SequenceRecord:
        parts = [
            part
            for number, (source, T) in enumerate(zip(self.sources, transforms, strict=True))
            for part in self._parts(number, source, T)
        ]
        first = self.sources[0].recording
        return SequenceRecord(
            open=first.open, format=first.format, camera=first.camera, frames=sum(part.frames for part in parts),
            warnings=[w for source in self.sources for w in source.recording.warnings], parts=parts,
        )  # fmt: skip

    def _parts(self, number: int, source: MergeSource, T: np.ndarray | None) -> list[PartRecord]:
        ids = self.objects.ids[number]
        renamed = self.objects.supervision == "masks" and any(old != new for old, new in ids.items())
        parts = []
        for part in source.parts():
            changes: dict[str, Any] = {"time_shift_s": part.time_shift_s + source.time_shift_s}
            changes |= {"past": True} if part.past or number < self.past else {}
            if T is not None:
                before = np.eye(4) if part.T_joint_truth is None else part.T_joint_truth
                changes["T_joint_truth"] = T @ before
            if renamed:
                own = {i: i for i in ids} if part.mask_ids is None else part.mask_ids
                changes["mask_ids"] = {i: ids[name] for i, name in own.items() if name in ids}
            parts.append(part.model_copy(update=changes))
        return parts

    def _loops_record(self) -> LoopsRecord:
        """Loops of the runs, and the links between them: `old_keyframe` is of the earlier run."""
        events, lost = list[dict[str, Any]](), list[dict[str, Any]]()
        for source in self.sources:
            loops = source.folder.loops()
            for event in [] if loops is None else loops.events:
                shift, numbers = source.first_frame, source.first_keyframe
                moved = {"frame": event.frame + shift, "keyframe": event.keyframe + numbers,
                         "old_keyframe": event.old_keyframe + numbers}  # fmt: skip
                events.append({**event.values(), **moved})
            for stretch in [] if loops is None else loops.lost:
                after = None if stretch.after is None else stretch.after + source.first_frame
                lost.append({**stretch.values(), "first": stretch.first + source.first_frame, "after": after})
        for link in self.poses.links:
            old, new = (self.sources[number] for number in link.runs)
            frame = new.record.keyframes[link.new].frame
            events.append({
                "kind": "linked" if link.believed else "refused", "frame": max(frame, 0) + new.first_frame,
                "keyframe": link.new + new.first_keyframe, "old_keyframe": link.old + old.first_keyframe,
                "reason": link.reason,
            })  # fmt: skip
        return LoopsRecord.of({"seconds": self.poses.seconds, "events": events, "lost": lost})

    def _timing_record(self, seconds: Mapping[str, float]) -> TimingRecord:
        """Times of the runs, summed, and those of the merge."""
        runs = [source.folder.timing() for source in self.sources]
        frames = sum(len(source.record.frames) for source in self.sources)
        sums = {name: sum(getattr(run, name) for run in runs) for name in _SUMS}
        mapping = {name: sum(getattr(run.mapping, name) for run in runs) for name in _MAPPING_SUMS}
        dropped = [k + s.first_frame for s, run in zip(self.sources, runs, strict=True) for k in run.dropped_frames]
        step_ms = 1e3 * sum(mapping[name] for name in ("forward", "loss", "backward", "identity"))
        return TimingRecord.of({
            "frames": frames, "dropped_frames": dropped,
            "frames_per_s": frames / sums["wall_s"] if sums["wall_s"] > 0 else None, **sums,
            "tracking_ms_per_frame": 1e3 * sums["tracking_s"] / max(1, frames),
            "mapping_ms_per_iteration": step_ms / max(1, mapping["iterations"]),
            "refine_iterations": sum(run.refine_iterations for run in runs), "mapping": mapping,
            "gaussians": len(self.gaussians), "peak_rss_mb": peak_memory_mb(),
            "merge_s": dict(seconds), "seam_iterations": self.steps,
        })  # fmt: skip

    # --- map and places ----------------------------------------------------------------------------------------------

    def _write_map(self, folder: Path) -> None:
        if self.objects.supervision is None:
            write_gaussian_ply(folder / "map.ply", self.gaussians)
            return
        table = replace(self.objects.table(self.gaussians), history=self.history)
        votes = ObjectVotes.of(self.gaussians)
        write_objects(folder, SegmentedMap(self.gaussians, self.objects.classifier, table, votes))

    def _places(self) -> bytes:
        """places.npz of all runs' keyframes."""
        sources = self.sources
        own = [read_all_arrays(source.folder.path / PLACES_FILE, "the places of a run") for source in sources]
        own = [_with_points(arrays, self.holds[k]) if k in self.holds else arrays for k, arrays in enumerate(own)]
        joined = {name: np.concatenate([arrays[name] for arrays in own]) for name in _STACKED}
        numbers = [a["loops_places_numbers"] + s.first_keyframe for a, s in zip(own, sources, strict=True)]
        moved = list(zip(own, self.poses.T_new_old, strict=True))
        sigma = [source.known.noise for source in sources]
        noise = max(sigma, key=lambda model: model.sigma(2.0))
        return arrays_to_bytes(
            **joined, loops_places_numbers=np.concatenate(numbers).astype(np.int32),
            surface_poses=np.concatenate([T @ arrays["surface_poses"] for arrays, T in moved]),
            loops_poses=np.concatenate([T @ arrays["loops_poses"] for arrays, T in moved]),
            keyframe_poses=np.stack([keyframe.T_world_camera for keyframe in self.keyframes]),
            camera=camera_row(sources[0].known.cameras[0]), noise=np.array([noise.constant, noise.square]),
            scale=np.array(sources[0].known.scale), birth=self.gaussians.birth_keyframe.numpy(),
            **{KEYFRAME_CAMERAS: np.stack([camera_row(keyframe.camera) for keyframe in self.keyframes])},
        )  # fmt: skip


def _with_points(arrays: dict[str, np.ndarray], holds: np.ndarray) -> dict[str, np.ndarray]:
    """The places of a run with some of the points that its keyframes measured, bool [n]."""
    ends = np.cumsum(arrays["surface_counts"])
    counts = np.diff(np.append(0, np.append(0, np.cumsum(holds))[ends]))
    kept = {name: arrays[name][holds] for name in ("surface_points", "surface_normals")}
    return {**arrays, **kept, "surface_counts": counts.astype(arrays["surface_counts"].dtype)}
