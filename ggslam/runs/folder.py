# SPDX-License-Identifier: Apache-2.0
"""The files of a run. Each is written to a temporary name and renamed, so none is ever half there.

    loops.json       closures and what became of other candidates, stretches in which the camera was lost
    trajectory.txt   TUM: timestamp tx ty tz qx qy qz qw, camera to world, the world being the first camera
    keyframes.json   poses, exposures and frame numbers of the keyframes; how each frame was tracked
    map.ply          Gaussians in the fields of 3DGS
    map_cells.json   of a run whose memory was limited: which rows of map.ply lie in which cell
    points.ply       coloured points of the surface, metres; points_grid.ply: the same in integer grid cells
    places.npz       what another recording needs to start in this map
    config.yaml      the settings; sequence.json: where the recording was and how it was read
    timing.json      seconds by part; steps.csv: the same, memory, Gaussians and losses step by step
    metrics.json     scores; renders/: pictures; report.html: all of it to look at; ground_truth.txt: true poses for it
    verdict.json     how good the run is, told by its own figures
    volumes/         by `ggslam volumes`; plots/: by `ggslam report --plots`
of a run with objects, whose map.ply also holds each Gaussian's object id and identity vector:
    objects.json     the objects: ids, names, boxes, ...; there if and only if the other files of the objects are whole
    classifier.npz   turns identity vectors into objects; votes.npz: mask ids that each Gaussian was seen under
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.errors import FormatError, NotARunError, RunFolderError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.trajectory import Trajectory, read_tum, write_tum
from ggslam.movers.point_files import POINTS_FILE, points_from_arrays
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.runs.checkpoints import has_checkpoints
from ggslam.runs.manifest import refuse_mixed
from ggslam.runs.map_index import MapInParts
from ggslam.runs.publishing import change_files, publish_run
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.movers import MoversRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.runs.records.verdict import RunVerdict
from ggslam.runs.writing import RUN_FILES, RunToWrite
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.slam.config import Config, config_from_dict
from ggslam.slam.result import SlamResult
from ggslam.system.folder_lock import LOCK_FILE, refuse_other_writers
from ggslam.system.missing_paths import why_missing
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml
from ggslam.system.staging import finish_saving, is_being_saved, leftovers, refuse_links_at
from ggslam.system.untrusted_files import given_path, printable, read_untrusted_text, refuse_links

MARKER = RunRecord.FILE
"""Is there if and only if a folder is a run of ggslam."""
_log = logging.getLogger(__name__)


class RunFolder:
    """A run on disk.

    Args:
        path: the folder. Use `create` for a new one and `open` for one that is there.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.has_poses = True
        """Whether cameras saw the map from the poses of `keyframes`; False: they were made up, around it."""
        self.has_recording = True
        """Whether there was a recording that may still be there."""
        self._made_here = False

    def output(self, name: str) -> Path:
        """Where files that a command makes of the run go, if it is not told."""
        return self.path / name

    @staticmethod
    def create(path: Path, overwrite: bool = False) -> RunFolder:
        """Makes the folder, or takes an empty one, or with `overwrite` an earlier run's.

        Raises:
            RunFolderError: it holds something else, or a run that was not to be replaced, or a link in the place of one
                of its files, or cannot be written to.
        """
        folder = RunFolder(path)
        refuse_other_writers(folder.path)
        try:
            refuse_links(folder.path, RunFolderError)
            if folder.path.is_dir() and folder._content():
                if not overwrite and has_checkpoints(folder.path):
                    raise RunFolderError(f"{path}: there is a run that was cut off; use `resume` or `overwrite`")
                if not (folder.path / MARKER).exists() and not has_checkpoints(folder.path):
                    raise RunFolderError(f"{path}: not empty and not a run of ggslam; choose another folder with `out`")
                if not overwrite:
                    raise RunFolderError(f"{path}: there is a run already; use `overwrite` or another `out`")
            else:
                folder.path.mkdir(parents=True, exist_ok=True)
                folder._made_here = True
        except OSError as error:
            raise RunFolderError(f"{path}: cannot be written to: {error.strerror or error}") from None
        refuse_links_at(folder.path, (MARKER, *RUN_FILES))
        folder.check_writable()
        return folder

    @staticmethod
    def open(path: Path) -> RunFolder:
        """A run that is there. If saving it was interrupted while files changed places, that is finished.

        Raises:
            RunFolderError: no such folder, or not a run, or one whose saving cannot be finished, or files of several.
        """
        path = given_path(path, RunFolderError)
        if not (path / MARKER).is_file():
            if has_checkpoints(path):
                raise RunFolderError(f"{path}: the run was cut off before it was saved; go on with it: `resume`")
            raise no_run(Path(path))
        refuse_links(path, RunFolderError)
        if is_being_saved(Path(path), MARKER):
            finish_saving(Path(path), MARKER)
        folder = RunFolder(path)
        folder.warn()
        return folder

    def warn(self) -> None:
        """Says aloud (to the log) what is wrong with the run, as far as it can be read all the same.

        Raises:
            RunFolderError: its files are not of one run.
        """
        mark = self.mark()
        problems = [str(problem) for problem in refuse_mixed(self.path, mark)]
        reason = mark.stopped_by or (f"lacks {', '.join(mark.missing)}" if mark.missing else "saving did not finish")
        problems += [] if mark.complete else [f"the run is incomplete: {reason}"]
        for problem in problems:
            _log.warning("warning: %s", printable(f"{self.path}: {problem}"))

    @staticmethod
    def open_unfinished(path: Path) -> RunFolder:
        """A run that was cut off, and left checkpoints.

        Raises:
            RunFolderError: no such folder, or there is nothing to go on from.
        """
        refuse_other_writers(Path(path))
        if has_checkpoints(Path(path)):
            refuse_links_at(Path(path), (MARKER, *RUN_FILES))
            return RunFolder(path)
        folder = RunFolder.open(path)
        whole = folder.mark().complete
        reason = "the run is complete" if whole else "it has no checkpoints"
        raise RunFolderError(f"{path}: there is nothing to resume: {reason}")

    def _content(self) -> set[Path]:
        """What is in the folder, but for what killed programs left and the lock."""
        return set(self.path.iterdir()) - {*leftovers(self.path), self.path / LOCK_FILE}

    def check_writable(self) -> None:
        """Raises RunFolderError if files cannot be written to the folder."""
        try:
            self._probe()
        except OSError as error:
            raise RunFolderError(f"{self.path}: cannot be written to: {error.strerror or error}") from None

    def _probe(self) -> None:
        """Finds out now, not after hours of work, whether files can be written."""
        probe = self.path / f".probe-{os.getpid()}-{secrets.token_hex(4)}"
        try:
            probe.write_bytes(b"x")
        finally:
            probe.unlink(missing_ok=True)

    def discard(self) -> None:
        """Removes the folder if it was made by `create` and is still empty."""
        if self._made_here and not self._content():
            (self.path / LOCK_FILE).unlink(missing_ok=True)
            self.path.rmdir()

    # --- writing -----------------------------------------------------------------------------------------------------

    def save(
        self, config: Config, sequence: SequenceRecord, result: SlamResult, error: str | None = None,
        names: Mapping[int, str] | None = None, wanted: Collection[str] = (),
    ) -> None:  # fmt: skip
        """Writes everything but scores and pictures. What an earlier run left there goes when all of it is on the disk.

        Args:
            config: all settings.
            sequence: how the recording was read, for scoring later.
            result: of the run.
            error: why the run stopped early, if it did.
            names: of object ids, as far as the recording knows them.
            wanted: names of files that are to be made yet; until then the run is not complete.

        Raises:
            RunFolderError: a file cannot be written. If it is one of the clouds, everything else is there.
        """
        self.write(RunToWrite(config, sequence, result, error, names or {}, tuple(wanted)))

    def write(self, run: RunToWrite, least: bool = False) -> None:
        """As `save`; with `least` only what a run cannot do without."""
        write = run.write_least if least else run.write
        publish_run(self.path, write, RUN_FILES, f"{self.path}: the run cannot be written")
        if run.failure is not None:
            raise run.failure

    def write_poses(self, run: RunToWrite, reason: str) -> RunFolder:
        """Writes what is small of a run whose map cannot be saved: poses, settings, records, and why.

        Returns:
            Where they are: here, or beside this folder if it holds a run with a map, to which they do not belong.

        Raises:
            RunFolderError: a file cannot be written.
        """
        return self._publish_poses(lambda folder: run.write_poses(folder, reason))

    def _publish_poses(self, write: Callable[[Path], RunRecord]) -> RunFolder:
        """Writes poses here, or beside this folder if it holds a run with a map; returns where they are."""
        target = self._without_map()
        there = target.path.is_dir()
        try:
            publish_run(target.path, write, RUN_FILES, f"{self.path}: the trajectory cannot be written")
        except BaseException:
            if not there:
                shutil.rmtree(target.path, ignore_errors=True)
            raise
        return target

    def _without_map(self) -> RunFolder:
        """This folder, or a new one beside it if it holds a run with a map."""
        if not (self.path / "map.ply").exists() and not is_being_saved(self.path, MARKER):
            return self
        there = self.path.resolve()
        return RunFolder(there.with_name(f"{there.name}-poses-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"))

    def save_trajectory(self, timestamps: np.ndarray, poses: np.ndarray, error: str) -> RunFolder:
        """Writes what is left of a run whose map is lost: trajectory.txt, and why it stopped; returns where they are,
        as `write_poses`.

        Args:
            timestamps: seconds, [n].
            poses: T_world_camera [n, 4, 4], NaN where lost.
            error: why it stopped.
        """

        def write(folder: Path) -> RunRecord:
            write_tum(folder / "trajectory.txt", timestamps, poses)
            return RunRecord(ggslam=__version__, complete=False, stopped_by=error, missing=["map.ply"])

        return self._publish_poses(write)

    def change_files(self, *names: str) -> AbstractContextManager[None]:
        """Files (or folders of files) of the run are written within the block; see `publishing.change_files`."""
        return change_files(self.path, names)

    # --- reading -----------------------------------------------------------------------------------------------------

    def mark(self) -> RunRecord:
        """run.json. This and the next raise RunFolderError if the file is missing or damaged."""
        return RunRecord.read(self.path)

    def sequence(self) -> SequenceRecord:
        """sequence.json: where the recording is and how it was read."""
        return SequenceRecord.read(self.path)

    def keyframes(self) -> KeyframesRecord:
        """keyframes.json: where the keyframes are, and how each frame was tracked."""
        return KeyframesRecord.read(self.path)

    def timing(self) -> TimingRecord:
        """timing.json: where the time went."""
        return TimingRecord.read(self.path)

    def loops(self) -> LoopsRecord | None:
        """loops.json; None if an older run has none."""
        return LoopsRecord.read_if_there(self.path)

    def movers(self) -> MoversRecord:
        """What moved while the recording was made; nothing of a run that did not look for it."""
        return MoversRecord.read_if_there(self.path) or MoversRecord()

    def mover_points(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Points float32 [n, 3] of each mover in its own frame, and their colours uint8 [n, 3].

        Raises:
            RunFolderError: the file is missing or damaged.
        """
        path = self.path / POINTS_FILE
        try:
            return points_from_arrays(read_all_arrays(path, "points of movers"))
        except FormatError as error:
            raise RunFolderError(f"{path}: cannot be read: {str(error).removeprefix(f'{path}: ')}") from None

    def metrics(self) -> MetricsRecord | None:
        """metrics.json: the scores; None if the run was not scored."""
        return MetricsRecord.read_if_there(self.path)

    def verdict(self) -> RunVerdict | None:
        """verdict.json: how good the run is; None of one that was edited, merged or made by an older version."""
        return RunVerdict.read_if_there(self.path)

    def config(self) -> Config:
        """The settings of the run."""
        path = self.path / "config.yaml"
        try:
            return config_from_dict(parse_yaml(read_untrusted_text(path, RunFolderError)), str(path))
        except PlainYamlError as error:
            raise RunFolderError(f"{path}: cannot be read: {error}") from None

    def gaussians(self, with_moments: bool = False) -> GaussianMap:
        """The map; optimizer state, if there is room for it, begins anew."""
        return read_gaussian_ply(self.path / "map.ply", with_moments=with_moments)

    def map_in_parts(self) -> MapInParts:
        """The map, to be read in blocks of rows, or as far as a view needs it if it was written cell by cell.

        Raises:
            FormatError: map or index are damaged or do not belong together.
        """
        return MapInParts.of_folder(self.path)

    def trajectory(self) -> Trajectory:
        """Camera poses of all frames."""
        return read_tum(self.path / "trajectory.txt")

    def has_objects(self) -> bool:
        """Whether the run has objects."""
        return (self.path / "objects.json").is_file()

    def object_table(self) -> ObjectTable:
        """The objects alone, without the map.

        Raises:
            RunFolderError: the run has no objects.
            FormatError: objects.json is damaged.
        """
        if not self.has_objects():
            raise RunFolderError(f"{self.path}: this run has no objects: its map is not segmented")
        return ObjectTable.load(self.path / "objects.json")

    def classifier(self) -> IdentityClassifier:
        """What turns identity vectors into objects.

        Raises:
            FormatError: the file is missing or damaged.
        """
        return IdentityClassifier.from_file(self.path / "classifier.npz")

    def segmented_map(self) -> SegmentedMap:
        """The map with its objects, without optimizer state.

        Raises:
            RunFolderError: the run has no objects, or its files do not belong together.
            FormatError: a file is missing or damaged.
        """
        table, gaussians, classifier = self.object_table(), self.gaussians(), self.classifier()
        self.check_objects(table, classifier, gaussians, set(np.unique(gaussians.object_id.numpy()).tolist()))
        votes = self.votes()
        if votes is not None:
            self.check_votes(len(votes), len(gaussians))
        return SegmentedMap(gaussians, classifier, table, votes)

    def check_objects(
        self, table: ObjectTable, classifier: IdentityClassifier, like: GaussianMap, present: Collection[int]
    ) -> None:
        """Raises RunFolderError if a map with the channels of `like` and Gaussians of the objects `present` is not
        what table and classifier speak of."""
        channels, found = classifier.weight.shape[1], like.features.shape[1]
        if found != channels:
            raise RunFolderError(f"{self.path / 'map.ply'}: expected {channels} properties identity_*, found {found}")
        lacking = sorted(set(table.ids()) - set(present))
        if lacking:
            named = f"object {lacking[0]}" + (f" and {len(lacking) - 1} more" if lacking[1:] else "")
            raise RunFolderError(f"{self.path / 'map.ply'}: no Gaussian is of {named}, which objects.json lists")

    def check_votes(self, votes: int, gaussians: int) -> None:
        """Raises RunFolderError if there are votes of another number of Gaussians."""
        if votes != gaussians:
            raise RunFolderError(f"{self.path / 'votes.npz'}: expected votes of {gaussians} Gaussians, found {votes}")

    def votes(self) -> ObjectVotes | None:
        """Votes of the Gaussians of map.ply, None if they were not counted.

        Raises:
            FormatError: the file is damaged.
        """
        path = self.path / "votes.npz"
        return ObjectVotes.from_file(path) if path.is_file() else None


@contextmanager
def as_written(path: Path) -> Iterator[None]:
    """What goes wrong in the block is the fault of a file, or of files in a folder: RunFolderError says so."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise RunFolderError(f"{path}: not as ggslam writes it: {error!r}") from error


def no_run(path: Path) -> RunFolderError:
    """The error that says what is there instead of a run."""
    if path.is_dir():
        return NotARunError(path, "is not a run of ggslam (no run.json)")
    if path.is_file():
        more = "; `ggslam decode` makes one of it" if path.suffix in (".ggz", ".ggc") else ""
        return NotARunError(path, f"is a file, and a run is a folder{more}")
    if path.exists():
        return RunFolderError(f"{path}: is neither a folder nor a regular file (a pipe or a device?)")
    return RunFolderError(f"{path}: {why_missing(path, 'no such folder')}")
