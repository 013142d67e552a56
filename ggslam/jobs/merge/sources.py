# SPDX-License-Identifier: Apache-2.0
"""The runs that are merged, as far as a merge reads them."""

from __future__ import annotations

import math
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.formats.trajectory import read_tum
from ggslam.merging.known_run import KnownRun
from ggslam.merging.objects import RunObjects
from ggslam.native.loader import NativeContext
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_container import is_container, read_container
from ggslam.runs.merge_inputs import read_known_run, read_map
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.sequence import PartRecord, SequenceRecord
from ggslam.runs.writing import TRUTH_FILE
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.sequences import Sequence
from ggslam.slam.config import Config
from ggslam.system.tuning import Tuning


class MergeTimeTuning(Tuning):
    """How the times of several recordings are compared."""

    same_time_s = 1e-6
    """Largest difference between equal times, in seconds."""
    pause_s = 1.0
    """Smallest gap between two recordings whose times are shifted, in seconds."""


@dataclass
class MergeSource:
    """A run that is merged.

    Attributes:
        folder: of the run.
        known: its keyframes and places.
        record: of its keyframes and frames.
        recording: how its recording was read.
        gaussians: its map.
        objects: its map with objects; None: it has none.
        sequence: its recording; None: it is not there any more (`reason` says why).
        first_frame, first_keyframe: what its frames and keyframes count from in the whole.
        time_shift_s: added to its times.
    """

    folder: RunFolder
    known: KnownRun
    record: KeyframesRecord
    recording: SequenceRecord
    gaussians: GaussianMap
    objects: SegmentedMap | None
    sequence: Sequence | None
    reason: str = ""
    first_frame: int = 0
    first_keyframe: int = 0
    time_shift_s: float = 0.0
    gaussian_count: int = 0
    """Of its map as it was read."""
    origin: Path | None = None
    """The container that the folder was made of, if it was."""

    @staticmethod
    def read(folder: RunFolder, context: NativeContext) -> MergeSource:
        """Reads a run, but for its map.

        Raises:
            GgslamError: files are missing or damaged.
        """
        sequence, reason = None, ""
        try:
            sequence = open_recording_of(folder)
        except GgslamError as error:
            reason = str(error)
        nothing = GaussianMap(with_moments=False)
        known = read_known_run(folder, context)
        return MergeSource(folder, known, folder.keyframes(), folder.sequence(), nothing, None, sequence, reason)

    @property
    def name(self) -> str:
        """For people."""
        return str(self.origin or self.folder.path)

    @property
    def place(self) -> str:
        """The run or its container, for records."""
        return str((self.origin or self.folder.path).absolute())

    @property
    def frame_count(self) -> int:
        """Frames of its recordings."""
        return self.recording.frames or 1 + max((f.frame for f in self.record.frames), default=-1)

    def read_map(self) -> None:
        """Reads its map, with objects if it has any."""
        self.gaussians, self.objects = read_map(self.folder)
        self.gaussian_count = len(self.gaussians)

    def times(self) -> np.ndarray:
        """Seconds of its frames as the whole has them, float64 [n], NaN where unknown."""
        return np.array([f.timestamp for f in self.record.frames], float) + self.time_shift_s

    def parts(self) -> list[PartRecord]:
        """Its recordings as parts of the whole's, with their own numbering of masks."""
        if self.recording.parts is not None:
            return list(self.recording.parts)
        names = ("open", "format", "camera", *(("rig",) if self.recording.rig is not None else ()))
        values = {name: getattr(self.recording, name) for name in names}
        return [PartRecord(run=self.place, frames=self.frame_count, **values)]

    def run_objects(self) -> RunObjects | None:
        """Its objects, if it has any."""
        if self.objects is None:
            return None
        return RunObjects(self.objects.table, self.objects.classifier, self._mask_source(), self.first_frame)

    def has_lasting_ids(self) -> bool:
        """Whether the masks of its recording taught it objects, with ids that stay."""
        return self.objects is not None and self._mask_source() is not None

    def _mask_source(self) -> str | None:
        """Where masks with constant ids come from; None: they were not such masks."""
        assert self.objects is not None
        opened = self.recording.open
        if self.objects.table.supervision != "masks" or self.recording.parts is not None:
            return None
        return str(Path(opened.masks or opened.path).resolve())

    def true_poses(self) -> np.ndarray | None:
        """T_world_camera of its frames as records have them, float64 [n, 4, 4] with NaN, in the recording's own world;
        None: nobody knows them."""
        frames = self.record.frames
        path = self.folder.path / TRUTH_FILE
        found = np.full((len(frames), 4, 4), np.nan)
        if path.is_file():
            truth = read_tum(path)
            times = np.array([f.timestamp for f in frames], float)
            at = np.clip(
                np.searchsorted(truth.timestamps, times - MergeTimeTuning.same_time_s), 0, max(0, len(truth) - 1)
            )
            if len(truth):
                known = np.abs(truth.timestamps[at] - times) < 2 * MergeTimeTuning.same_time_s
                if self.recording.rig is not None:  # the others' truth is not in the file
                    numbers = self.recording.rig.places[[f.frame for f in frames], 1]
                    known &= numbers == 0
                found[known] = truth.T_world_camera[at[known]]
        elif self.sequence is not None and self.sequence.ground_truth is not None:
            inside = [k for k, f in enumerate(frames) if f.frame < len(self.sequence)]
            found[inside] = self.sequence.ground_truth[[frames[k].frame for k in inside]]
        return found if np.isfinite(found).all((1, 2)).any() else None


def joint_config(sources: ListOf[MergeSource], gaussians: GaussianMap) -> Config:
    """Settings of a run that several became: those of the first, with the map's degree, unless all runs fitted their
    colours that depend on the view."""
    configs = [source.folder.config() for source in sources]
    fitted = all(config.fits_view_colors for config in configs)
    return replace(configs[0], sh_degree=configs[0].sh_degree if fitted else gaussians.sh_degree)


def read_sources(paths: ListOf[Path], context: NativeContext, unpacked: Path) -> list[MergeSource]:
    """Opens the runs, in their order; frames, keyframes and times of each follow those of the one before.

    Args:
        paths: of runs, or of containers (`map.ggz`) of some.
        context: threads.
        unpacked: folder that containers are unpacked to; it has to stay while the sources are used.

    Raises:
        ConfigError: fewer than two runs, one given twice, or runs whose places cannot be compared.
        GgslamError: a run is damaged or lacks places.
    """
    if len(paths) < 2:
        raise ConfigError(f"merging needs two runs or more, found {len(paths)}")
    resolved = [Path(path).resolve() for path in paths]
    twice = [path for k, path in enumerate(paths) if resolved[k] in resolved[:k]]
    if twice:
        raise ConfigError(f"{twice[0]}: was given twice; a run counts once")
    sources = [_open_source(Path(path), context, unpacked / f"{k}") for k, path in enumerate(paths)]
    _check_comparable(sources)
    for before, source in zip(sources, sources[1:], strict=False):
        source.first_frame = before.first_frame + before.frame_count
        source.first_keyframe = before.first_keyframe + len(before.known)
    _shift_times(sources)
    return sources


def _open_source(path: Path, context: NativeContext, unpacked: Path) -> MergeSource:
    if not (is_container(path) and path.is_file()):
        return MergeSource.read(RunFolder.open(path), context)
    source = MergeSource.read(read_container(path, unpacked), context)
    source.origin, source.known.name = path, str(path)
    return source


def _check_comparable(sources: list[MergeSource]) -> None:
    first = sources[0]
    for other in sources[1:]:
        if other.known.places.settings != first.known.places.settings:
            raise ConfigError(
                f"{other.name}: its places were described by other settings (loops.places) than those of {first.name}, "
                "so they cannot be compared"
            )
    empty = [source for source in sources if not source.record.poses()]
    if empty:
        raise RunFolderError(f"{empty[0].name}: none of its frames was located")


def _shift_times(sources: list[MergeSource]) -> None:
    """Times of a run that begins before the one before it ends are shifted by whole seconds."""
    end = -math.inf
    for source in sources:
        times = source.times()
        if not np.isfinite(times).any():
            continue
        begin = float(np.nanmin(times))
        if begin <= end:
            source.time_shift_s = float(math.ceil(end - begin + MergeTimeTuning.pause_s))
        end = float(np.nanmax(times)) + source.time_shift_s
