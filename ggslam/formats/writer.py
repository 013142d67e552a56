# SPDX-License-Identifier: Apache-2.0
"""What a format declares to be written: its name, its suffixes, what it takes and how it writes.

    WRITER = Writer(
        "splat", (".splat",), Takes.GAUSSIANS, "the same in 32 bytes a Gaussian", _write
    )

A new format is one file with such a writer and one line in `formats.table`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.point_sampling import MapPart
from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.plurals import quantity


class Takes(Enum):
    """What of a run a format is made from, and what its writer is given."""

    GAUSSIANS = "Gaussians"  # Splats
    OBJECT_COLORS = "Gaussians in the colours of their objects"  # Splats
    MESH = "a mesh"  # SurfaceMesh
    POINTS = "points"  # SurfacePoints
    TRAJECTORY = "a trajectory"  # Trajectory
    VIEWS = "images with poses"  # PosedViews


@dataclass(frozen=True)
class Splats:
    """Gaussians to write, which need not be in memory.

    Attributes:
        count: how many.
        like: a map with their channels, of any size.
        parts: gives them in the order of the file, one part in memory at a time.
        whole: gives them in memory, without optimizer state.
        cells: gives the same in boxes of space.
        names: of objects by id, empty where one has none; None: ids of objects are not written.
        classifier: gives that of their identities, to be written with them; None: identities are not written.
        note: what a user should know of them, to be put behind their number.
        done: is told how many of how many cells are written, 0 at first.
    """

    count: int
    like: GaussianMap
    parts: Callable[[], Iterator[GaussianMap]]
    whole: Callable[[], GaussianMap]
    cells: Callable[[], Sequence[MapPart]]
    names: Mapping[int, str] | None = None
    classifier: Callable[[], IdentityClassifier] | None = None
    note: str = ""
    done: Callable[[int, int], None] = field(default=lambda done, of: None)

    @staticmethod
    def of(gaussians: GaussianMap, names: Mapping[int, str] | None = None) -> Splats:
        """A map in memory."""
        parts = [gaussians]
        return Splats(
            len(gaussians), gaussians, lambda: iter(parts), lambda: gaussians, lambda: [MapPart.of(gaussians)], names
        )

    def text(self, path: Path, with_ids: bool = False, size: int | None = None) -> str:
        """What was written into a file, for people; `size` is in bytes, None: the file's."""
        size = path.stat().st_size if size is None else size
        ids = "" if self.names is None or not with_ids else f" with the ids of {quantity(len(self.names), 'object')}"
        return f"wrote {path}: {quantity(self.count, 'Gaussian')}{self.note}{ids}, {size / 1e6:.1f} MB"


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles to write; arguments of `mesh_files.write_mesh`, and what they were made from, for people."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    labels: np.ndarray | None = None
    names: Mapping[int, str] | None = None
    z_up: bool = False
    objects: int = 0
    origin: str = "triangles"

    def text(self, path: Path) -> str:
        """What was written into a file, for people."""
        size = f"{quantity(len(self.vertices), 'vertex', 'vertices')}, {quantity(len(self.triangles), 'triangle')}"
        return f"wrote {path}: {size}, {quantity(self.objects, 'object')}, from {self.origin}"


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a grid of `voxel_size` metres to write: clouds, at least one, each in memory only while it is
    written."""

    voxel_size: float
    clouds: Iterator[VoxelCloud]


@dataclass(frozen=True)
class PosedView:
    """A frame to write: index in the run, float64 [4, 4] pose, whether it was kept away from training, camera."""

    index: int
    T_world_camera: np.ndarray
    held_out: bool
    camera: Camera

    @property
    def name(self) -> str:
        """Of the image's file."""
        return f"frame_{self.index:06d}.png"


@dataclass(frozen=True)
class PosedViews:
    """Images with poses to write.

    Attributes:
        save: writes the frames one by one into folders of images and of depth (None: without depth), each `name`, and
            gives those that could be read.
        cloud: points of the surface.
    """

    save: Callable[[Path, Path | None], list[PosedView]]
    cloud: VoxelCloud

    @staticmethod
    def text(views: Sequence[PosedView]) -> str:
        """What was written, for people."""
        held_out = sum(view.held_out for view in views)
        sizes = dict.fromkeys(f"{view.camera.width}x{view.camera.height}" for view in views)
        return f"{quantity(len(views), 'image')} of {', '.join(sizes)} ({held_out} held out)"


@dataclass(frozen=True)
class Writer:
    """A format that maps are exported to.

    Attributes:
        name: of the format.
        endings: of its files' names; one without a leading dot is a whole name. Without any, the format is a folder.
        takes: what it is made from.
        text: what it is for, in a few words.
        write: writes that into a file or folder; returns a line that says what was written. Its folder exists.
        any_name: files with other endings are written, too, if the format is asked for.
        by_object: objects can be chosen.
        y_up: files have y upwards, so that a map is turned by 180 degrees about x.
        in_cells: maps are written cell by cell, so that those of a grid store can be.
        check: tells before the work whether a file of this name can be written; raises MissingDependency, FormatError.
    """

    name: str
    endings: tuple[str, ...]
    takes: Takes
    text: str
    write: Callable[[Path, Any], str]
    any_name: bool = False
    by_object: bool = False
    y_up: bool = False
    in_cells: bool = False
    check: Callable[[Path], object] | None = None

    def longest_ending(self, path: Path) -> str:
        """The longest of its endings that a name has; empty: none."""
        name = path.name.lower()
        return max((e for e in self.endings if name == e or (e[0] == "." and name.endswith(e))), key=len, default="")

    def check_path(self, path: Path) -> None:
        """Raises FormatError or MissingDependency if it cannot write a file of this name."""
        if self.endings and not self.any_name and not self.longest_ending(path):
            suffixes = ", ".join(e for e in self.endings if e[0] == ".")
            other = "".join(f", or is called {e}" for e in self.endings if e[0] != ".")
            raise FormatError(f"{path}: a file of the format {self.name} ends in {suffixes}{other}")
        if self.check is not None:
            self.check(path)
