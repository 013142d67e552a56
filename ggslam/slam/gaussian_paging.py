# SPDX-License-Identifier: Apache-2.0
"""Gaussians of far cells move to disk and come back, see `map_paging`."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch

from ggslam.mapping.color_changes import scale_colors
from ggslam.mapping.deformation import move_with_keyframes
from ggslam.mapping.mapper import Mapper
from ggslam.mapping.votes import vote_labels
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.keyframe_visibility import KeyframeVisibility, ViewReach
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.submaps.grid import GridStore
from ggslam.submaps.paging_settings import PagingSettings
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.interrupts import delay_interrupts


class GaussianPager:
    """Moves the Gaussians of one mapper's map.

    Args:
        settings: see there.
        visibility: of the keyframes.
        folder: to page to; made when it is needed.
    """

    def __init__(self, settings: PagingSettings, visibility: KeyframeVisibility, folder: Path) -> None:
        self._settings, self._visibility, self._folder = settings, visibility, folder
        self._mapper: Mapper | None = None
        self.cells: GaussianCells | None = None
        """What is on disk; None until the first Gaussians go there."""
        self.moved_out, self.moved_in = 0, 0
        """Gaussians that went to disk and came back so far."""
        self.most_resident = 0
        """The most Gaussians that were in memory."""

    def serve(self, mapper: Mapper) -> None:
        """Takes charge of a mapper's map, which must be empty."""
        self._mapper = mapper

    @property
    def mapper(self) -> Mapper:
        """The mapper whose map is paged."""
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

    @property
    def is_split(self) -> bool:
        """Whether a part of the map is on disk now."""
        return self.cells is not None and bool(self.cells.sorted_keys())

    def note_size(self) -> None:
        """Gaussians were added to the map."""
        self.most_resident = max(self.most_resident, len(self.map))

    def complete(self, numbers: Sequence[int]) -> Sequence[int]:
        """Those of some keyframes of whose view nothing is on disk; the last one if there are none."""
        if self.cells is None or not self.is_split or not len(numbers):
            return numbers
        found: list[int] = []
        for asked, frustums in self._visibility.batches(numbers):
            lacking = self.cells.visible_cells(frustums)
            found += [number for number, keys in zip(asked, lacking, strict=True) if not keys]
        return found or [numbers[-1]]  # the budget is less than one view: the newest is trained on what there is

    # --- to memory ---------------------------------------------------------------------------------------------------

    def bring(self, views: list[ViewReach], limit: int, room: int = 0) -> int:
        """Brings what is seen into memory, and sends others away so that `room` is left of `limit` Gaussians. Returns
        as `send`."""
        wanted: list[CellKey] = []
        if self.cells is not None:
            frustums = self._visibility.frustums(views)
            wanted = sorted({key for keys in self.cells.visible_cells(frustums) for key in keys})
        incoming = 0 if self.cells is None else self.cells.count_in(wanted)
        excess = self.send(views, len(self.map) + incoming + room - limit, limit)
        self._move_in(wanted)
        return excess

    def bring_while_there_is_room(self, numbers: Iterable[int], limit: int) -> None:
        """Brings what these keyframes see, one after the other, up to `limit` Gaussians."""
        if self.cells is None:
            return
        for number in numbers:
            keys = self.cells.visible_cells(self._visibility.frustums(self._visibility.of([number])))[0]
            if len(self.map) + self.cells.count_in(keys) > limit:
                return
            self._move_in(keys)

    def _move_in(self, keys: Sequence[CellKey]) -> None:
        if self.cells is None or not keys:
            return
        begin = len(self.map)
        with delay_interrupts():
            rows = self.cells.move_in(self.map, keys)
        self.moved_in += rows.stop - begin
        self.note_size()
        if self.mapper.identity is not None:
            self.mapper.identity.catch_up(self.map)

    # --- to disk -----------------------------------------------------------------------------------------------------

    def send(self, views: list[ViewReach], excess: int, limit: int) -> int:
        """Sends at least `excess` Gaussians to disk, if so many are not seen from here, and some more, so that it is
        not needed again at once. Returns how many stay above `limit`."""
        if excess <= 0:
            return 0
        cells = self._open_cells()
        rows = cells.cells_of(self.map)
        if not rows:
            return 0
        chosen = self._choose(views, cells, rows, excess, excess + int(self._settings.slack * limit))
        left = len(self.map) - sum(len(part) for part in chosen.values())
        with delay_interrupts():
            self.moved_out += cells.move_out(self.map, chosen) if chosen else 0
        return max(0, left - limit)

    def _choose(
        self, views: list[ViewReach], cells: GaussianCells, rows: dict[CellKey, np.ndarray], excess: int, enough: int
    ) -> dict[CellKey, np.ndarray]:
        """The cells to send: those seen the longest ago, of these the farthest first. Near ones only up to `excess`,
        others up to `enough` Gaussians."""
        keys = list(rows)
        centres = cells.store.grid.centres_of(np.array(keys))
        boxes = cells.boxes_of(self.map, rows)
        seen = np.asarray(self._visibility.frustums(views).touch(*boxes).any(0))
        last_seen = self._visibility.last_seen(boxes)
        positions = np.stack([view.T_world_camera[:3, 3] for view in views])
        distance = np.linalg.norm(centres[:, None] - positions, axis=2).min(1)
        chosen: dict[CellKey, np.ndarray] = {}
        count = 0
        for i in np.lexsort((-distance, last_seen)).tolist():
            far = distance[i] > self._settings.keep_radius
            if not seen[i] and count < (enough if far else excess):
                chosen[keys[i]] = rows[keys[i]]
                count += len(rows[keys[i]])
        return chosen

    def _open_cells(self) -> GaussianCells:
        if self.cells is None:
            shutil.rmtree(self._folder / "grid", ignore_errors=True)
            store = GridStore.create(self._folder / "grid", SubmapSettings(spacing=self._settings.cell))
            self.cells = GaussianCells(store, self.map)
        return self.cells

    # --- on disk -----------------------------------------------------------------------------------------------------

    def move_keyframes(self, T_new_old: np.ndarray) -> None:
        """Gaussians on disk follow their keyframes, as `Mapper.move_keyframes` does with those in memory."""
        if self.cells is None:
            return
        moved = np.flatnonzero(np.abs(T_new_old - np.eye(4)).max((1, 2)) > 0).tolist()
        with delay_interrupts():
            self.cells.change(lambda gaussians: move_with_keyframes(gaussians, T_new_old), moved)

    def scale_colors(self, gain: np.ndarray) -> None:
        """Gaussians on disk get another exposure: a gain for each channel [3]."""
        if self.cells is not None:
            with delay_interrupts():
                self.cells.change(lambda gaussians: scale_colors(gaussians, gain))

    def vote_sizes(self) -> np.ndarray:
        """Gaussians on disk by the object with the most votes, int64 [65536]."""
        sizes = np.zeros(65536, np.int64)
        for _, part in () if self.cells is None else self.cells.parts():
            if self.mapper.identity is not None:
                self.mapper.identity.catch_up(part)
            sizes += np.bincount(vote_labels(part).numpy(), minlength=65536)
        return sizes

    def move_all_out(self) -> GaussianCells | None:
        """Everything goes to disk, if anything is there, and its cells are handed over; None: all is in memory."""
        if self.cells is None:
            return None
        self._prune_nowhere()
        with delay_interrupts():
            self.cells.move_out(self.map, self.cells.cells_of(self.map))
        self.map.shrink(0)
        if self.mapper.identity is not None:
            self.cells.change(self.mapper.identity.catch_up_and_label)
        self.cells.remove_emptied()
        return self.cells

    def _prune_nowhere(self) -> None:
        """Gaussians at no place have no cell."""
        self.map.keep(torch.isfinite(self.map.means).all(1) & (self.map.means.abs() < 1e5).all(1))

    def close(self) -> None:
        """Closes the files of the cells."""
        if self.cells is not None:
            self.cells.store.close()
