# SPDX-License-Identifier: Apache-2.0
"""A store of submaps as the viewer's page asks for it: cell by cell, coarser where it is far away."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from ggslam.errors import ConfigError, GgslamError
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, gaussians_of_cell
from ggslam.jobs.submaps.visit_records import read_record
from ggslam.objects.table import object_color
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import SH_C0
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_objects import read_objects
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import CameraTuning, top_view, vertical_fov, view_of_pose
from ggslam.viewer.packed_splats import SCALES, pack_splats
from ggslam.viewer.page_source import Download
from ggslam.viewer.scene_values import packed_chunk
from ggslam.viewer.splats import colors_to_uint8, most_visible


class StorePageTuning(Tuning):
    """How cells are shown."""

    levels = 4
    """Levels of each cell; each has a quarter of the splats of the one before."""
    fewest = 200
    """Fewest splats of a level."""
    growth = 1.4
    """Factor on the sizes of splats from level to level: there are fewer to cover the surface."""
    cells_in_memory = 64
    """Packed cells that are remembered."""
    sample = 24
    """Cells that tell how high the map is."""
    compression = 4
    """Effort of compression, 1 to 9."""


_CAMERA: Final = Camera(960, 720, 800.0, 800.0, 479.5, 359.5)
"""Of stores that no recording filled."""


class StorePage:
    """A `PageSource` of a store, which is only read.

    Args:
        path: of the store.
        title: of the page.
        caption: a line below the map.

    Raises:
        FormatError: no store, or damaged.
        ConfigError: no cell of it has Gaussians.
    """

    def __init__(self, path: Path, title: str, caption: str = "") -> None:
        self._store, self._title, self._caption = GridStore.open(path), title, caption
        self.counts = {key: count for key, count in sorted(self._store.counts(GAUSSIANS).items()) if count}
        if not self.counts:
            raise ConfigError(f"{path}: no cell of this store has Gaussians to show")
        self._packed = lru_cache(maxsize=StorePageTuning.cells_in_memory)(self._pack)
        self._scene = self._make_scene()

    def describe(self) -> str:
        """A line about it."""
        total = sum(self.counts.values())
        return f"{total:,} Gaussians in {quantity(len(self.counts), 'cell')}, shown near what is looked at"

    def scene(self) -> dict[str, Any]:
        """See `PageSource`."""
        return self._scene

    def splats(self, chunk: str, level: int) -> bytes:
        """See `PageSource`."""
        key = self._key(chunk)
        if not 0 <= level < len(self._levels(key)):
            raise ConfigError(f"cell {chunk}: there is no level {level}")
        return self._packed(key, level)

    def frame_picture(self, frame: int) -> bytes:
        """See `PageSource`."""
        raise ConfigError("a store has no frames")

    def answer(self, action: str, values: Any) -> dict[str, Any] | Download:
        """See `PageSource`."""
        raise ConfigError("a store is only looked at; edit the runs that it is from")

    def _key(self, chunk: str) -> CellKey:
        words = chunk.split("_")
        if len(words) != 3 or not all(word.lstrip("-").isdecimal() and len(word) < 12 for word in words):
            raise ConfigError(f"there is no cell {chunk[:40]!r}")
        key = (int(words[0]), int(words[1]), int(words[2]))
        if key not in self.counts:
            raise ConfigError(f"there is no cell {chunk[:40]!r}")
        return key

    def _levels(self, key: CellKey) -> list[int]:
        """Splats of each level of a cell, the finest first."""
        found = [self.counts[key]]
        while len(found) < StorePageTuning.levels and found[-1] > StorePageTuning.fewest:
            found.append(max(StorePageTuning.fewest, found[-1] // 4))
        return found

    def _pack(self, key: CellKey, level: int) -> bytes:
        g = gaussians_of_cell(self._store, key)
        rows = most_visible(g, self._levels(key)[level])
        g.log_scales[:] += level * float(np.log(StorePageTuning.growth))
        owners = g.object_id.numpy()[rows].astype(np.uint16)
        colors = colors_to_uint8(0.5 + SH_C0 * g.sh.numpy()[rows, 0])
        content, low, high = pack_splats(g, rows, colors, owners, None, level=StorePageTuning.compression)
        header = {"count": len(rows), "low": low, "high": high, "scales": SCALES, "identity": False, "seen": False}
        return packed_chunk({**header, "version": 0}, content)

    # --- what is in it ------------------------------------------------------------------------------------------------

    def _make_scene(self) -> dict[str, Any]:
        poses, camera = self._poses()
        up = -poses[:, :3, 1].mean(0) if len(poses) else self._upward()
        up = up / np.linalg.norm(up)
        low, high = self._range()
        chunks = [self._chunk(key, low, high) for key in self.counts]
        corners = np.array([corner for chunk in chunks for corner in (chunk["low"], chunk["high"])])
        fov = vertical_fov(camera)
        positions = poses[:, :3, 3] if len(poses) else corners
        forward = poses[0, :3, 2] if len(poses) else np.array([1.0, 0.3, 0.2])
        views = {"Top": asdict(top_view(corners, positions, forward, up, fov))}
        if len(poses):
            views = {"Start": asdict(view_of_pose(poses[0], CameraTuning.look_ahead_m)), **views}
        objects = self._objects()
        return {
            "title": self._title, "caption": self._caption, "about": self.describe(), "served": True, "live": False,
            "editable": False, "version": 0, "up": up, "fov": fov, "floor": {"height": None, "found": False},
            "camera": {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
                       "cx": camera.cx, "cy": camera.cy},
            "objects": objects, "unlabelled": max(0, sum(self.counts.values()) - sum(o["gaussians"] for o in objects)),
            "views": views, "path": [poses[:, :3, 3].round(4)] if len(poses) else [],
            "keyframes": [T.round(5).ravel() for T in poses[:1000]], "frames": [], "movers": [], "changes": [],
            "chunks": chunks, "annotations": [], "camera_keys": [], "edits": [], "redo": 0,
        }  # fmt: skip

    def _poses(self) -> tuple[np.ndarray, Camera]:
        """T_world_camera [N, 4, 4] of the keyframes that filled it, and the camera of the first."""
        found, camera = list[np.ndarray](), _CAMERA
        for visit in self._store.visits():
            try:
                record = read_record(self._store, visit)
            except GgslamError:  # the map is there
                continue
            if record is None or not record.keyframes:
                continue
            camera = camera if found else record.camera_of(record.keyframes[0])
            found += [keyframe.T_world_camera for keyframe in record.keyframes]
        return np.array(found).reshape(-1, 4, 4), camera

    def _upward(self) -> np.ndarray:
        """The axis that the grid does not span, as its cameras look: z up, or y down."""
        return np.array([0.0, 0.0, 1.0]) if self._store.settings.axes == "xy" else np.array([0.0, -1.0, 0.0])

    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the Gaussians of some cells, [3] both."""
        keys = list(self.counts)
        chosen = [keys[i] for i in np.unique(np.linspace(0, len(keys) - 1, StorePageTuning.sample).round().astype(int))]
        means = []
        for key in chosen:
            try:
                means.append(gaussians_of_cell(self._store, key).means.numpy())
            except GgslamError:  # a damaged cell is told when it is asked for
                continue
        points = np.concatenate(means) if means else np.zeros((1, 3), np.float32)
        return np.percentile(points, 0.5, axis=0), np.percentile(points, 99.5, axis=0)

    def _chunk(self, key: CellKey, low: np.ndarray, high: np.ndarray) -> dict[str, Any]:
        grid = self._store.grid
        center, half, spans = grid.centres_of(np.array([key]))[0], grid.spacing / 2, grid.spans
        return {
            "id": "_".join(map(str, key)), "count": self.counts[key], "levels": self._levels(key),
            "low": np.where(spans, center - half, low), "high": np.where(spans, center + half, high),
        }  # fmt: skip

    def _objects(self) -> list[dict[str, Any]]:
        try:
            known = read_objects(self._store)
        except GgslamError:  # the map is there
            return []
        present = [] if known is None else known.present()
        return [
            {"id": o.id, "name": o.name, "color": object_color(o.id), "gaussians": o.gaussians, "center": o.box.center,
             "axes": o.box.axes, "size": o.box.size, "centroid": o.box.center} for o in present
        ]  # fmt: skip
