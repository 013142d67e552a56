# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of a cell: a part of it as bytes, arrays, or a map."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping

import numpy as np
import torch

from ggslam.errors import FormatError, GgslamError
from ggslam.scene.arrays import arrays_of, arrays_to_bytes
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore

GAUSSIANS = "gaussians.npz"
"""The part of a cell with the Gaussians whose means lie in it: the arrays of `GaussianMap`, and the visit they are
from."""
ARRAYS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features", "object_id")
_VISIT = "visit"


def gaussians_to_bytes(arrays: Mapping[str, np.ndarray], visit: str | None) -> bytes:
    """Content of the part."""
    named = {} if visit is None else {_VISIT: np.array(visit)}
    return arrays_to_bytes(**{name: arrays[name] for name in ARRAYS}, **named)


def gaussians_from_bytes(data: bytes, what: str) -> tuple[dict[str, np.ndarray], str | None]:
    """The arrays of a part, checked to belong together, and the visit they are from (stores of before they were noted:
    None).

    Raises:
        FormatError: damaged; begins with `what`.
    """
    rows = arrays_of(io.BytesIO(data), what, lambda held: {n: held[n] for n in (*ARRAYS, _VISIT) if n in held.files})
    visit = rows.pop(_VISIT, None)
    try:
        map_of_arrays(rows)
        return rows, None if visit is None else str(visit[()])
    except (KeyError, ValueError, IndexError, RuntimeError, TypeError, GgslamError) as error:
        raise FormatError(f"{what}: {error}") from None


def map_of_arrays(rows: Mapping[str, np.ndarray], with_moments: bool = False) -> GaussianMap:
    """A map of the arrays of a part; optimizer states are zero, if there are any."""
    given = {name: torch.from_numpy(np.ascontiguousarray(rows[name])) for name in ARRAYS}
    means, sh, features = given["means"], given["sh"], given["features"]
    out = GaussianMap(math.isqrt(sh.shape[1]) - 1, features.shape[1], with_moments=with_moments)
    out.insert(means, given["quaternions"], given["log_scales"], given["opacity_logits"], torch.zeros(len(means), 3),
               features=features, object_id=given["object_id"])  # fmt: skip
    out.sh[:] = sh
    return out


def arrays_of_map(gaussians: GaussianMap) -> dict[str, np.ndarray]:
    """Views of a map's arrays, for `gaussians_to_bytes`."""
    return {name: getattr(gaussians, name).detach().numpy() for name in ARRAYS}


def gaussians_of_cell(store: GridStore, key: CellKey) -> GaussianMap:
    """The Gaussians whose means lie in a cell that has some, without optimizer state.

    Raises:
        FormatError: their file is missing or damaged.
    """
    return map_of_arrays(cell_arrays(store, key)[0])


def cell_arrays(store: GridStore, key: CellKey) -> tuple[dict[str, np.ndarray], str | None]:
    """Arrays and visit of a cell's Gaussians; errors as of `gaussians_of_cell`."""
    what = f"{store.path}: cell {key}: no Gaussians written by ggslam"
    return gaussians_from_bytes(store.get(key, GAUSSIANS), what)
