# SPDX-License-Identifier: Apache-2.0
"""Recordings of laser scans: a folder with one file a scan, in the order of their names, and a file of poses.

    scans/000000.bin ...    or the files in the folder itself: .bin (float32), .npy [n, 3 or more], .pcd
    trajectory.txt          TUM (timestamp tx ty tz qx qy qz qw) or one matrix a line (KITTI, Replica), a row a scan;
                            or groundtruth.txt, poses.txt, trajectory.csv (EuRoC), poses.g2o; sensor to world; may be
                            absent: then the VIEWPOINT lines of .pcd files are the poses, where one is no identity
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import NoPointsError, SequenceError
from ggslam.formats.cloud_files import NOT_READ, read_cloud_file
from ggslam.formats.pcd import read_viewpoint
from ggslam.formats.trajectory import read_trajectory
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

_SUFFIXES = (".bin", ".npy", ".pcd")
_POSES = ("trajectory.txt", "groundtruth.txt", "poses.txt", "trajectory.csv", "poses.g2o")
_BAGS = (".bag", ".mcap")
"""These may hold images."""


class ScanTuning(Tuning):
    """Recordings of scans."""

    rate = 10.0
    """Assumed scans per second of a recording without times."""


@dataclass(frozen=True)
class LaserScan:
    """One scan: number in the selection, seconds, points float32 [n, 3] in the sensor's frame, metres."""

    index: int
    timestamp: float
    points: np.ndarray


class ScanSequence:
    """The selected scans of a folder.

    Attributes:
        path: the folder.
        timestamps: float64 [n], seconds.
        ground_truth: float64 [n, 4, 4] T_world_sensor, or None.
    """

    def __init__(
        self, path: Path, start: int = 0, stop: int | None = None, stride: int = 1,
        columns: int | None = None,
    ) -> None:
        """Finds the scans and reads the poses; `columns`: of .bin files, see `read_raw_points`.

        Raises:
            SequenceError: no scans, or none selected, or another number of poses.
            FormatError: the poses are damaged.
        """
        self.path, self._columns = Path(path), columns
        self._told = False
        self._empty: set[int] = set()
        files = scan_files(self.path)
        if not files:
            raise SequenceError(f"{path}: no scans ({', '.join(_SUFFIXES)})")
        times, poses = _poses(self.path, files)
        chosen = np.arange(len(files))[start:stop:stride]
        if not len(chosen):
            raise SequenceError(f"{path}: no scan of {len(files)} is selected")
        self._files = [files[i] for i in chosen.tolist()]
        self.timestamps: np.ndarray = times[chosen]
        self.ground_truth: np.ndarray | None = None if poses is None else poses[chosen]

    def __len__(self) -> int:
        return len(self._files)

    @property
    def all_empty(self) -> bool:
        """Whether all scans were read and none has a point."""
        return len(self._empty) == len(self)

    def scan(self, index: int) -> LaserScan:
        """Reads a scan of the selection; one that saw nothing has no points. Of the first with points that have no
        position, how many is told.

        Raises:
            FormatError: it is damaged.
        """
        points = np.zeros((0, 3), np.float32)
        try:
            cloud = read_cloud_file(self._files[index], self._columns, tell=not self._told)
            self._told = self._told or cloud.nowhere > 0
            points = cloud.points.astype(np.float32)
        except NoPointsError:
            pass
        if not len(points):
            self._empty.add(index)
        return LaserScan(index, float(self.timestamps[index]), points)

    def stream(self) -> Iterator[LaserScan]:
        """All scans in order."""
        return map(self.scan, range(len(self)))


def scan_files(path: Path) -> list[Path]:
    """The files of the scans in a folder, in order; empty if it is no recording of scans."""
    for folder in (path / "scans", path):
        if folder.is_dir():
            files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)
            if files:
                return files
    return []


def refuse_unread_scans(path: Path) -> None:
    """Raises SequenceError for a folder of scans of a kind that is not read; says why."""
    for folder in (path / "scans", path):
        for file in sorted(folder.iterdir()) if folder.is_dir() else []:
            if file.suffix.lower() in NOT_READ and file.suffix.lower() not in _BAGS:
                raise SequenceError(f"{file}: is not read: {NOT_READ[file.suffix.lower()]}")


def _poses(folder: Path, files: list[Path]) -> tuple[np.ndarray, np.ndarray | None]:
    count = len(files)
    for name in _POSES:
        if (folder / name).is_file():
            found = read_trajectory(folder / name)
            if len(found) != count:
                raise SequenceError(f"{folder / name}: {quantity(len(found), 'pose')} for {quantity(count, 'scan')}")
            by_row = np.array_equal(found.timestamps, np.arange(count))
            return found.timestamps / (ScanTuning.rate if by_row else 1.0), found.T_world_camera
    return np.arange(count) / ScanTuning.rate, _viewpoints(files)


def _viewpoints(files: list[Path]) -> np.ndarray | None:
    """Poses that the scans' own files tell, [n, 4, 4]; None where they tell nothing."""
    if any(file.suffix.lower() != ".pcd" for file in files):
        return None
    found = [read_viewpoint(file) for file in files]
    poses = np.array([np.eye(4) if T is None else T for T in found])
    if (poses == np.eye(4)).all():
        return None
    for file, T in zip(files, found, strict=True):
        if T is None:
            raise SequenceError(f"{file}: has no VIEWPOINT, and other scans beside it have one: where was it made?")
    return poses
