# SPDX-License-Identifier: Apache-2.0
"""The volumes of a recording, frame by frame: TSDF, and beside it what else is wanted; how long each frame took.

After a loop was closed, what was fused before lies where the camera was thought to be. Weights are clamped and decay,
so frames cannot be taken out again; they are fast to put in, though: the maps are begun anew and the keyframes, whose
images the mapper keeps, are fused again where they are now.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import InputError
from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_export import save_cells
from ggslam.volumes.cell_field import AnyField, CellField
from ggslam.volumes.cell_mesh import mesh_cells
from ggslam.volumes.cell_pager import CellPager
from ggslam.volumes.cell_rebuild import StoredView
from ggslam.volumes.device_fusion import DeviceFusion
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.held_distances import HeldDistanceTuning, HeldValues, held_values
from ggslam.volumes.mesh import Mesh, extract_mesh
from ggslam.volumes.mesh_parts import MeshParts
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.posed_view import PosedScan, PosedView
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_file import save_tsdf
from ggslam.volumes.volume_settings import VolumeSettings


class VolumeTimesTuning(Tuning):
    """How times are summarised."""

    window = 50
    """Frames over which times are averaged, to see whether they grow with the map."""


@dataclass
class VolumeTimes:
    """How long frames took.

    Attributes:
        rows: for each frame, seconds by part: "slam" (from the frame to its pose and, where they come first, mapping
            and making the volumes anew after a loop closure), "cells" (going to disk and coming back), "tsdf", "esdf",
            "occupancy"; parts that were not done with a frame are missing.
        blocks: of the TSDF after each frame.
        rebuilds: seconds of each time that the maps were made anew.
        last_update: of the distance field, at the end.
    """

    rows: list[dict[str, float]] = field(default_factory=list)
    blocks: list[int] = field(default_factory=list)
    rebuilds: list[float] = field(default_factory=list)
    last_update: float = 0.0

    def parts(self) -> dict[str, np.ndarray]:
        """Seconds [n] of the frames with which a part was done, by part."""
        all_names = ("slam", "cells", "tsdf", "esdf", "occupancy")
        names = [name for name in all_names if any(name in row for row in self.rows)]
        return {name: np.array([row[name] for row in self.rows if name in row]) for name in names}

    def whole(self) -> np.ndarray:
        """Seconds [n] of the frames with which all parts were done, all together."""
        parts = self.parts()
        return np.array([sum(row.values()) for row in self.rows if len(row) == len(parts)])

    def summary(self) -> dict[str, dict[str, Any]]:
        """Milliseconds a frame by part: mean, 95 %, largest, and means by `VolumeTimesTuning.window` frames."""
        return {name: _statistics(seconds) for name, seconds in {**self.parts(), "all": self.whole()}.items()}


def _statistics(seconds: np.ndarray) -> dict[str, Any]:
    ms = 1e3 * seconds
    if not len(ms):
        return {"mean_ms": 0.0, "p95_ms": 0.0, "max_ms": 0.0, "by_window_ms": []}
    windows = [float(ms[k : k + VolumeTimesTuning.window].mean()) for k in range(0, len(ms), VolumeTimesTuning.window)]
    return {"mean_ms": float(ms.mean()), "p95_ms": float(np.percentile(ms, 95)), "max_ms": float(ms.max()),
            "by_window_ms": windows}  # fmt: skip


@dataclass(frozen=True)
class Paging:
    """What of TSDF and distance field goes to disk.

    Attributes:
        folder: for it.
        allowed: bytes that both may take, of those that they take now; None: any.
    """

    folder: Path
    allowed: Callable[[int], int | None]


class VolumeMaps:
    """TSDF, distance field and occupancy of one recording.

    Args:
        settings: of all of them.
        esdf: whether a distance field is wanted.
        occupancy: edge of the occupancy map's voxels in metres; None: no occupancy map.
        onto: a TSDF to go on in; None: an empty one.
        device: of torch, on which the TSDF is fused, on CUDA devices with the distance field; the other maps follow at
            the end. None: the compiled core does.

    Raises:
        ConfigError: no such device, or something is wanted that is not done on one.
    """

    def __init__(
        self, settings: VolumeSettings, esdf: bool = False, occupancy: float | None = None,
        onto: TsdfMap | None = None, device: str | None = None,
    ) -> None:  # fmt: skip
        self.settings = settings
        self.paging: Paging | None = None
        """What goes to disk; to be set before the first frame, for an empty TSDF of the core."""
        self.pager: CellPager | None = None
        self._goes_on = onto is not None
        self._on_device = None if device is None else DeviceFusion(device, settings, onto, esdf)
        self.tsdf = TsdfMap(settings.tsdf, points=esdf) if onto is None else onto
        self.context = self.tsdf.context
        self.field = DistanceField(self.tsdf, settings.esdf) if esdf else None
        self.cell_field: CellField | None = None
        """Takes the place of `field` when all is done and cells are on disk."""
        self.occupancy = None if occupancy is None else self._occupancy(occupancy)
        self.times = VolumeTimes()
        self.points = 0
        """Measured points that were fused; what was fused anew after a loop closure is not counted again."""

    def fit(self, scale: float, voxel: bool = True) -> None:
        """Fits the TSDF's voxels and range to the size of the scene, before the first frame; in rooms, and where a
        TSDF is gone on with, nothing changes.

        Args:
            scale: of the scene, see `geometry.scene_size.scene_scale`.
            voxel: whether the voxel follows, too.
        """
        tsdf = self.settings.tsdf.in_scene(scale, voxel)
        if self._goes_on or tsdf == self.settings.tsdf:
            return
        self.settings = replace(self.settings, tsdf=tsdf)
        if self._on_device is not None:
            self._on_device.begin(self.settings)
        self.tsdf = TsdfMap(tsdf, self.context, points=self.tsdf.points)
        self.field = None if self.field is None else DistanceField(self.tsdf, self.settings.esdf)

    def query(self, points: np.ndarray) -> HeldValues:
        """Distances and gradients at points [N, 3] in metres, see `DistanceField.query`, and what they are worth while
        cells are on disk: all in view of the last instant are those of the whole map, and when all is finished, all
        are.

        Raises:
            InputError: there is no distance field.
        """
        if self.field is None:
            raise InputError("query: expected volumes with a distance field (`esdf`), found none")
        field = self.field if self.cell_field is None else self.cell_field
        values, voxel = field.query(points), self.field.voxel
        if self.pager is None or self.cell_field is not None:
            border = np.full(len(values.distance), np.inf)
        else:
            margin = HeldDistanceTuning.margin_voxels * voxel
            border = self.pager.border(np.asarray(points, np.float64), self.settings.esdf.max_distance + margin)
        return held_values(values, border, voxel)

    @property
    def finished_field(self) -> AnyField | None:
        """The distance field of the finished maps."""
        return self.field if self.cell_field is None else self.cell_field

    def mesh(self, min_triangles: int = 0) -> Mesh:
        """The surface of the TSDF in memory; see `volumes.mesh.extract_mesh`."""
        return self.mesh_parts(min_triangles).whole()

    def mesh_parts(self, min_triangles: int = 0) -> MeshParts:
        """The surface of the finished TSDF; of cells on disk it stays there, and is gone with them."""
        if self.pager is not None and len(self.pager):
            return mesh_cells(self.pager, self.settings.min_weight or None, min_triangles)
        return MeshParts.of(extract_mesh(self.tsdf, self.settings.min_weight or None, min_triangles))

    def save_tsdf(self, path: Path) -> None:
        """Writes the finished TSDF."""
        if self.pager is not None and len(self.pager):
            save_cells(path, self.pager)
        else:
            save_tsdf(path, self.tsdf)

    def block_counts(self) -> tuple[int, int]:
        """Blocks of the finished TSDF, and those of them with voxels."""
        of_disk = (0, 0) if self.pager is None else self.pager.counts()
        return len(self.tsdf) + of_disk[0], self.tsdf.dense_blocks + of_disk[1]

    @property
    def _receiver(self) -> TsdfMap | DeviceFusion:
        return self.tsdf if self._on_device is None else self._on_device

    def _occupancy(self, resolution: float) -> OccupancyMap:
        return OccupancyMap(resolution, self.settings.occupancy, self.context)

    def add(
        self, frame: Frame, T_world_camera: np.ndarray, labels: np.ndarray | None = None, waited: float = 0.0
    ) -> None:
        """Fuses one frame.

        Args:
            frame: the images.
            T_world_camera: [4, 4].
            labels: object ids uint16 [H, W], 0 = none.
            waited: seconds since the frame came.
        """
        view = PosedView(frame.depth_or_infinity(), frame.camera, T_world_camera, frame.color, labels)
        self.add_together([view], waited)

    def add_together(self, views: Sequence[PosedView | PosedScan], waited: float = 0.0) -> None:
        """Fuses what the sensors of a rig see at one instant, one after the other; weights decay and the distance field
        follows once for all of them. Its times are one row.

        Args:
            views: of the sensors.
            waited: seconds since what they measured came.
        """
        number = len(self.times.rows)
        row = {"slam": waited} if waited else {}
        start = time.perf_counter()
        images = [image for view in views for image in view.images(self.settings.tsdf, self.context)]
        if self.paging is not None:
            row["cells"] = self._bring(self.paging, images)
        for image in images:
            self._integrate(image)
        every = self.settings.decay_every
        if every and number % every == every - 1:
            self.tsdf.decay()
            if self.pager is not None:
                self.pager.decay()
        row["tsdf"] = time.perf_counter() - start - row.get("cells", 0.0)
        every = self.settings.esdf_every
        if self.field is not None and every and number % every == every - 1:
            self._update_field(images, row)
        if self.occupancy is not None:
            start = time.perf_counter()
            for view in views:
                self._insert(view)
            row["occupancy"] = time.perf_counter() - start
        if self.pager is not None:
            start = time.perf_counter()
            self.pager.finish_instant(self.field)
            row["cells"] += time.perf_counter() - start
        self.times.blocks.append(len(self._receiver))
        self.times.rows.append(row)
        self.points += sum(view.point_count for view in views)

    def _update_field(self, images: Sequence[PosedView], row: dict[str, float]) -> None:
        """Brings the distance field up to date with what was fused, near the first image first."""
        assert self.field is not None
        start = time.perf_counter()
        if self._on_device is not None:
            self._on_device.update_field()
            return
        here = images[0].T_world_camera[:3, 3] if images else None
        self.field.update(self.settings.left_for_field_ms(1e3 * row["tsdf"]), here)
        row["esdf"] = time.perf_counter() - start

    def _bring(self, paging: Paging, images: Sequence[PosedView]) -> float:
        """Brings what is on disk of what images may tell of; returns the seconds that took."""
        start = time.perf_counter()
        self.cell_field = None
        if self.pager is None:
            distances = 0.0 if self.field is None else self.settings.esdf.max_distance
            self.pager = CellPager(self.tsdf, paging.folder, paging.allowed, distances)
        self.pager.bring(images)
        return time.perf_counter() - start

    def _integrate(self, image: PosedView) -> None:
        self._receiver.integrate(image.depth, image.camera, image.T_world_camera, image.color, image.labels)

    def _insert(self, view: PosedView | PosedScan) -> None:
        assert self.occupancy is not None
        view.insert_into(self.occupancy, self.settings.tsdf.max_depth)

    def rebuild(self, views: Sequence[StoredView]) -> None:
        """Begins anew from keyframes where they are now, for after a loop was closed. With paging, cells are fused
        again when they are needed."""
        start = time.perf_counter()
        self.cell_field = None
        self.tsdf.clear()
        if self._on_device is not None:
            self._on_device.begin(self.settings)
        if self.occupancy is not None:
            self.occupancy = self._occupancy(self.occupancy.resolution)
        if self.pager is not None:
            self.pager.rebuild(views)
        for stored in views if self.pager is None or self.occupancy is not None else ():
            view = replace(stored.read(), T_world_camera=stored.T_world_camera)
            if self.pager is None:
                self._integrate(view)
            if self.occupancy is not None:
                self._insert(view)
        if self.field is not None and self._on_device is None:
            self.field.update()
        self.times.rebuilds.append(time.perf_counter() - start)

    def finish(self) -> None:
        """Brings the TSDF from its device, and the distance field up to date. If some cells are on disk, all go there:
        what is made of the maps takes a few of them at a time."""
        if self.pager is not None:
            self.pager.write_all()
            if self.field is not None and len(self.pager):
                self.field.clear()
                self.cell_field = CellField(self.pager, self.settings.esdf)
                return
        if self._on_device is not None:
            self.tsdf, self.field = self._on_device.to_native(self.context)
        if self.field is not None:
            self.times.last_update = self.field.update().milliseconds / 1e3

    def relabel(self, table: np.ndarray) -> None:
        """Gives every object its new id.

        Args:
            table: uint16 [65536], new id by old one; 0: none.
        """
        if self.pager is not None:
            self.pager.write_all()
            self.pager.relabel(table)
        blocks = self.tsdf.blocks()
        dense = blocks.coordinates[blocks.dense]
        for start in range(0, len(dense), 4096):
            at = dense[start : start + 4096]
            old = self.tsdf.read(at).label
            changed = (table[old] != old).any(1)
            self.tsdf.write(at[changed], label=table[old[changed]])
