# SPDX-License-Identifier: Apache-2.0
"""Grid stores made of what there is: a run, a cloud, or a recording whose poses are known."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import FormatError, RunFolderError
from ggslam.formats.cloud_files import NOT_READ, SUFFIXES, read_cloud_file
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, arrays_of_map, gaussians_to_bytes
from ggslam.jobs.submaps.visit_records import remember_run
from ggslam.localization.places import PLACES, StoredView, stored_places_to_bytes
from ggslam.localization.surface import NORMAL
from ggslam.loops.places import Place, PlaceIndex
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import fingerprint
from ggslam.runs.starting import arrays_with_prefix, camera_of
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import transform_points
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.submaps.cell_keys import CellKey, partition
from ggslam.submaps.cell_points import POINTS
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.array_forms import PoseForm, check_arrays
from ggslam.system.tuning import Tuning
from ggslam.tracking.surface import check_surface_arrays
from ggslam.volumes.octomap_files import read_octomap

INDOORS = SubmapSettings(voxel=0.02)
"""For maps of depth cameras."""
OCTOMAP = ".bt"


class StoreMakingTuning(Tuning):
    """How a store is filled."""

    max_voxels = 5e7
    """Most occupied voxels that are read from a file."""
    cells_at_once = 64
    """Cells that are written in one step."""


def is_store(path: Path) -> bool:
    """Whether a folder is a grid store."""
    return (path / "index.sqlite").is_file()


def is_cloud(path: Path) -> bool:
    """Whether a path names a cloud, by its suffix; one of a kind that is not read included."""
    return path.suffix.lower() in (*SUFFIXES, *NOT_READ, OCTOMAP) and not path.is_dir()


def cloud_voxel(path: Path) -> float:
    """How far apart the points of a cloud are by its own word, metres: the voxels of an OctoMap; 0: nothing is told.

    Raises:
        FormatError: the file is missing or damaged.
    """
    return read_octomap(path).resolution if path.suffix.lower() == OCTOMAP else 0.0


def settings_of_store(path: Path) -> SubmapSettings:
    """Those that the store of a folder was made with; the defaults if there is none."""
    if not is_store(path):
        return SubmapSettings()
    with GridStore.open(path) as store:
        return store.settings


def open_or_create(path: Path, settings: SubmapSettings) -> GridStore:
    """The store of a folder, open for writing; a new one if there is none.

    Raises:
        ConfigError: the store has another grid.
        RunFolderError: another process writes to it, or the folder is something else.
    """
    return GridStore.open(path, write=True, settings=settings) if is_store(path) else GridStore.create(path, settings)


def store_of_run(
    run: Path, store: GridStore, visit: str | None = None, at: float | None = None, replaced: Collection[str] = (),
) -> None:  # fmt: skip
    """Writes what a run knows into the cells of a store: the surface that its keyframes measured (or, of a run without
    places, the cloud sampled from its map), its Gaussians, and its places.

    Cells that were recorded less than T before are left alone, unless the run takes the place of earlier visits.

    Args:
        run: folder of the run; the store's world is the run's.
        store: open for writing.
        visit: name of the visit; None: a name made of the run's content.
        at: time of the visit in seconds; None: that of the run's last frame.
        replaced: visits whose latest state the run shows: what they wrote goes, whenever it was.

    Raises:
        RunFolderError: no run, or files of it are damaged.
    """
    folder = RunFolder.open(run)
    time = float(folder.trajectory().timestamps[-1]) if at is None else at
    store.begin_visit(visit or visit_of(folder))
    remember_run(store, folder)
    arrays: dict[str, Any] = {}
    if (folder.path / PLACES_FILE).is_file():
        arrays = read_all_arrays(folder.path / PLACES_FILE, "the places of a run")
    try:
        points, attributes = _surface(arrays) if arrays else read_cloud(folder.path / "points.ply")
        views, camera = _views(arrays) if arrays else ([], None)
    except (KeyError, ValueError, IndexError, TypeError, FormatError) as error:
        if not arrays:
            raise
        reason = f"lacks {error}" if isinstance(error, KeyError) else error
        raise RunFolderError(f"{folder.path / PLACES_FILE}: not the places of a run: {reason}") from None
    others = list(_gaussian_parts(store, folder.gaussians()))
    if camera is not None:
        others += _place_parts(store, views, camera)
    due = _Due(store, np.inf if replaced else time)
    earlier = [key for key in store.cells() if store.cell(key).visit in replaced] if replaced else []
    others, kept = [write for write in others if due[write.key]], due.of(points)
    # The points come last: they make a cell new, and one that was cut off before is written again by the next attempt.
    for begin in range(0, len(others), StoreMakingTuning.cells_at_once):
        _put(store, others[begin : begin + StoreMakingTuning.cells_at_once])
    store_cloud(store, points[kept], {name: values[kept] for name, values in attributes.items()}, time)
    if not earlier:
        return
    held = {GAUSSIANS: {w.key for w in others if GAUSSIANS in w.parts}, POINTS: _cells(store, points)}
    for key in earlier:
        for part in [name for name, cells in held.items() if name in store.cell(key).parts and key not in cells]:
            store.remove_part(key, part)


def _cells(store: GridStore, points: np.ndarray) -> set[CellKey]:
    finite = points[np.isfinite(points).all(1)]
    return {(x, y, z) for x, y, z in np.unique(store.grid.keys_of(finite), axis=0).tolist()}


def visit_of(folder: RunFolder) -> str:
    """The visit that the content of a run is stored under."""
    return f"run {fingerprint(folder)[:16]}"


Cloud = tuple[np.ndarray, dict[str, np.ndarray]]
"""Points [n, 3], and attributes [n, ...] by name."""


def store_of_cloud(
    path: Path, store: GridStore, visit: str | None = None, at: float | None = None, columns: int | None = None,
    cloud: Cloud | None = None,
) -> None:  # fmt: skip
    """Cuts a cloud into the cells of a store; `columns`: see `read_cloud_file`; `cloud`: the file's, if it was read.

    Raises:
        FormatError: the file is missing or damaged.
    """
    store.begin_visit(visit or path.name)
    points, attributes = read_cloud(path, columns) if cloud is None else cloud
    due = _Due(store, at or 0.0).of(points)
    store_cloud(store, points[due], {name: values[due] for name, values in attributes.items()}, at or 0.0)


class _Due(dict[tuple[int, int, int], bool]):
    """Which cells are to be recorded now; asks the store once a cell."""

    def __init__(self, store: GridStore, time: float) -> None:
        super().__init__()
        self._store, self._time = store, time

    def __missing__(self, key: tuple[int, int, int]) -> bool:
        self[key] = self._store.due(key, self._time)
        return self[key]

    def of(self, points: np.ndarray) -> np.ndarray:
        """Whether the cells of points [n, 3] are, bool [n]; false for those that are not finite."""
        finite = np.nonzero(np.isfinite(points).all(1))[0]
        keys, which = np.unique(self._store.grid.keys_of(points[finite]), axis=0, return_inverse=True)
        due = np.zeros(len(points), bool)
        due[finite] = np.array([self[x, y, z] for x, y, z in keys.tolist()], bool)[which.reshape(-1)]
        return due


def _put(store: GridStore, writes: list[CellWrite]) -> None:
    """Writes parts of cells, each cell's together."""
    merged: dict[tuple[int, int, int], CellWrite] = {}
    for write in writes:
        before = merged.get(write.key)
        if before is not None:
            write = replace(write, parts={**before.parts, **write.parts}, counts={**before.counts, **write.counts})
        merged[write.key] = write
    store.put_cells(list(merged.values()))


def read_cloud(path: Path, columns: int | None = None) -> Cloud:
    """A cloud as cells keep it; `columns`: see `read_cloud_file`.

    Raises:
        FormatError: the file is missing or damaged.
    """
    if path.suffix.lower() == OCTOMAP:
        return _octomap(path), {}
    cloud = read_cloud_file(path, columns)
    return cloud.points, {} if cloud.colors is None else {"color": cloud.colors}


def _octomap(path: Path) -> np.ndarray:
    """Centres [n, 3] of the occupied voxels, leaves of several voxels cut into them."""
    occupancy = read_octomap(path)
    centres, sizes = occupancy.occupied_centers()
    if not len(centres):
        raise FormatError(f"{path}: no voxel of it is occupied")
    edge = occupancy.resolution
    found = []
    voxels = float((np.rint(sizes.astype(np.float64) / edge) ** 3).sum())
    if voxels > StoreMakingTuning.max_voxels:
        raise FormatError(f"{path}: {voxels:.3g} voxels are occupied, {StoreMakingTuning.max_voxels:g} are taken")
    for size in np.unique(sizes):
        across = max(1, round(float(size) / edge))
        steps = (np.arange(across) - (across - 1) / 2) * edge
        cube = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
        found.append((centres[sizes == size].astype(np.float64)[:, None] + cube).reshape(-1, 3))
    return np.concatenate(found)


def _surface(arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """World points [n, 3] of the keyframes' surface as places.npz has it, with normals."""
    held = arrays_with_prefix(arrays, "surface_")
    check_surface_arrays(held)
    ends = np.cumsum(held["counts"])[:-1]
    each = (np.split(held["points"], ends), np.split(held["normals"], ends), held["reach"], held["poses"])
    parts = zip(*each, strict=True)
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3), np.int8)]
    for steps, turned, reach, T in parts:
        points.append(transform_points(steps * (float(reach) / 32767), T))
        normals.append(np.rint(turned @ T[:3, :3].T).astype(np.int8))
    return np.concatenate(points), {NORMAL: np.concatenate(normals)}


def _views(arrays: Mapping[str, np.ndarray]) -> tuple[list[StoredView], Camera]:
    camera, held = camera_of(arrays["camera"]), arrays_with_prefix(arrays, "loops_places_")
    index, numbers = PlaceIndex.from_arrays(camera, held), held["numbers"].tolist()
    check_arrays(arrays, {"loops_poses": PoseForm("float", None)}, "loops")
    places: list[Place] = [index[number] for number in numbers]
    return [StoredView(place, arrays["loops_poses"][n]) for place, n in zip(places, numbers, strict=True)], camera


def _place_parts(store: GridStore, views: list[StoredView], camera: Camera) -> Iterator[CellWrite]:
    positions = np.array([view.T_world_camera[:3, 3] for view in views]).reshape(-1, 3)
    for key, indices in partition(positions, store.grid):
        data = stored_places_to_bytes([views[i] for i in indices.tolist()], camera)
        yield CellWrite(key, {PLACES: data}, counts={PLACES: len(indices)})


def _gaussian_parts(store: GridStore, gaussians: GaussianMap) -> Iterator[CellWrite]:
    arrays = arrays_of_map(gaussians)
    for key, indices in partition(arrays["means"], store.grid):
        data = gaussians_to_bytes({name: values[indices] for name, values in arrays.items()}, store.visit)
        yield CellWrite(key, {GAUSSIANS: data}, counts={GAUSSIANS: len(indices)})
