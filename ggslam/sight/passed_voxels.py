# SPDX-License-Identifier: Apache-2.0
"""Finds those of many earlier views of which a newer one looks past places in some voxels, in one call."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class PassedParts:
    """What a newer view says of n earlier ones where it looks past places of theirs in voxels.

    Attributes:
        places: int32 [n], in all parts of each of which enough lies in the voxels...
        largest: int32 [n], ...and in the largest one.
        found: bool [n, 5, h, w], see `evidence`.
    """

    places: np.ndarray
    largest: np.ndarray
    found: np.ndarray

    def evidence(self, view: int) -> PairEvidence:
        """What is said of a view that has such places, as `compare` has it."""
        return PairEvidence(*self.found[view])


def find_passed_parts(
    earlier: Sequence[KeptPlaces], T_world_earlier: np.ndarray, newest: CoarseView, keys: np.ndarray, voxel_m: float,
    least_share: float, margin: Margin, context: NativeContext,
) -> PassedParts:  # fmt: skip
    """What a newer view says of earlier ones, where it looks past some of their places in voxels.

    Args:
        earlier: n views of one size, at least one.
        T_world_earlier: float64 [n, 4, 4], where they are.
        newest: the newer view.
        keys: int64, sorted, see `ggslam.geometry.voxels`.
        voxel_m: edge of a voxel, metres.
        least_share: of a part, of connected places that are looked past, that has to lie in the voxels.
        margin: see there.
        context: that it is computed in.

    Raises:
        ValueError: an array has another shape than its view's camera.
    """
    alive: list[np.ndarray] = []
    views = (PlacesView * len(earlier))(*[one.native for one in earlier])
    T_world = np.ascontiguousarray(T_world_earlier[:, :3], float)
    T_newest = np.ascontiguousarray((inverse(newest.T_world_camera) @ T_world_earlier)[:, :3], np.float32)
    keys = np.ascontiguousarray(keys, np.int64)
    found = np.empty((len(earlier), 5, *earlier[0].view.depth.shape), bool)
    passed = np.empty((len(earlier), 2), np.int32)
    job = PassedVoxelsJob(
        ctypes.addressof(views), address(T_world), address(T_newest), len(earlier), native_places(newest, alive),
        address(keys), len(keys), voxel_m, least_share, native_rule(margin), address(passed), address(found),
    )  # fmt: skip
    load_library().ggslam_passed_voxels(context.handle, ctypes.byref(job))
    return PassedParts(passed[:, 0], passed[:, 1], found)
