# SPDX-License-Identifier: Apache-2.0
"""Places in the cells of a grid store: what keyframes that stood in a cell looked like, so that a camera whose pose is
not known can be looked up (`loops.places`). The part `PLACES` of a cell holds arrays, one row or run of rows a view:

    poses float64 [k, 4, 4] T_world_camera    counts int32 [k]    codes uint8 [k, ferns]
    descriptors uint8 [n, 32] and points float32 [n, 3] of the views' landmarks, one view after another
    camera float64 [6]: width, height, fx, fy, cx, cy
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.errors import ConfigError, FormatError
from ggslam.features.orb import FeatureView
from ggslam.localization.near import Near
from ggslam.loops.places import Place, PlaceIndex, PlaceMatch
from ggslam.loops.settings import PlaceSettings
from ggslam.scene.arrays import arrays_of, arrays_to_bytes
from ggslam.scene.camera import Camera
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.system.array_forms import Form, PoseForm, check_arrays
from ggslam.system.tuning import Tuning

PLACES = "places.npz"
_FORMS = {
    "poses": PoseForm("f8", "views", farthest_m=PoseForm.FARTHEST_ON_EARTH_M),
    "counts": Form("int", "views", below=2**31 - 1),
    "codes": Form("u1", "views", None), "descriptors": Form("u1", "landmarks", 32),
    "points": Form("f4", "landmarks", 3, finite=True),
    "camera": Form("f8", 6, finite=True),
}  # fmt: skip
_NAMES = ("poses", "counts", "codes", "descriptors", "points", "camera")
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")


class StoredPlaceTuning(Tuning):
    """Cameras of stored places."""

    same_camera = 1e-3
    """Largest difference of the intrinsics of equal cameras, as a share of the image width."""


@dataclass(frozen=True)
class StoredView:
    """A stored view: its place and pose T_world_camera [4, 4]."""

    place: Place
    T_world_camera: np.ndarray


def stored_places_to_bytes(views: Sequence[StoredView], camera: Camera) -> bytes:
    """The part `PLACES` of these views."""
    landmarks = [view.place.landmarks for view in views]
    return arrays_to_bytes(
        poses=np.array([view.T_world_camera for view in views]).reshape(-1, 4, 4),
        counts=np.array([len(marks) for marks in landmarks], np.int32),
        codes=np.array([view.place.codes for view in views]),
        descriptors=np.concatenate([marks.descriptors for marks in landmarks]),
        points=np.concatenate([marks.points for marks in landmarks]),
        camera=np.array([getattr(camera, name) for name in _CAMERA], float),
    )


class StoredPlaces:
    """The places of all cells, in memory: about 45 KB a view, whatever else the map holds.

    Args:
        store: the map.
        camera: of the views that are looked up.
        near: only views from near a position.

    Raises:
        ConfigError: the places were seen by another camera.
    """

    def __init__(
        self, store: GridStore, camera: Camera, settings: PlaceSettings | None = None, near: Near | None = None
    ) -> None:
        self.damage: list[str] = []
        """What is wrong with parts that were left out."""
        parts = []
        for key in store.cells():
            if PLACES in store.cell(key).parts:
                try:
                    parts.append((key, _arrays(store, key)))
                except FormatError as error:
                    self.damage.append(str(error))
        for key, arrays in parts:
            _check_camera(store, key, arrays["camera"], camera)
        if near is not None:
            axes = store.settings.axes
            parts = [(key, _choose(held, near.allows(held["poses"][:, :3, 3], axes))) for key, held in parts]
        merged = {name: np.concatenate([arrays[name] for _, arrays in parts]) for name in _NAMES[:5]} if parts else {}
        self.T_world_camera: np.ndarray = merged.pop("poses", np.zeros((0, 4, 4)))
        """Of each view, float64 [k, 4, 4]."""
        # Views are not told to be next in time: numbers two apart support nobody.
        numbers = 2 * np.arange(len(self.T_world_camera), dtype=np.int32)
        if parts:
            self.index = PlaceIndex.from_arrays(camera, {**merged, "numbers": numbers}, settings)
        else:
            self.index = PlaceIndex(camera, settings)

    def __len__(self) -> int:
        return len(self.index)

    def describe(self, view: FeatureView) -> Place:
        """What a view is known by."""
        return self.index.describe(view)

    def query(self, place: Place, count: int) -> list[tuple[PlaceMatch, StoredView]]:
        """The views most like a place, the likeliest first, `count` at most."""
        return [
            (match, StoredView(self.index[match.number], self.T_world_camera[match.number // 2]))
            for match in self.index.query(place, count)
        ]


def stored_views(store: GridStore, key: CellKey, camera: Camera) -> list[StoredView]:
    """The views of one cell that has them.

    Raises:
        FormatError: the part is damaged.
        ConfigError: another camera saw them.
    """
    arrays = _arrays(store, key)
    _check_camera(store, key, arrays["camera"], camera)
    numbers = np.arange(len(arrays["poses"]), dtype=np.int32)
    index = PlaceIndex.from_arrays(camera, {**arrays, "numbers": numbers})
    return [StoredView(index[number], T) for number, T in enumerate(arrays["poses"])]


def _arrays(store: GridStore, key: CellKey) -> Mapping[str, np.ndarray]:
    return arrays_of_places(store.get(key, PLACES), f"{store.path}: cell {key}: {PLACES}")


def arrays_of_places(data: bytes, where: str) -> Mapping[str, np.ndarray]:
    """The arrays of the part `PLACES`. Raises FormatError if it is damaged; begins with `where`."""
    arrays = arrays_of(io.BytesIO(data), f"{where}: damaged", lambda held: {name: held[name] for name in _NAMES})
    check_arrays(arrays, _FORMS, f"{where}: damaged")
    if int(arrays["counts"].astype(np.int64).sum()) != len(arrays["points"]):
        raise FormatError(f"{where}: damaged: its landmarks do not fit their numbers")
    return arrays


def _choose(arrays: Mapping[str, np.ndarray], views: np.ndarray) -> Mapping[str, np.ndarray]:
    """The arrays of a cell with these views alone, bool [k]."""
    landmarks = np.repeat(views, arrays["counts"])
    rows = {"poses": views, "counts": views, "codes": views, "descriptors": landmarks, "points": landmarks}
    return {name: arrays[name][kept] for name, kept in rows.items()}


def _check_camera(store: GridStore, key: CellKey, found: np.ndarray, camera: Camera) -> None:
    expected = np.array([getattr(camera, name) for name in _CAMERA], float)
    if (np.abs(found - expected) > StoredPlaceTuning.same_camera * camera.width).any():
        seen, own = (f"{int(c[0])}x{int(c[1])} pixels, fx {c[2]:.1f}" for c in (found, expected))
        raise ConfigError(
            f"{store.path}: cell {key}: its places were seen by a camera of {seen}, the images have {own}; see `scale`"
        )
