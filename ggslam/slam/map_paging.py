# SPDX-License-Identifier: Apache-2.0
"""SLAM in bounded memory: Gaussians of far cells and the images of keyframes move to disk and come back.

Rules:
- Before a keyframe is inserted, every Gaussian on disk that it may see comes back (its frustum, in each part of the
  image as deep as was measured there and a little deeper), so that nothing is mapped again because it was away.
- When the map is over its budget, cells go: first those that were in view of a keyframe the longest ago, of these the
  farthest from the camera first. So the newest keyframes stay complete. What the camera sees stays, and what is nearer
  than `keep_radius` as long as others can go.
- Keyframes are trained only while all that they may see is in memory.
- As long as the budget is not used up, nothing is moved and a run is, bit for bit, one without a limit.

All of it happens in the thread that maps.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from ggslam.formats.array_archive import ArrayArchive
from ggslam.geometry.frustums import Frustums, depth_reach
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.votes import vote_labels
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.slam.memory_budget import MB, MemoryBudget
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.submaps.grid import GridStore
from ggslam.submaps.paging_settings import PagingSettings
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.interrupts import delay_interrupts

MEASURED_AFTER = 3
"""Keyframes after which the program's own need is measured: by then every part of it has run."""
_RENDERER_BYTES = 110
"""The rasterizer's own memory for each Gaussian of the map: a splat of 64 bytes and a footprint, with room to grow."""
_GROWTH = 0.1
_INSERTIONS = 8
"""As much room is kept as the largest of so many last keyframes took (the first, for which all is new, aside)."""
_AT_ONCE = 64
"""Keyframes that are asked together what they see."""
_TILES = (6, 8)
"""Rows and columns of parts of a view: each is as deep as what was measured in it, cells behind that are hidden."""

View = tuple[np.ndarray, np.ndarray]
"""A pose T_world_camera [4, 4] and how deep each tile of the image sees, metres [rows, columns]."""


class MapPager:
    """Keeps map and keyframes of one mapper within a budget.

    Args:
        camera: of all keyframes.
        settings: see there.
        budget: of the process.
        folder: to page to; made when it is needed.
    """

    def __init__(self, camera: Camera, settings: PagingSettings, budget: MemoryBudget, folder: Path) -> None:
        self.settings, self.budget, self.folder = settings, budget, folder
        self.archive = ArrayArchive(folder / "keyframes")
        self.cells: GaussianCells | None = None
        """What is on disk; None until the first Gaussians go there."""
        self.moved_out, self.moved_in = 0, 0
        """Gaussians that went to disk and came back so far."""
        self.most_resident = 0
        """The most Gaussians that were in memory."""
        self._camera = camera
        self._mapper: Mapper | None = None
        self._reach: list[np.ndarray] = []
        self._new: list[int] = []
        self._place_bytes = 0
        self._trainable: Sequence[int] | None = None
        self._told = False

    def serve(self, mapper: Mapper) -> None:
        """Takes charge of a mapper's map, which must be empty."""
        self._mapper = mapper
        mapper.residency = self
        mapper.map.growth = _GROWTH

    @property
    def mapper(self) -> Mapper:
        """Whose map it is."""
        assert self._mapper is not None
        return self._mapper

    @property
    def map(self) -> GaussianMap:
        """The part in memory."""
        return self.mapper.map

    @property
    def on_disk(self) -> int:
        """Gaussians on disk."""
        return 0 if self.cells is None else self.cells.count

    # --- around a keyframe -------------------------------------------------------------------------------------------

    def prepare(self, T_world_camera: np.ndarray, depth: np.ndarray) -> None:
        """Before a keyframe is inserted: all that it may see comes into memory, and room is made.

        Args:
            T_world_camera: its pose [4, 4].
            depth: what it measured, metres [H, W].
        """
        s = self.settings
        deep = s.view_margin * depth_reach(depth, *_TILES) + s.view_spare
        self._reach.append(np.minimum(deep, s.view_range))
        self._bring([(T_world_camera, self._reach[-1])], max(self._new[1:][-_INSERTIONS:], default=0))

    def inserted(self, keyframe: Keyframe, added: int, place_bytes: int = 0) -> None:
        """After a keyframe was inserted and its points are in the surface: images are handed over, what is too much
        goes.

        Args:
            added: Gaussians it brought.
            place_bytes: that all keyframes' places take by now; they stay in memory.
        """
        self._new.append(added)
        self._place_bytes = place_bytes
        self._trainable = None
        keyframe.put_away(self.archive)
        self.most_resident = max(self.most_resident, len(self.map))
        if len(self._new) == MEASURED_AFTER:
            self.budget.measure(self._held_bytes())
        reduced = self.budget.check(self._held_bytes())
        if self.budget.map_bytes is None:
            return
        self.archive.limit = self.settings.images * self.budget.map_bytes
        T = keyframe.T_world_camera
        excess = len(self.map) - self._rows()
        if excess > 0:
            self._send([(T, self._reach[-1])], excess)
        if reduced:
            self.map.shrink(int(1.05 * self._rows()))

    # --- what the mapper asks ----------------------------------------------------------------------------------------

    def trainable(self) -> Sequence[int]:
        """See `Residency`."""
        if self._trainable is None:
            self._trainable = self._complete(range(len(self.mapper.keyframes)))
            if self.mapper.identity is not None:
                self.mapper.identity.keep_pools(self._trainable)
        return self._trainable

    def _complete(self, numbers: Sequence[int]) -> Sequence[int]:
        """Those of some keyframes of whose view nothing is on disk."""
        if self.cells is None or not self.cells.sorted_keys() or not len(numbers):
            return numbers
        found = []
        for begin in range(0, len(numbers), _AT_ONCE):
            asked = numbers[begin : begin + _AT_ONCE]
            lacking = self.cells.visible_cells(self._frustums(self._views(asked)))
            found += [number for number, keys in zip(asked, lacking, strict=True) if not keys]
        return found or [numbers[-1]]  # the budget is less than one view: the newest is trained on what there is

    def stages(self) -> Iterator[Sequence[int]]:
        """See `Residency`: along the way, as many keyframes at a time as there is room for."""
        left = list(range(len(self.mapper.keyframes)))
        while left:
            views = self._views(left[:1])
            if self.cells is not None and self.cells.sorted_keys():
                self._send(views, max(0, len(self.map) - self._rows() // 2))
                self._bring(views)
                self._bring_while_there_is_room(left[1:])
            complete = set(self._complete(left))
            stage = [number for number in left if number in complete or number == left[0]]
            self._trainable = stage
            yield stage
            left = [number for number in left if number not in set(stage)]
        self._trainable = None

    def _bring_while_there_is_room(self, numbers: Iterable[int]) -> None:
        assert self.cells is not None
        for number in numbers:
            keys = self.cells.visible_cells(self._frustums(self._views([number])))[0]
            if len(self.map) + self.cells.count_in(keys) > self._rows():
                return
            self._move_in(keys)

    # --- loops -------------------------------------------------------------------------------------------------------

    def move_keyframes(self, T_new_old: np.ndarray) -> None:
        """Gaussians on disk follow their keyframes, as `Mapper.move_keyframes` does with those in memory."""
        self._trainable = None
        if self.cells is None:
            return
        moved = np.flatnonzero(np.abs(T_new_old - np.eye(4)).max((1, 2)) > 0).tolist()
        with delay_interrupts():
            self.cells.change(lambda gaussians: move_with_keyframes(gaussians, T_new_old), moved)

    def bring_ends(self, kept: Iterable[int]) -> None:
        """After a loop was closed: as much as there is room for of what the newest keyframe and those at the older end
        of the loop may see."""
        if self.cells is None:
            return
        self._bring(self._views([len(self.mapper.keyframes) - 1]))
        self._bring_while_there_is_room(sorted(kept, reverse=True))

    # --- the end -----------------------------------------------------------------------------------------------------

    def vote_sizes(self) -> np.ndarray:
        """Gaussians on disk by the object with the most votes, int64 [65536]."""
        sizes = np.zeros(65536, np.int64)
        for _, part in () if self.cells is None else self.cells.parts():
            if self.mapper.identity is not None:
                self.mapper.identity.catch_up(part)
            sizes += np.bincount(vote_labels(part).numpy(), minlength=65536)
        return sizes

    def settle(self) -> GaussianCells | None:
        """Everything goes to disk, if anything is there, and its cells are handed over; None: all is in memory."""
        if self.cells is None:
            return None
        self.prune_nowhere()
        with delay_interrupts():
            self.cells.move_out(self.map, self.cells.cells_of(self.map))
        self.map.shrink(0)
        self.archive.limit = 0
        if self.mapper.identity is not None:
            self.cells.change(self.mapper.identity.catch_up_and_label)
        self.cells.settle()
        return self.cells

    def prune_nowhere(self) -> None:
        """Gaussians at no place have no cell."""
        self.map.keep(torch.isfinite(self.map.means).all(1) & (self.map.means.abs() < 1e5).all(1))

    def close(self) -> None:
        """Removes all files."""
        if self.cells is not None:
            self.cells.store.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def report(self) -> dict[str, float]:
        """Figures of the run, sizes in MB (10^6 bytes)."""
        written = 0 if self.cells is None else self.cells.bytes_written
        total = (len(self.map) + self.on_disk) * self.map.bytes_per_gaussian
        return {
            "limit_mb": self.budget.limit / MB, "program_mb": self.budget.program_bytes / MB,
            "budget_mb": (self.budget.map_bytes or 0) / MB, "map_mb": total / MB,
            "gaussian_budget_mb": (self._rows() if self.budget.map_bytes else 0) * self.map.bytes_per_gaussian / MB,
            "most_resident": self.most_resident, "moved_out": self.moved_out, "moved_in": self.moved_in,
            "written_mb": written / MB, "images_on_disk_mb": self.archive.bytes_on_disk / MB,
            "places_mb": self._place_bytes / MB,
        }  # fmt: skip

    # --- parts -------------------------------------------------------------------------------------------------------

    def _views(self, numbers: Iterable[int]) -> list[View]:
        return [(self.mapper.keyframes[number].T_world_camera, self._reach[number]) for number in numbers]

    def _frustums(self, views: Sequence[View]) -> Frustums:
        poses, reach = zip(*views, strict=True)
        return Frustums.of(self._camera, np.stack([inverse(T) for T in poses]), np.stack(reach))

    def _row_bytes(self) -> float:
        return (1 + _GROWTH) * self.map.bytes_per_gaussian + _RENDERER_BYTES

    def _held_bytes(self) -> int:
        return int(self.map.capacity * self._row_bytes()) + self.archive.held_bytes + self._place_bytes

    def _rows(self) -> int:
        """Gaussians that may be in memory."""
        assert self.budget.map_bytes is not None
        left = (1 - self.settings.images) * self.budget.map_bytes - self._place_bytes
        return max(1, int(left / self._row_bytes()))

    def _bring(self, views: list[View], room: int = 0) -> None:
        """Brings what the views may see into memory, and makes room for it and for `room` more."""
        if self.budget.map_bytes is None:
            return
        frustums = self._frustums(views)
        wanted: list[CellKey] = []
        if self.cells is not None:
            wanted = sorted({key for keys in self.cells.visible_cells(frustums) for key in keys})
        incoming = 0 if self.cells is None else self.cells.count_in(wanted)
        excess = len(self.map) + incoming + room - self._rows()
        if excess > 0:
            self._send(views, excess)
        self._move_in(wanted)

    def _move_in(self, keys: Sequence[CellKey]) -> None:
        if self.cells is None or not keys:
            return
        begin = len(self.map)
        with delay_interrupts():
            rows = self.cells.move_in(self.map, keys)
        self.moved_in += rows.stop - begin
        self.most_resident = max(self.most_resident, len(self.map))
        self._trainable = None
        if self.mapper.identity is not None:
            self.mapper.identity.catch_up(self.map)

    def _send(self, views: list[View], excess: int) -> None:
        """Sends at least `excess` Gaussians to disk, if so many are not in these views."""
        if excess <= 0:
            return
        cells = self._opened()
        rows = cells.cells_of(self.map)
        if not rows:
            return
        keys = list(rows)
        centres = cells.store.grid.centres_of(np.array(keys))
        boxes = cells.boxes_of(self.map, rows)
        seen = np.asarray(self._frustums(views).touch(*boxes).any(0))
        last_seen = self._last_seen(boxes)
        positions = np.stack([T[:3, 3] for T, _ in views])
        distance = np.linalg.norm(centres[:, None] - positions, axis=2).min(1)
        chosen: dict[CellKey, np.ndarray] = {}
        count, enough = 0, excess + int(self.settings.slack * self._rows())
        for i in np.lexsort((-distance, last_seen)).tolist():
            far = distance[i] > self.settings.keep_radius
            if not seen[i] and count < (enough if far else excess):
                chosen[keys[i]] = rows[keys[i]]
                count += len(rows[keys[i]])
        if len(self.map) - count > self._rows() and not self._told:
            self._told = True
            in_view = len(self.map) - count
            self.budget.notes.append(
                f"the map's part of the memory limit holds {self._rows()} Gaussians, but {in_view} are in "
                "view of one keyframe: the limit will be exceeded (a larger memory_limit_mb, a smaller `scale` or "
                "paging.view_range helps)"
            )
        with delay_interrupts():
            self.moved_out += cells.move_out(self.map, chosen) if chosen else 0
        self._trainable = None

    def _last_seen(self, boxes: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Number of the last keyframe that sees each box, int64 [M], -1 for none."""
        last, unseen = np.full(len(boxes[0]), -1), np.arange(len(boxes[0]))
        for end in range(len(self.mapper.keyframes), 0, -_AT_ONCE):
            numbers = np.arange(max(0, end - _AT_ONCE), end)
            seen = self._frustums(self._views(numbers.tolist())).touch(boxes[0][unseen], boxes[1][unseen])
            last[unseen] = np.where(seen, numbers[:, None], -1).max(0)
            unseen = unseen[last[unseen] < 0]
            if not len(unseen):
                break
        return last

    def _opened(self) -> GaussianCells:
        if self.cells is None:
            shutil.rmtree(self.folder / "grid", ignore_errors=True)
            store = GridStore.create(self.folder / "grid", SubmapSettings(spacing=self.settings.cell))
            self.cells = GaussianCells(store, self.map)
        return self.cells
