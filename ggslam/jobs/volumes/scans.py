# SPDX-License-Identifier: Apache-2.0
"""Laser scans with poses: what volumes are made of where there is no camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.driving.body import Body
from ggslam.errors import ConfigError
from ggslam.jobs.submaps.given_poses import poses_of_items
from ggslam.localization.scans import LaserScan, ScanSequence
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.poses import is_valid_pose
from ggslam.system.plurals import quantity, word_for
from ggslam.volumes.posed_view import PosedScan
from ggslam.volumes.scan_faces import ScanFaces

_SENSOR_FROM_UPRIGHT: Final = np.array(
    [(0.0, 0.0, 1.0, 0.0), (-1.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)]
)
"""Axes of a camera that looks ahead of a sensor whose x axis is ahead and whose z axis is up."""


@dataclass(frozen=True)
class SensorScan:
    """A scan whose pose is known.

    Attributes:
        scan: the points.
        T_world_sensor: float64 [4, 4].
        faces: of scans of the sensor.
    """

    scan: LaserScan
    T_world_sensor: np.ndarray
    faces: ScanFaces
    instant: None = None

    @property
    def timestamp(self) -> float:
        """Seconds."""
        return self.scan.timestamp

    @property
    def depth(self) -> np.ndarray:
        """How far all points are, metres, float32 [n, 1]."""
        return np.linalg.norm(self.scan.points, axis=1, keepdims=True)

    @property
    def T_world_upright(self) -> np.ndarray:
        """See `PosedFrame.T_world_upright`."""
        return self.T_world_sensor @ _SENSOR_FROM_UPRIGHT

    def view(self) -> PosedScan:
        """What is fused of it."""
        return PosedScan(self.scan.points, self.T_world_sensor, self.faces)


@dataclass
class ScanSource:
    """Scans of a recording with their poses.

    Attributes:
        name: of the recording, for people.
        scans: the recording.
        poses: T_world_sensor float64 [4, 4] by number of the scan.
        names: of object ids: none.
        notes: what a user should know.
        warnings: what seems wrong with the recording.
        body: of the robot, which is left out; None: nothing is.
    """

    name: str
    scans: ScanSequence
    poses: dict[int, np.ndarray]
    names: dict[int, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    body: Body | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[SensorScan]:
        """All scans whose pose is known, in order, without those that saw nothing."""
        faces: ScanFaces | None = None
        for number, T in sorted(self.poses.items()):
            scan = self.scans.scan(number)
            if len(scan.points):
                faces = faces or ScanFaces.of(scan.points)
                seen = scan if self.body is None else replace(scan, points=self.body.without(scan.points))
                yield SensorScan(seen, T, faces)

    def instants(self) -> Iterator[list[SensorScan]]:
        """Each scan alone."""
        return ([posed] for posed in self)

    def bare(self) -> ScanSource:
        """Itself: scans tell of no objects."""
        return self


def scans_of_recording(request: SequenceRequest, poses: Path | None = None, columns: int | None = None) -> ScanSource:
    """The scans of a folder at the poses that it tells itself, or at those of a file.

    Args:
        request: the folder, and `start`, `stop`, `stride`.
        poses: a trajectory; None: the recording's own.
        columns: numbers of a point in .bin scans; None: as they tell themselves.

    Raises:
        SequenceError, FormatError: the scans or poses cannot be read, or there are no poses.
        ConfigError: options that are for cameras.
    """
    if request != SequenceRequest(request.path, start=request.start, stop=request.stop, stride=request.stride):
        raise ConfigError(f"{request.path}: of laser scans `start`, `stop` and `stride` can be chosen")
    scans = ScanSequence(request.path, request.start, request.stop, request.stride, columns)
    found = poses_of_items(request.path, scans.timestamps, poses, scans.ground_truth)
    known = {number: T for number, T in enumerate(found) if is_valid_pose(T)}
    source = ScanSource(str(request.path), scans, known)
    if lacking := len(scans) - len(known):
        source.notes.append(f"{quantity(lacking, 'scan')} without a pose {word_for(lacking, 'is', 'are')} left out")
    return source
