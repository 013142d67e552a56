# SPDX-License-Identifier: Apache-2.0
"""Keeps the decoded cells of a stored map around the sensor: they are updated when the sensor enters a cell (SRT-PM),
and cells ahead along the motion are loaded in the background."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from enum import Enum
from functools import partial
from types import TracebackType
from typing import Any, Generic, TypeVar

import numpy as np

from ggslam.errors import FormatError
from ggslam.submaps.cell_cache import Cell, CellCache
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore, check_same_grid
from ggslam.submaps.loading_ahead import BackgroundLoader
from ggslam.submaps.settings import SubmapSettings

Own = TypeVar("Own", bound="CellsAround[Any]")


class MapStatus(Enum):
    """What `CellsAround.update` found."""

    UNCHANGED = "unchanged"
    """The map is the one of the last update."""
    CHANGED = "changed"
    """Cells came or went, or were written anew."""
    EMPTY = "empty"
    """No cell of the store that can be read is within R'."""


class CellsAround(Generic[Cell]):
    """The cells within R' of the sensor, decoded by a loader.

    One thread calls `update`; others may read `cells`, which is replaced at once. Memory: the cells, the cache
    (bounded), and a cell being decoded for each of the two threads.

    Args:
        store: where the cells are; it must stay open.
        loader: decodes a cell.
        part: the part that `loader` decodes: cells without it are left out, cells where it was written anew are loaded
            again.
        size: gives the bytes of a decoded cell, for the cache.
        settings: None: the store's.

    Raises:
        ConfigError: `settings` have another grid than the store.
    """

    def __init__(
        self,
        store: GridStore,
        loader: Callable[[GridStore, CellKey], Cell],
        part: str,
        size: Callable[[Cell], int],
        settings: SubmapSettings | None = None,
    ) -> None:
        self.store = store
        self.settings = settings or store.settings
        check_same_grid(store.path, store.settings, self.settings)
        self.cells: Mapping[CellKey, Cell] = {}
        """What the loader gave, nearest first."""
        self.damaged: Mapping[CellKey, str] = {}
        """Cells within R' that cannot be read and are left out, with the reason."""
        self.cache = CellCache(int(self.settings.cache_megabytes * 1e6), size)
        self._loader, self._part, self._size = loader, part, size
        self._versions: dict[CellKey, int] = {}
        self.radius = self.settings.partial_radius
        """R' of the moment, metres."""
        self._step: float | None = None
        self._entered: CellKey | None = None
        self._centre: tuple[np.ndarray, float] | None = None
        self._last_position: np.ndarray | None = None
        self._last_ahead: CellKey | None = None
        self._updating = threading.Lock()
        self._ahead = BackgroundLoader(self._steps_ahead) if self.settings.lookahead > 0 else None

    def update(self, position: np.ndarray, velocity: np.ndarray | None = None) -> MapStatus:
        """Looks up and loads cells if the sensor has entered another cell since the last update.

        Args:
            position: of the sensor, [3] metres, world.
            velocity: its direction is where cells are loaded ahead, [3] in the world; None: from the last position.

        Raises:
            ConfigError: the position is not finite.
            FormatError: the index of the store is damaged. (Cells that are damaged are listed in `damaged`.)
        """
        position = np.array(position, np.float64)
        with self._updating:
            key = self.store.key_of(position)
            changed = self._is_due(key, position) and self._assemble(position)
            self._entered = key
            self._look_ahead(position, velocity)
            self._last_position = position
            if not self.cells:
                return MapStatus.EMPTY
            return MapStatus.CHANGED if changed else MapStatus.UNCHANGED

    def set_reach(self, radius: float, step: float) -> None:
        """From the next update on: R', and the metres from where cells were looked up at which they are again,
        instead of whenever the sensor enters a cell."""
        with self._updating:
            self.radius, self._step = radius, step

    def wait(self, timeout: float | None = None) -> bool:
        """Waits, at most `timeout` seconds, until loading ahead has nothing left to do; returns whether that is so."""
        return self._ahead is None or self._ahead.wait(timeout)

    def close(self) -> None:
        """Ends loading ahead. The arrays stay."""
        if self._ahead is not None:
            self._ahead.close()
        self.cache.clear()

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _is_due(self, key: CellKey, position: np.ndarray) -> bool:
        """Whether cells are to be looked up for a sensor in a cell."""
        if self._step is None:
            return key != self._entered
        if self._centre is not None and self._centre[1] == self.radius:
            away = float(np.linalg.norm((position - self._centre[0]) * self.store.grid.spans))
            if away <= self._step:
                return False
        self._centre = position, self.radius
        return True

    def _assemble(self, position: np.ndarray) -> bool:
        """Loads what came, drops what went; whether there was anything to do."""
        wanted = self.store.part_versions(self._part, position, self.radius)
        if wanted == self._versions:
            return False
        cells: dict[CellKey, Cell] = {}
        damaged: dict[CellKey, str] = {}
        for key, version in wanted.items():
            if key in self.cells and self._versions[key] == version:
                cells[key] = self.cells[key]
                continue
            try:
                cells[key] = self._load(key, version)
            except FormatError as error:
                damaged[key] = str(error)
            except KeyError:  # removed since
                continue
        self._versions = wanted
        self.cells, self.damaged = self._to_keep(cells), damaged
        return True

    def _to_keep(self, cells: Mapping[CellKey, Cell]) -> Mapping[CellKey, Cell]:
        """What to keep as `cells`."""
        return cells

    def _load(self, key: CellKey, version: int) -> Cell:
        return self.cache.get((key, version), lambda: self._loader(self.store, key))

    def _look_ahead(self, position: np.ndarray, velocity: np.ndarray | None) -> None:
        if self._ahead is None:
            return
        if velocity is None:
            velocity = np.zeros(3) if self._last_position is None else position - self._last_position
        speed = float(np.linalg.norm(velocity))
        if not speed > 0:
            return
        far = max(self.settings.lookahead, 2 * (self._step or 0.0))
        ahead = position + np.asarray(velocity, np.float64) * (far / speed)
        key = self.store.key_of(ahead)
        if key != self._last_ahead:
            self._last_ahead = key
            self._ahead.request(ahead)

    def _steps_ahead(self, position: np.ndarray) -> Iterator[Callable[[], None]]:
        """Loads cells around a place, nearest first, until one more could push the first out of the cache."""
        wanted = self.store.part_versions(self._part, position, self.radius)
        current = self._versions
        loaded = largest = 0

        def step(key: CellKey, version: int) -> None:
            nonlocal loaded, largest
            with suppress(FormatError, KeyError):  # `update` says so if the sensor gets there
                size = self._size(self._load(key, version))
                loaded, largest = loaded + size, max(largest, size)

        for key, version in wanted.items():
            if loaded + largest > self.cache.limit:
                return
            if current.get(key) != version:
                yield partial(step, key, version)
