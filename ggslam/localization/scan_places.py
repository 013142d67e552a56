# SPDX-License-Identifier: Apache-2.0
"""Places in the cells of a grid store at which laser scans are looked up.

The part `SCAN_PLACES` of a cell holds a row for each scan that was recorded in it:

    positions float64 [k, 3] of the sensor, world    floors float32 [k] height of the floor below it (negative)
    codes uint8 [k, 600] what was seen, in the axes of the world (`scan_views`)

A map without such parts, made of a cloud or of a run, is looked at from above instead (`map_picture`).
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.errors import FormatError
from ggslam.localization.level import about_z, between, level_axes
from ggslam.localization.near import Near
from ggslam.localization.scan_views import CODE_BYTES, ViewIndex, code_of, view_of
from ggslam.scene.arrays import arrays_of, arrays_to_bytes
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import GridAxes
from ggslam.system.array_forms import Form, check_arrays
from ggslam.system.tuning import Tuning

SCAN_PLACES = "scan_places.npz"
_FORMS = {
    "positions": Form("f8", "scans", 3, finite=True), "floors": Form("f4", "scans", finite=True),
    "codes": Form("u1", "scans", CODE_BYTES),
}  # fmt: skip
_NAMES = ("positions", "floors", "codes")


class ScanPlaceTuning(Tuning):
    """Places that scans are looked up among."""

    rings = 2
    """Rings around the sensor from which the scan's view is simulated."""
    min_ring_m = 0.8
    """Smallest distance between rings in metres."""
    max_ring_m = 2.5
    """Largest distance between rings in metres."""
    same_turn_rad = 0.35
    """Largest difference of the headings of one guess, in radians."""
    other_turns = np.pi / 2, np.pi, -np.pi / 2
    """Other headings of the likeliest place, in radians, tried where a map has few places: they show the score of a
    wrong pose."""




@dataclass(frozen=True)
class ScanPlace:
    """Where a scan was made, [3] in the world, the height of the floor below, and what it saw; see `ScanView`."""

    position: np.ndarray
    floor: float
    code: np.ndarray


def place_of(points: np.ndarray, T_world_sensor: np.ndarray, axes: GridAxes) -> ScanPlace | None:
    """The place of a scan, points [n, 3] in the sensor's frame; None where it shows no floor."""
    seen = view_of(points @ (level_axes(axes).T @ T_world_sensor[:3, :3]).T)
    return None if seen is None else ScanPlace(T_world_sensor[:3, 3].copy(), seen.floor, seen.code)


def scan_places_to_bytes(places: Sequence[ScanPlace]) -> bytes:
    """The part `SCAN_PLACES` of these places."""
    return arrays_to_bytes(
        positions=np.array([place.position for place in places], np.float64).reshape(-1, 3),
        floors=np.array([place.floor for place in places], np.float32),
        codes=np.array([place.code for place in places], np.uint8).reshape(-1, CODE_BYTES),
    )


def load_scan_places(store: GridStore, key: CellKey) -> list[ScanPlace]:
    """The places of one cell that has them. Raises FormatError if the part is damaged."""
    arrays = _arrays(store, key)
    return [ScanPlace(*row) for row in zip(*(arrays[name] for name in _NAMES), strict=True)]


class ScanPlaces:
    """Places of a map in memory, whatever else it holds: 2 KB each.

    Args:
        positions: float64 [n, 3], world.
        floors: float64 [n], height of the floor above the sensor (negative).
        codes: uint8 [n, CODE_BYTES].
        axes: of the map's grid.
        damage: what is wrong with parts that were left out.
        any_recorded: whether the map has places at all, these or others.
    """

    def __init__(
        self, positions: np.ndarray, floors: np.ndarray, codes: np.ndarray, axes: GridAxes,
        damage: Sequence[str] = (), any_recorded: bool = True,
    ) -> None:  # fmt: skip
        self.positions, self.damage, self.any_recorded = positions, list(damage), any_recorded
        self._floors, self._index, self._R_world_level = floors, ViewIndex(codes), level_axes(axes)

    def __len__(self) -> int:
        return len(self.positions)

    def guesses(self, points: np.ndarray, floor: float, count: int, apart: float) -> Iterator[np.ndarray]:
        """Poses T_world_sensor, the likeliest first; see `MapPicture.guesses`."""
        offsets = _offsets(points, floor)
        codes = np.array([code_of(points - offset, floor) for offset in offsets])
        numbers, _, which, turns = self._index.query(codes)
        likely = list(zip(numbers.tolist(), which.tolist(), turns.tolist(), strict=True))
        likely += [(n, w, turn + angle) for n, w, turn in likely[:1] for angle in ScanPlaceTuning.other_turns]
        chosen: list[tuple[np.ndarray, float]] = []
        for number, place, turn in likely:
            R = about_z(turn)
            position = self._R_world_level.T @ self.positions[number] - R @ offsets[place]
            position[2] += self._floors[number] - floor
            same = ScanPlaceTuning.same_turn_rad
            if any(np.linalg.norm(position - p) < apart and _apart(turn, t) < same for p, t in chosen):
                continue
            chosen.append((position, turn))
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = self._R_world_level @ R, self._R_world_level @ position
            yield T
            if len(chosen) == count:
                return


def recorded_places(store: GridStore, near: Near | None = None) -> ScanPlaces:
    """The places that scans were recorded at, of all cells; `near`: only these."""
    parts: list[Mapping[str, np.ndarray]] = []
    damaged = []
    for key in store.cells():
        if SCAN_PLACES in store.cell(key).parts:
            try:
                parts.append(_arrays(store, key))
            except FormatError as error:
                damaged.append(str(error))
    empty = {"positions": np.zeros((0, 3)), "floors": np.zeros(0, np.float32), "codes": np.zeros((0, CODE_BYTES), "u1")}
    merged = {name: np.concatenate([empty[name], *(part[name] for part in parts)]) for name in _NAMES}
    if near is not None:
        allowed = near.allows(merged["positions"], store.settings.axes)
        merged = {name: values[allowed] for name, values in merged.items()}
    floors = merged["floors"].astype(float)
    return ScanPlaces(merged["positions"], floors, merged["codes"], store.settings.axes, damaged, bool(parts))


def _offsets(points: np.ndarray, floor: float) -> np.ndarray:
    """Of places around the sensor, [m, 3], farther apart where it sees farther."""
    standing = points[between(points, floor)]
    across = np.hypot(standing[:, 0], standing[:, 1])
    step = (
        float(np.clip(np.median(across) / 4, ScanPlaceTuning.min_ring_m, ScanPlaceTuning.max_ring_m))
        if len(across)
        else ScanPlaceTuning.min_ring_m
    )
    offsets = [np.zeros(3)]
    for ring in range(1, ScanPlaceTuning.rings + 1):
        for angle in np.arange(6 * ring) * (2 * np.pi / (6 * ring)):
            offsets.append(ring * step * np.array([np.cos(angle), np.sin(angle), 0.0]))
    return np.array(offsets)


def _apart(one: float, other: float) -> float:
    return abs((one - other + np.pi) % (2 * np.pi) - np.pi)


def _arrays(store: GridStore, key: CellKey) -> Mapping[str, np.ndarray]:
    return arrays_of_scan_places(store.get(key, SCAN_PLACES), f"{store.path}: cell {key}: {SCAN_PLACES}")


def arrays_of_scan_places(data: bytes, where: str) -> Mapping[str, np.ndarray]:
    """The arrays of the part `SCAN_PLACES`. Raises FormatError if it is damaged; begins with `where`."""
    arrays = arrays_of(io.BytesIO(data), f"{where}: damaged", lambda held: {name: held[name] for name in _NAMES})
    check_arrays(arrays, _FORMS, f"{where}: damaged")
    return arrays
