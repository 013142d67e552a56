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

from ggslam.formats.array_archive import ArrayArchive
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.gaussian_paging import GaussianPager
from ggslam.slam.keyframe_visibility import KeyframeVisibility, ViewReach
from ggslam.slam.memory_budget import MB, MemoryBudget
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.submaps.paging_settings import PagingSettings
from ggslam.system.tuning import Tuning


class PagingTuning(Tuning):
    """How much memory paging keeps free."""

    measured_after = 3
    """Keyframes after which the memory of the program is measured. By then every part of it has run."""
    renderer_bytes = 110
    """Memory of the rasterizer per Gaussian, in bytes: a splat of 64 bytes and a footprint, with spare room."""
    growth = 0.1
    """Spare capacity of the map, as a share of its size."""
    insertions = 8
    """Latest keyframes whose largest insertion sets the room that is kept. The first keyframe is left out."""


class MapPager:
    """Keeps map and keyframes of one mapper within a budget: divides it among Gaussians, images and places, and says
    when `GaussianPager` has to move Gaussians.

    Args:
        camera: of all keyframes.
        settings: see there.
        budget: of the process.
        folder: to page to; made when it is needed.
    """

    def __init__(self, camera: Camera, settings: PagingSettings, budget: MemoryBudget, folder: Path) -> None:
        self.settings, self.budget, self.folder = settings, budget, folder
        self.archive = ArrayArchive(folder / "keyframes")
        """Keeps the keyframes' images and points."""
        self._visibility = KeyframeVisibility(camera, settings)
        self._gaussians = GaussianPager(settings, self._visibility, folder)
        self._new: list[int] = []
        self._place_bytes = 0
        self._trainable: Sequence[int] | None = None
        self._told = False

    def serve(self, mapper: Mapper) -> None:
        """Takes charge of a mapper's map, which must be empty."""
        self._gaussians.serve(mapper)
        self._visibility.keyframes = mapper.keyframes
        mapper.residency = self
        mapper.map.growth = PagingTuning.growth

    @property
    def cells(self) -> GaussianCells | None:
        """What is on disk; None until the first Gaussians go there."""
        return self._gaussians.cells

    @property
    def on_disk(self) -> int:
        """Gaussians on disk."""
        return self._gaussians.on_disk

    # --- around a keyframe -------------------------------------------------------------------------------------------

    def prepare(self, T_world_camera: np.ndarray, depth: np.ndarray) -> None:
        """Before a keyframe is inserted: all that it may see comes into memory, and room is made.

        Args:
            T_world_camera: its pose [4, 4].
            depth: what it measured, metres [H, W].
        """
        view = self._visibility.add(T_world_camera, depth)
        self._bring([view], max(self._new[1:][-PagingTuning.insertions:], default=0))

    def finish_insertion(self, keyframe: Keyframe, added: int, place_bytes: int = 0) -> None:
        """After a keyframe was inserted and its points are in the surface: images are handed over, what is too much
        goes.

        Args:
            keyframe: the new one.
            added: Gaussians it brought.
            place_bytes: that all keyframes' places take by now; they stay in memory.
        """
        self._new.append(added)
        self._place_bytes = place_bytes
        self._trainable = None
        keyframe.put_away(self.archive)
        self._gaussians.note_size()
        if len(self._new) == PagingTuning.measured_after:
            self.budget.measure(self._held_bytes())
        reduced = self.budget.check(self._held_bytes())
        if self.budget.map_bytes is None:
            return
        self.archive.limit = self.settings.images * self.budget.map_bytes
        self._send([self._visibility.newest()], len(self._map) - self._rows())
        if reduced:
            self._map.shrink(int(1.05 * self._rows()))

    # --- what the mapper asks ----------------------------------------------------------------------------------------

    def trainable(self) -> Sequence[int]:
        """See `Residency`."""
        if self._trainable is None:
            self._trainable = self._gaussians.complete(range(len(self._visibility.keyframes)))
            if self._gaussians.mapper.identity is not None:
                self._gaussians.mapper.identity.keep_pools(self._trainable)
        return self._trainable

    @property
    def is_whole(self) -> bool:
        """See `Residency`."""
        return not self._gaussians.is_split

    def stages(self) -> Iterator[Sequence[int]]:
        """See `Residency`: along the way, as many keyframes at a time as there is room for."""
        left = list(range(len(self._visibility.keyframes)))
        while left:
            if self._gaussians.is_split:
                views = self._visibility.of(left[:1])
                self._send(views, len(self._map) - self._rows() // 2)
                self._bring(views)
                self._gaussians.bring_while_there_is_room(left[1:], self._rows())
            complete = set(self._gaussians.complete(left))
            stage = [number for number in left if number in complete or number == left[0]]
            self._trainable = stage
            yield stage
            left = [number for number in left if number not in set(stage)]
        self._trainable = None

    def scale_colors(self, gain: np.ndarray) -> None:
        """See `Residency`."""
        self._gaussians.scale_colors(gain)

    # --- loops -------------------------------------------------------------------------------------------------------

    def move_keyframes(self, T_new_old: np.ndarray) -> None:
        """Gaussians on disk follow their keyframes, as `Mapper.move_keyframes` does with those in memory."""
        self._trainable = None
        self._gaussians.move_keyframes(T_new_old)

    def bring_ends(self, kept: Iterable[int]) -> None:
        """After a loop was closed: as much as there is room for of what the newest keyframe and those at the older end
        of the loop may see."""
        if self.cells is None:
            return
        self._bring(self._visibility.of([len(self._visibility.keyframes) - 1]))
        self._gaussians.bring_while_there_is_room(sorted(kept, reverse=True), self._rows())
        self._trainable = None

    # --- the end -----------------------------------------------------------------------------------------------------

    def vote_sizes(self) -> np.ndarray:
        """Gaussians on disk by the object with the most votes, int64 [65536]."""
        return self._gaussians.vote_sizes()

    def move_all_out(self) -> GaussianCells | None:
        """Everything goes to disk, if anything is there, and its cells are handed over; None: all is in memory."""
        if self.cells is not None:
            self.archive.limit = 0
        return self._gaussians.move_all_out()

    def close(self) -> None:
        """Removes all files."""
        self._gaussians.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def report(self) -> dict[str, float]:
        """Figures of the run, sizes in MB (10^6 bytes)."""
        written = 0 if self.cells is None else self.cells.bytes_written
        total = (len(self._map) + self.on_disk) * self._map.bytes_per_gaussian
        return {
            "limit_mb": self.budget.limit / MB, "program_mb": self.budget.program_bytes / MB,
            "budget_mb": (self.budget.map_bytes or 0) / MB, "map_mb": total / MB,
            "gaussian_budget_mb": (self._rows() if self.budget.map_bytes else 0) * self._map.bytes_per_gaussian / MB,
            "most_resident": self._gaussians.most_resident, "moved_out": self._gaussians.moved_out,
            "moved_in": self._gaussians.moved_in,
            "written_mb": written / MB, "images_on_disk_mb": self.archive.bytes_on_disk / MB,
            "places_mb": self._place_bytes / MB,
        }  # fmt: skip

    # --- parts -------------------------------------------------------------------------------------------------------

    @property
    def _map(self) -> GaussianMap:
        return self._gaussians.map

    def _row_bytes(self) -> float:
        return (1 + PagingTuning.growth) * self._map.bytes_per_gaussian + PagingTuning.renderer_bytes

    def _held_bytes(self) -> int:
        return int(self._map.capacity * self._row_bytes()) + self.archive.held_bytes + self._place_bytes

    def _rows(self) -> int:
        """Gaussians that may be in memory."""
        assert self.budget.map_bytes is not None
        left = (1 - self.settings.images) * self.budget.map_bytes - self._place_bytes
        return max(1, int(left / self._row_bytes()))

    def _bring(self, views: list[ViewReach], room: int = 0) -> None:
        """Brings what is seen into memory, and makes room for it and for `room` more."""
        if self.budget.map_bytes is not None:
            self._note_excess(self._gaussians.bring(views, self._rows(), room))
            self._trainable = None

    def _send(self, views: list[ViewReach], excess: int) -> None:
        """Sends at least `excess` Gaussians to disk, if so many are not seen."""
        if excess > 0:
            self._note_excess(self._gaussians.send(views, excess, self._rows()))
            self._trainable = None

    def _note_excess(self, excess: int) -> None:
        if excess > 0 and not self._told:
            self._told = True
            self.budget.notes.append(
                f"the map's part of the memory limit holds {self._rows()} Gaussians, but one keyframe sees "
                f"{self._rows() + excess}: the limit will be exceeded. Raise memory_limit_mb, or lower `scale` or "
                "paging.view_range"
            )
