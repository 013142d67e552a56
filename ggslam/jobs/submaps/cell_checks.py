# SPDX-License-Identifier: Apache-2.0
"""Whether what a client sent is a cell: parts that cells have, whole, as many things as it says, finite, and there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ggslam.errors import FormatError
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, gaussians_from_bytes
from ggslam.localization.places import PLACES, arrays_of_places
from ggslam.localization.scan_places import SCAN_PLACES, arrays_of_scan_places
from ggslam.submaps.cell_keys import Grid
from ggslam.submaps.cell_points import POINTS, decode_points
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.array_forms import Form, PoseForm, check_arrays
from ggslam.system.tuning import Tuning


class CellCheckTuning(Tuning):
    """How far from its cell something may lie."""

    sensor_m = 300.0
    """Of points: metres that a sensor sees, if the store's R and range are not greater."""
    cells = 1.0
    """Of Gaussians and of places: edges of a cell. They lie in it, but positions are rounded when they are coded."""
    rounding = 2.0**-22
    """Rounding of positions in single precision, as a share of their distance from the origin."""


_GAUSSIANS = {
    "means": Form("float", "gaussians", 3, finite=True), "quaternions": Form("float", "gaussians", 4, finite=True),
    "log_scales": Form("float", "gaussians", 3, finite=True),
    "opacity_logits": Form("float", "gaussians", finite=True),
    "sh": Form("float", "gaussians", None, 3, finite=True), "features": Form("float", "gaussians", None, finite=True),
    "object_id": Form("int", "gaussians"),
}  # fmt: skip


def check_cell(write: CellWrite, settings: SubmapSettings) -> None:
    """Raises FormatError if a cell that is to be written to a store of these settings is none."""
    grid = Grid(settings.spacing, settings.axes)
    if any(number for number, spanned in zip(write.key, grid.spans, strict=True) if not spanned):
        raise FormatError(f"{write.key} is no cell of a grid along {settings.axes}")
    for name, data in write.parts.items():
        if name not in _POSITIONS:
            raise FormatError(f"cell {write.key}: {name!r} is no part that is taken: {', '.join(_POSITIONS)}")
        what = f"cell {write.key}: {name}"
        positions = _POSITIONS[name](data, what).astype(np.float64)
        if len(positions) != write.counts.get(name, 0):
            raise FormatError(f"{what}: {len(positions)} things, the message says {write.counts.get(name, 0)}")
        if not np.isfinite(positions).all():
            raise FormatError(f"{what}: not all positions are finite")
        _check_positions(positions, write, name, settings)


def _check_positions(positions: np.ndarray, write: CellWrite, name: str, settings: SubmapSettings) -> None:
    """Raises FormatError if one of [n, 3] lies too far from the cell."""
    grid = Grid(settings.spacing, settings.axes)
    reach = max(settings.radius + settings.sensor_range, CellCheckTuning.sensor_m)
    slack = reach if name == POINTS else CellCheckTuning.cells * settings.spacing
    centre = grid.centres_of(np.array(write.key))
    slack += CellCheckTuning.rounding * np.abs(centre).max()
    apart = np.abs((positions - centre) * grid.spans).max(initial=0) - settings.spacing / 2
    if np.abs(positions * ~grid.spans).max(initial=0) > PoseForm.FARTHEST_ON_EARTH_M:
        raise FormatError(f"cell {write.key}: {name}: lies beyond the Earth")
    if apart > slack:
        hint = "; the range of the server's sensor tells how far they may lie" if name == POINTS else ""
        raise FormatError(f"cell {write.key}: {name}: {apart:.6g} m outside the cell, at most {slack:g} m{hint}")


def _of_points(data: bytes, what: str) -> np.ndarray:
    return decode_points(data, what)["points"]


def _of_gaussians(data: bytes, what: str) -> np.ndarray:
    arrays, _ = gaussians_from_bytes(data, what)
    check_arrays(arrays, _GAUSSIANS, what)
    return arrays["means"]


def _of_places(data: bytes, what: str) -> np.ndarray:
    return arrays_of_places(data, what)["poses"][:, :3, 3]


def _of_scan_places(data: bytes, what: str) -> np.ndarray:
    return arrays_of_scan_places(data, what)["positions"]


_POSITIONS: dict[str, Callable[[bytes, str], np.ndarray]] = {
    POINTS: _of_points, GAUSSIANS: _of_gaussians, PLACES: _of_places, SCAN_PLACES: _of_scan_places,
}  # fmt: skip
"""Parts that a cell may have, and the positions [n, 3] of what is in them, in metres."""
