# SPDX-License-Identifier: Apache-2.0
"""Finds those of many earlier views of which a newer one looks past places in some voxels, in one call."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import PassedVoxelsJob, PlacesView
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.poses import inverse
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, PairEvidence, native_places, native_rule


class KeptPlaces:
    """A view that is asked about again and again, wherever it is then.

    Args:
        view: its pose does not matter.

    Raises:
        ValueError: an array has another shape than the view's camera.
    """

    def __init__(self, view: CoarseView) -> None:
        self.view, self._alive = view, list[np.ndarray]()
        self.native: PlacesView = native_places(view, self._alive)
        """As the core takes it."""


def passed_in_voxels(
    earlier: Sequence[KeptPlaces], T_world_earlier: np.ndarray, newest: CoarseView, keys: np.ndarray, voxel_m: float,
    fewest: Sequence[int], margin: Margin, context: NativeContext,
) -> list[PairEvidence | None]:  # fmt: skip
    """What a newer view says of earlier ones, where it looks past some of their places in voxels.

    Args:
        earlier: views of one size.
        T_world_earlier: float64 [n, 4, 4], where they are.
        newest: the newer view.
        keys: int64, sorted, see `ggslam.geometry.voxels`.
        voxel_m: edge of a voxel, metres.
        fewest: of each view, how many places have to be looked past: in voxels, or connected to those that are.
        margin: see there.
        context: that it is computed in.

    Returns:
        As `compare` has it; None where the places are fewer.

    Raises:
        ValueError: an array has another shape than its view's camera.
    """
    if not earlier:
        return []
    alive: list[np.ndarray] = []
    views = (PlacesView * len(earlier))(*[one.native for one in earlier])
    T_world = np.ascontiguousarray(T_world_earlier[:, :3], float)
    T_newest = np.ascontiguousarray((inverse(newest.T_world_camera) @ T_world_earlier)[:, :3], np.float32)
    least, keys = np.array(fewest, np.int32), np.ascontiguousarray(keys, np.int64)
    found = np.empty((len(earlier), 5, *earlier[0].view.depth.shape), bool)
    passed = np.empty(len(earlier), np.int32)
    job = PassedVoxelsJob(
        ctypes.addressof(views), address(T_world), address(T_newest), address(least), len(earlier),
        native_places(newest, alive), address(keys), len(keys), voxel_m, native_rule(margin), address(passed),
        address(found),
    )  # fmt: skip
    load_library().ggslam_passed_voxels(context.handle, ctypes.byref(job))
    return [PairEvidence(*found[i]) if count else None for i, count in enumerate(passed.tolist())]
