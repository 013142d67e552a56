# SPDX-License-Identifier: Apache-2.0
"""Fuses frames or scans with poses into volumes, and keeps what must be known of them afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from ggslam.geometry.scene_size import scene_scale
from ggslam.jobs.progress import Observer
from ggslam.jobs.volumes.frames import FrameSource, PosedFrame
from ggslam.jobs.volumes.scans import ScanSource, SensorScan
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.occupancy import OccupancyMap


@dataclass
class Fused:
    """Result of fusing.

    Attributes:
        maps: the volumes.
        name: of the source, for people.
        poses: where frames were seen from, see `PosedFrame.T_world_upright`.
        timestamps: seconds, of the instants.
        instant: the last one, of a rig; None without one.
        depth_ranges: of each frame, 95 % of the depth that was fused is nearer.
        names: of object ids.
        error: why fusing stopped early, if it did.
    """

    maps: VolumeMaps
    name: str
    poses: list[np.ndarray] = field(default_factory=list)
    timestamps: list[float] = field(default_factory=list)
    instant: int | None = None
    depth_ranges: list[float] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    error: BaseException | None = None

    def saw(self, posed: PosedFrame | SensorScan) -> None:
        """Remembers where a frame was seen from, and how far it saw of what was fused."""
        self.poses.append(posed.T_world_upright)
        if posed.instant is None or posed.instant != self.instant:
            self.timestamps.append(posed.timestamp)
        self.instant = posed.instant
        limits = self.maps.settings.tsdf
        for seen in (posed.depth[::8, ::8], posed.depth):  # all of it only where none is in range
            seen = seen[(seen >= limits.min_depth) & (seen <= limits.max_depth)]
            if len(seen):
                self.depth_ranges.append(float(np.percentile(seen, 95)))
                break

    def latency(self) -> float:
        """Seconds after which 95 % of the frames are in all maps, the wait for a distance field that is not updated
        with every frame included."""
        whole, every = self.maps.times.whole(), max(1, self.maps.settings.esdf_every)
        wait = float(np.median(np.diff(self.timestamps))) * (every - 1) if len(self.timestamps) > 1 else 0.0
        return (float(np.percentile(whole, 95)) if len(whole) else 0.0) + wait


def fuse_source(source: FrameSource | ScanSource, maps: VolumeMaps, observer: Observer, fit_voxel: bool) -> Fused:
    """Fuses all of a source.

    Args:
        source: of frames or scans.
        maps: to fuse into.
        observer: receives progress updates.
        fit_voxel: whether the voxel follows the size of the scene.
    """
    fused = Fused(maps, source.name, names=source.names)
    observer.begin("fuse", len(source))
    try:
        for together in source.instants():
            if not fused.poses:
                maps.fit(scene_scale(together[0].depth), fit_voxel)
            maps.add_together([posed.view() for posed in together])
            for posed in together:
                fused.saw(posed)
            observer.advance(len(fused.poses), len(source))
    except (Exception, KeyboardInterrupt) as stopped:  # what was fused is written, then it is raised
        fused.error = stopped
    return fused


def level_occupancy(
    maps: VolumeMaps, source: FrameSource | ScanSource, count: int, T_floor_map: np.ndarray, observer: Observer
) -> None:
    """Makes the occupancy map anew in the floor's frame of the first `count` frames: its voxels cannot be turned, for
    OctoMap's lie along the axes of their frame."""
    if maps.occupancy is None:
        return
    level = OccupancyMap(maps.occupancy.resolution, maps.settings.occupancy, maps.context)
    observer.begin("occupancy on the floor", count)
    seen: Iterator[PosedFrame | SensorScan] = iter(source.bare())
    for done, posed in enumerate(islice(seen, count)):
        posed.view().in_frame(T_floor_map).insert_into(level, maps.settings.tsdf.max_depth)
        observer.advance(done + 1, count)
    maps.occupancy = level
