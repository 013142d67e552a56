# SPDX-License-Identifier: Apache-2.0
"""The files of a run, written into a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.errors import GgslamError, RunFolderError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.trajectory import write_tum
from ggslam.movers.point_files import POINTS_FILE, points_to_arrays
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.runs.environment import environment
from ggslam.runs.map_index import MAP_INDEX
from ggslam.runs.records.annotations import AnnotationsRecord, CameraKeysRecord
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.movers import MOVER_FILES, MoversRecord
from ggslam.runs.records.run_json import RunRecord, VerdictRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.runs.records.verdict import RunVerdict
from ggslam.runs.saving_parts import save_map_in_parts, save_points
from ggslam.scene.arrays import arrays_to_bytes
from ggslam.sequences.moving_pixels import MOVERS_FILE
from ggslam.sequences.verdicts import Verdict
from ggslam.slam.config import Config, save_config
from ggslam.slam.result import SlamResult
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.slam.step_log import STEPS_FILE
from ggslam.system.atomic import make_folder, write_bytes, write_text

OBJECT_FILES = ("objects.json", "classifier.npz", "votes.npz")
"""Files of a run with objects, in the order in which they are removed; they are written in the opposite one."""
TRUTH_FILE = "ground_truth.txt"
"""True poses of the frames that have both, with the times of trajectory.txt; written by the report."""
REPORT_FILE = "report.html"
CHANGES_FOLDER = "changes"
"""Of a run that was brought up to date: what changed, as `ggslam changes --out` writes it."""
POINTS = ("points.ply", "points_grid.ply")
TRAJECTORIES = "trajectories"
"""Folder with a trajectory of each camera of a rig; trajectory.txt is that of the rig."""
RUN_FILES = (
    *OBJECT_FILES, "map.ply", MAP_INDEX, "trajectory.txt", KeyframesRecord.FILE, LoopsRecord.FILE, SequenceRecord.FILE,
    TimingRecord.FILE, "config.yaml", "metrics.json", "frames.csv", RunVerdict.FILE, *POINTS, PLACES_FILE, STEPS_FILE,
    TRUTH_FILE, *MOVER_FILES, REPORT_FILE, "renders", "volumes", "plots", TRAJECTORIES, CHANGES_FOLDER,
    AnnotationsRecord.FILE, CameraKeysRecord.FILE,
)  # fmt: skip
"""Files and folders that a run may have besides run.json."""


@dataclass
class RunToWrite:
    """The arguments of `RunFolder.save`.

    Attributes:
        wanted: names of files that are to be made yet.
        verdicts: what seems wrong with the run.
        failure: why the clouds could not be written.
        loss: name of the user's own loss.
    """

    config: Config
    sequence: SequenceRecord
    result: SlamResult
    error: str | None
    names: Mapping[int, str]
    wanted: tuple[str, ...]
    verdicts: Sequence[Verdict] = ()
    failure: GgslamError | OSError | None = None
    loss: str | None = None

    def write(self, folder: Path) -> RunRecord:
        """Writes everything but run.json, what is small and precious first; returns what that is to say.

        Raises:
            GgslamError, OSError: a file cannot be written; of the clouds, `failure` says it.
        """
        self._write_records(folder)
        self._write_map(folder)
        result = self.result
        if result.steps is not None:
            write_text(folder / STEPS_FILE, result.steps)
        if result.places is not None:
            write_bytes(folder / PLACES_FILE, result.places)
        try:  # last and largest; `ggslam export --format points` makes them again from the map
            save_points(folder)
        except (GgslamError, OSError, MemoryError) as failure:
            short = RunFolderError(f"{POINTS[0]}: not enough memory: {failure}")
            self.failure = short if isinstance(failure, MemoryError) else failure
            for name in POINTS:
                (folder / name).unlink(missing_ok=True)
        else:
            TimingRecord.of_result(result).write(folder)  # once more: peak memory is that of the whole run
        return self._mark((*self.wanted, *(POINTS if self.failure is not None else ())))

    def write_least(self, folder: Path) -> RunRecord:
        """As `write`, but only the map with its objects, poses, settings: what a run cannot do without."""
        self._write_records(folder)
        self._write_map(folder)
        return self._mark((*self.wanted, *POINTS))

    def write_poses(self, folder: Path, reason: str) -> RunRecord:
        """As `write`, but without the map, for this reason: poses, settings, records."""
        self._write_records(folder)
        mark = self._mark((*self.wanted, "map.ply", *POINTS))
        return mark.model_copy(update={"stopped_by": self.error or reason})

    def _write_records(self, folder: Path) -> None:
        """What is small and cannot be made again."""
        result = self.result
        save_config(self.config, folder / "config.yaml")
        write_trajectories(folder, self.sequence, result)
        records = (KeyframesRecord.of_result(result), TimingRecord.of_result(result), LoopsRecord.of_result(result))
        for record in (self.sequence, *records):
            record.write(folder)

    def _write_map(self, folder: Path) -> None:
        result = self.result
        if len(result.moving):
            write_bytes(folder / MOVERS_FILE, arrays_to_bytes(**result.moving.to_arrays()))
            MoversRecord.of_result(result, self.names).write(folder)
            write_bytes(folder / POINTS_FILE, arrays_to_bytes(**points_to_arrays(result.movers)))
        if result.cells is not None:
            save_map_in_parts(folder, result, self.names)
        elif result.objects is None:
            write_gaussian_ply(folder / "map.ply", result.gaussians)
        else:
            write_objects(folder, segment_map(result, self.names))

    def _mark(self, missing: tuple[str, ...]) -> RunRecord:
        """run.json of the run without these files."""
        return RunRecord(
            ggslam=__version__, complete=self.error is None and not missing, stopped_by=self.error,
            missing=list(missing), verdicts=[VerdictRecord(**vars(verdict)) for verdict in self.verdicts],
            environment={**environment(self.config.threads), "device": self.result.device},
            loss=self.loss,
        )  # fmt: skip


def write_trajectories(folder: Path, sequence: SequenceRecord, result: SlamResult) -> None:
    """Writes trajectory.txt: the poses of all frames; of a rig those of its first camera, one for each instant, and
    those of the frames of each camera into a folder of their own."""
    times, poses = result.timestamps(), result.trajectory()
    if sequence.rig is None:
        write_tum(folder / "trajectory.txt", times, poses)
        return
    frames = [frame.frame_index for frame in result.frames]
    first = sequence.rig.first_of_instants(frames)
    of_rig = [sequence.rig.pose_of_first(poses[k], frames[k]) for k in first]
    write_tum(folder / "trajectory.txt", times[first], np.array(of_rig).reshape(-1, 4, 4))
    make_folder(folder / TRAJECTORIES)
    for number, name in enumerate(sequence.rig.names):
        own = sequence.rig.places[frames, 1] == number
        write_tum(folder / TRAJECTORIES / f"{name}.txt", times[own], poses[own])


def write_objects(folder: Path, segmented: SegmentedMap) -> None:
    """Writes a map with its objects: map.ply with object ids and identity vectors, and the files beside it."""
    for stale in OBJECT_FILES:
        (folder / stale).unlink(missing_ok=True)
    write_gaussian_ply(folder / "map.ply", segmented.gaussians, extra=("object_id", "identity"))
    if segmented.votes is not None:
        write_bytes(folder / "votes.npz", segmented.votes.to_bytes())
    write_bytes(folder / "classifier.npz", segmented.classifier.to_bytes())
    segmented.table.save(folder / "objects.json")


def segment_map(result: SlamResult, names: Mapping[int, str] | None = None) -> SegmentedMap:
    """A run's map with its objects. Names are taken only where ids are the masks' own."""
    assert result.objects is not None
    found = result.objects
    known = names if found.supervision == "masks" else None
    table = ObjectTable.build(result.gaussians, found.classifier, found.supervision, known, found.observations)
    return SegmentedMap(result.gaussians, found.classifier, table, ObjectVotes.of(result.gaussians))
