# SPDX-License-Identifier: Apache-2.0
"""Treats a file of Gaussians as a run: its map is the run's map, and cameras on a circle stand for the frames.

`open_map` is the one place where commands that need no more than a map open what they were given.
"""

from __future__ import annotations

import logging
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from ggslam.coding.decoder import decode_in_parts
from ggslam.coding.splats import gaussians_of, is_splat_cloud
from ggslam.errors import FormatError, InputError, RunFolderError
from ggslam.formats.gaussian_rows import GaussiansInMemory
from ggslam.formats.splat_formats import open_splats, splat_format
from ggslam.formats.splat_reader import SplatFile
from ggslam.formats.trajectory import Trajectory
from ggslam.geometry.orbits import orbit
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import MARKER, RunFolder
from ggslam.runs.map_container import is_container, read_contained_map
from ggslam.runs.map_index import MapInParts
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.movers import MoversRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.records.sequence import OpenRecord, SequenceRecord
from ggslam.runs.records.verdict import RunVerdict
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.slam.config import Config
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import given_path, open_untrusted, printable, read_untrusted


class MapViewTuning(Tuning):
    """Cameras around a map without a recording."""

    views = 24
    """Number of cameras."""
    sample = 100_000
    """Gaussians that tell where the cameras stand, about."""


_CAMERA = Camera(960, 720, 800.0, 800.0, 479.5, 359.5)
_STREAMS = (".bin", ".gpcc")
_log = logging.getLogger(__name__)


class MapFile(RunFolder):
    """A run that consists of a map in a file and nothing else.

    Args:
        path: of the file.
        opened: what is in it.
        views: keyframes and recording, where the file tells them; None: cameras around the map.
    """

    def __init__(
        self, path: Path, opened: SplatFile, views: tuple[KeyframesRecord, SequenceRecord] | None = None
    ) -> None:
        super().__init__(path)
        self.opened, self._views = opened, views
        self.has_poses = views is not None
        self.has_recording = False

    def warn(self) -> None:
        """Says aloud (to the log) what was left out or changed when the file was read."""
        for note in self.opened.notes:
            _log.warning("note: %s", printable(f"{self.path}: {note}"))

    def output(self, name: str) -> Path:
        """Where files that a command makes of the map go, if it is not told: beside the file."""
        return self.path.with_name(f"{self.path.stem}_{name}")

    # --- the map -----------------------------------------------------------------------------------------------------

    def gaussians(self, with_moments: bool = False) -> GaussianMap:
        """The map, in memory."""
        if with_moments:
            raise RunFolderError(f"{self.path}: is a file, whose map is not trained further")
        return self.opened.rows.read(0, len(self.opened.rows))

    def map_in_parts(self) -> MapInParts:
        """The map, to be read in blocks of rows."""
        return MapInParts(self.opened.rows, None)

    def has_objects(self) -> bool:
        """Whether Gaussians of the file have object ids other than 0."""
        return self.opened.names is not None and bool(self._table.ids())

    def object_table(self) -> ObjectTable:
        """The objects of the ids in the file; raises RunFolderError if it has none."""
        if not self.has_objects():
            raise RunFolderError(f"{self.path}: this file has no objects: its Gaussians have no object ids")
        return self._table

    @cached_property
    def _table(self) -> ObjectTable:
        names = {i: name for i, name in (self.opened.names or {}).items() if name}
        try:
            return ObjectTable.of_parts(self.opened.rows.blocks(), self.classifier(), "masks", names)
        except InputError as error:  # ids of others may be any number
            _log.warning("note: %s", printable(f"{self.path}: read without objects: {error}"))
            return ObjectTable("masks", len(self.opened.rows))

    def classifier(self) -> IdentityClassifier:
        """The classifier that `ggslam export` puts beside a PLY; one without classes where there is none."""
        channels = self.opened.rows.like.feature_channels
        beside = self.path.with_name(f"{self.path.stem}_classifier.npz")
        if channels and beside.is_file():
            found = IdentityClassifier.from_file(beside)
            if found.weight.shape[1] == channels:
                return found
        return IdentityClassifier.empty(channels)

    def segmented_map(self) -> SegmentedMap:
        """The map with its objects; raises RunFolderError if it has none."""
        table = self.object_table()
        return SegmentedMap(self.gaussians(), self.classifier(), table, None)

    def votes(self) -> ObjectVotes | None:
        """None: a file has none."""
        return None

    # --- what a recording would tell ---------------------------------------------------------------------------------

    @cached_property
    def _around(self) -> np.ndarray:
        step = max(1, len(self.opened.rows) // MapViewTuning.sample)
        return orbit(
            np.concatenate([b.means.numpy()[::step] for b in self.opened.rows.blocks()]), _CAMERA, MapViewTuning.views
        )

    def keyframes(self) -> KeyframesRecord:
        """Cameras around the map, or those that the file tells."""
        if self._views is not None:
            return self._views[0]
        frames = [{"frame": i, "keyframe": i, "T_keyframe_camera": np.eye(4), "status": "tracked"}
                  for i in range(MapViewTuning.views)]  # fmt: skip
        keyframes = [{"index": i, "frame": i, "T_world_camera": pose} for i, pose in enumerate(self._around)]
        return KeyframesRecord.of({"keyframes": keyframes, "frames": frames})

    def sequence(self) -> SequenceRecord:
        """The camera of `keyframes`."""
        if self._views is not None:
            return self._views[1]
        return SequenceRecord(open=OpenRecord(path=str(self.path)), camera=_CAMERA, frames=MapViewTuning.views)

    def mark(self) -> RunRecord:
        """That of a run that lacks nothing that a map has."""
        return RunRecord(complete=True)

    def loops(self) -> LoopsRecord | None:
        """None: there were none."""
        return None

    def movers(self) -> MoversRecord:
        """Nothing moved."""
        return MoversRecord()

    def metrics(self) -> MetricsRecord | None:
        """None: it was not scored."""
        return None

    def verdict(self) -> RunVerdict | None:
        """None: nothing is known of the run that it is of."""
        return None

    def trajectory(self) -> Trajectory:
        """Raises RunFolderError: there is none."""
        raise RunFolderError(f"{self.path}: is a map without a recording: it has no trajectory")

    def config(self) -> Config:
        """Raises RunFolderError: there are no settings."""
        raise RunFolderError(f"{self.path}: is a map without a recording: it has no settings of a run")


def open_map(path: str | Path) -> RunFolder:
    """What was given where a map is needed: a run's folder, or a file of Gaussians; see `splat_formats`. Of ggslam's
    own also `.ggz`, with the poses that it holds, and G-PCC streams of Gaussians.

    Raises:
        RunFolderError: neither, or a damaged run.
        FormatError: a damaged file.
        MissingDependency: a package is needed to read it.
    """
    path = given_path(path, RunFolderError)
    if (path / MARKER).is_file():
        return RunFolder.open(path)
    folder: MapFile | None = None
    if path.is_file() and is_container(path):
        gaussians, names, keyframes, sequence = read_contained_map(path)
        opened = SplatFile("ggslam map", GaussiansInMemory(path, gaussians), names)
        folder = MapFile(path, opened, (keyframes, sequence))
    elif splat_format(path) is not None:
        folder = MapFile(path, open_splats(path))
    elif path.is_file() and path.suffix.lower() in _STREAMS:
        folder = MapFile(path, _of_stream(path))
    if folder is None:
        return RunFolder.open(path)
    folder.warn()
    return folder


def _of_stream(path: Path) -> SplatFile:
    """The Gaussians of a G-PCC stream."""
    open_untrusted(path).close()
    try:
        cloud = decode_in_parts(read_untrusted(path), None)
        if not is_splat_cloud(cloud.like):
            raise FormatError("is a stream of points, not of Gaussians")
        like = gaussians_of(cloud.like)
        out = GaussianMap(like.sh_degree, like.feature_channels, with_moments=False)
        for part in map(gaussians_of, cloud.parts):
            out.append(part.take(torch.arange(len(part))))
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None
    return SplatFile("G-PCC stream", GaussiansInMemory(path, out), {} if "object_id" in cloud.like.attributes else None)
