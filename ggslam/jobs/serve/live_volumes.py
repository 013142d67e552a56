# SPDX-License-Identifier: Apache-2.0
"""Mesh, grids and distances while a run goes on, of its keyframes; of what nobody asks for nothing is fused.

After a correction of the map the keyframes are fused anew, a few at a time; what was fused before is shown until then.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence

import numpy as np

from ggslam.driving.robot import Robot
from ggslam.errors import ConfigError
from ggslam.jobs.serve.channels import CHANGED, DISTANCE, MESH, grid_channel
from ggslam.jobs.serve.keyframe_volumes import Floor, FusedKeyframes, KeyframeVolumesTuning, PlacedKeyframe
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.tiles import SentTiles, Tile, thin_points
from ggslam.jobs.serve.volume_contents import (
    gone_part,
    grid_of,
    layers_of,
    mesh_parts_of_tile,
    published_mesh,
    slice_of,
    tiles_of_mesh,
    triangle_middles,
)
from ggslam.messages.contents import Channel, Grid, Points
from ggslam.native.loader import NativeContext
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import DistanceField, FieldValues


class LiveVolumesTuning(Tuning):
    """What growing volumes cost and show."""

    pass_s = 0.25
    """Seconds after which no more keyframes are fused before the volumes are shown and publishing rests."""
    slice_every_s = 3.0
    """Seconds between two slices through the distance field."""
    slice_changed_m = 0.01
    """A slice is sent again if some distance changed by more than this, in metres."""
    whole_share = 0.5
    """Share of a grid that changed from which the whole grid is sent."""
    asked_s = 60.0
    """Seconds for which volumes grow after somebody asked for a distance."""


class GrowingVolumes:
    """Volumes of a run that goes on. `show` is called in the publisher's thread, `query` in any.

    Args:
        publisher: that takes the contents.
        robots: by name that grids are made for.
    """

    def __init__(self, publisher: MapPublisher, robots: Mapping[str, Robot]) -> None:
        self._publisher = publisher
        self._grids = {name: GrowingGrid(publisher, grid_channel(name)) for name in robots}
        self._robots, self._mesh = robots, GrowingMesh(publisher)
        self._lock = threading.Lock()
        self._context: NativeContext | None = None
        self._shown: FusedKeyframes | None = None
        self._next: FusedKeyframes | None = None
        self._state: tuple[object, ...] = ()
        self._slice: Points | None = None
        self._slice_at = self._asked_at = -1e9
        self.fused = 0
        """How many keyframes were fused, those anew counted again."""

    @property
    def is_wanted(self) -> bool:
        """Whether anybody asks for volumes."""
        channels = [MESH, DISTANCE, *(grid_channel(name) for name in self._robots)]
        asked = time.monotonic() - self._asked_at < LiveVolumesTuning.asked_s
        return asked or any(self._publisher.is_wanted(channel) for channel in channels)

    def query(self, points: np.ndarray) -> FieldValues:
        """Distances at points [N, 3] of the map's frame, metres, as far as keyframes are fused by now.

        Raises:
            ConfigError: none is yet; from now on they are.
        """
        self._asked_at = time.monotonic()
        with self._lock:
            if self._shown is None:
                raise ConfigError("there are no distances yet: keyframes are fused from now on; ask again in a moment")
            return self._shown.field.query(points)

    @property
    def most_m(self) -> float:
        """Largest distance that is told, metres."""
        with self._lock:
            return 0.0 if self._shown is None else self._shown.field.settings.max_distance

    def show(
        self, views: Sequence[PlacedKeyframe], scale: float, floor: Floor | None, poses: np.ndarray, stamp: float,
        final: bool = False,
    ) -> None:  # fmt: skip
        """Fuses what is new and publishes what changed.

        Args:
            views: all keyframes, where they are now.
            scale: of the scene.
            floor: None: it is not known yet, so there are no grids.
            poses: T_map_camera [N, 4, 4] of the frames.
            stamp: when it was so, seconds.
            final: whether it stays so: all is fused, however long it takes, and the least change counts.
        """
        if not self.is_wanted or not views:
            return
        with self._lock:
            fused = self._grow(views, scale, final)
            T = None if floor is None else floor.T_floor_map.tobytes()
            wanted = [c for c in (MESH, *map(grid_channel, self._robots)) if self._publisher.is_wanted(c)]
            state = (id(fused), fused.tsdf.revision, T, final, *(channel.name for channel in wanted))
            if state != self._state:
                self._state = state
                self._send(fused, floor, wanted, stamp, final)
            if len(poses) and floor is not None and self._publisher.is_wanted(DISTANCE):
                self._send_slice(fused.field, floor.T_floor_map[2, :3], poses, stamp, final)

    def _grow(self, views: Sequence[PlacedKeyframe], scale: float, final: bool) -> FusedKeyframes:
        """What is to be shown now."""
        if self._context is None:  # kernels of one context take turns; the run must not wait for these
            self._context = NativeContext(1)
        growing = self._next or self._shown
        if growing is None or not growing.still_fits(views, 1e-6 if final else KeyframeVolumesTuning.moved_m):
            growing = FusedKeyframes(scale, self._context)
            self._next = growing
        before, end = len(growing), time.monotonic() + LiveVolumesTuning.pass_s
        whole = growing.add(views, lambda: final or time.monotonic() < end)
        self.fused += len(growing) - before
        if self._next is not None and (whole or self._shown is None):
            self._shown, self._next = self._next, None
        assert self._shown is not None
        return self._shown

    def _send(
        self, fused: FusedKeyframes, floor: Floor | None, wanted: Sequence[Channel], stamp: float, final: bool
    ) -> None:
        if MESH in wanted:
            self._mesh.show(fused, stamp, final)
        grids = [name for name in self._robots if grid_channel(name) in wanted]
        if floor is not None and grids:
            layers = layers_of(fused.field, floor.T_floor_map, floor.seen)
            for name in grids:
                self._grids[name].show(grid_of(layers, self._robots[name]), stamp)

    def _send_slice(self, field: DistanceField, up: np.ndarray, poses: np.ndarray, stamp: float, final: bool) -> None:
        now = time.monotonic()
        if not final and now - self._slice_at < LiveVolumesTuning.slice_every_s:
            return
        self._slice_at = now
        cut = slice_of(field, up, poses)
        if self._slice is None or _slices_differ(self._slice, cut):
            self._slice = cut
            self._publisher.put(DISTANCE, cut, stamp)


def _slices_differ(before: Points, now: Points) -> bool:
    if before.xyz.shape != now.xyz.shape:
        return True
    most = LiveVolumesTuning.slice_changed_m
    moved = np.abs(before.xyz - now.xyz).max(initial=0.0)
    return bool(max(moved, np.abs(before.values["distance"] - now.values["distance"]).max(initial=0.0)) > most)


class GrowingGrid:
    """A grid of which the whole is sent when its size or place changes, or much of it, and else the rectangle of all
    that changed since: whoever has the last whole and the last rectangle has the grid, whatever else was lost.

    Args:
        publisher: that takes it.
        channel: of the grid.
    """

    def __init__(self, publisher: MapPublisher, channel: Channel) -> None:
        self._publisher, self._channel = publisher, channel
        self._whole: Grid | None = None
        self._now = np.zeros((0, 0), np.int8)
        self._changed = np.zeros((0, 0), bool)

    def show(self, grid: Grid, stamp: float) -> None:
        """Publishes what changed."""
        whole = self._whole
        if whole is None or not _same_cells(whole, grid):
            self._send_whole(grid, stamp)
            return
        if np.array_equal(self._now, grid.cells):
            return
        self._changed |= self._now != grid.cells
        self._now = grid.cells
        rows, columns = (np.flatnonzero(self._changed.any(axis=axis)) for axis in (1, 0))
        (top, bottom), (left, right) = (rows[0], rows[-1] + 1), (columns[0], columns[-1] + 1)
        if (bottom - top) * (right - left) > LiveVolumesTuning.whole_share * grid.cells.size:
            self._send_whole(grid, stamp)
            return
        part = np.ascontiguousarray(grid.cells[top:bottom, left:right])
        at = int(top), int(left)
        self._publisher.put(
            self._channel, Grid(grid.frame, grid.T_frame_origin, grid.cell_m, part, at), stamp, CHANGED
        )  # fmt: skip

    def _send_whole(self, grid: Grid, stamp: float) -> None:
        self._whole, self._now, self._changed = grid, grid.cells, np.zeros(grid.cells.shape, bool)
        self._publisher.forget(self._channel, CHANGED)
        self._publisher.put(self._channel, grid, stamp)


def _same_cells(a: Grid, b: Grid) -> bool:
    same_place = np.array_equal(a.T_frame_origin, b.T_frame_origin) and a.cell_m == b.cell_m
    return same_place and a.cells.shape == b.cells.shape


class GrowingMesh:
    """A mesh of which the tiles are sent that changed.

    Args:
        publisher: that takes it.
    """

    def __init__(self, publisher: MapPublisher) -> None:
        self._publisher, self._sent = publisher, SentTiles()
        self._parts: dict[Tile, int] = {}

    def show(self, fused: FusedKeyframes, stamp: float, exactly: bool = False) -> None:
        """Publishes what changed; `exactly`: the least change counts."""
        mesh = published_mesh(fused.tsdf)
        colors = mesh.colors[mesh.triangles[:, 0]]
        thin = thin_points(triangle_middles(mesh), colors, np.zeros(len(colors), np.uint16))
        changed = self._sent.find_changes(thin, exactly)
        tiles = tiles_of_mesh(mesh) if changed else {}
        for tile in changed:
            parts = list(mesh_parts_of_tile(mesh, tile, tiles.get(tile, np.zeros(0, np.int64))))
            for part in parts:
                self._publisher.put(MESH, part, stamp, part.part)
            for number in range(len(parts), self._parts.get(tile, 0)):
                put_gone(self._publisher, f"{','.join(map(str, tile))}/{number}", stamp)
            self._parts[tile] = len(parts)


def put_gone(publisher: MapPublisher, part: str, stamp: float) -> None:
    """A part of the mesh is not there any more."""
    publisher.put(MESH, gone_part(part), stamp, part, keep=False)
    publisher.forget(MESH, part)
