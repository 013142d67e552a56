# SPDX-License-Identifier: Apache-2.0
"""The mesh of a TSDF whose cells are all on disk, made of a few cells at a time and kept there, too.

First each box of cells is meshed and its vertices are numbered; those that triangles of other boxes have, too, are
known by their bits until all boxes around are done. Pieces that go on in other boxes are joined there. When all sizes
are known, what belongs to small pieces is left out and the rest gets its final numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ggslam.scene.arrays import arrays_to_bytes, read_arrays
from ggslam.system.atomic import write_bytes
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_boxes import boxes_of, in_memory
from ggslam.volumes.cell_pager import CellPager
from ggslam.volumes.mesh import Mesh, extract_mesh, pieces_of
from ggslam.volumes.mesh_parts import MeshPart, MeshParts
from ggslam.volumes.tsdf import SIDE, TsdfMap
from ggslam.volumes.volume_cells import CellKey, with_neighbours

_CONTENT = "part of a mesh"
_MESH = ("vertices", "normals", "colors", "labels", "triangles")


class CellMeshTuning(Tuning):
    """How much is in memory at a time."""

    side = 4
    """Cells along an edge of the box that is meshed at a time; those around it are in memory, too."""


def mesh_cells(pager: CellPager, min_weight: float | None, min_triangles: int) -> MeshParts:
    """The surface of all cells: the triangles that `extract_mesh` makes of everything at once, in another order. No
    vertex is there twice.

    Args:
        pager: all of whose cells are on disk; the parts lie beside them.
        min_weight: see `extract_mesh`.
        min_triangles: connected pieces of fewer triangles are left out.
    """
    folder = Path(mkdtemp(prefix="mesh-", dir=pager.folder))
    numbering = _Numbering()
    for box, own in boxes_of(pager.keys(), CellMeshTuning.side):
        part = in_memory(pager, with_neighbours(own, 1) & pager.keys())
        mesh, shared = _triangles_of(part, own, pager, min_weight)
        _write(folder, numbering.boxes, *numbering.add(box, mesh, shared))
    return _without_specks(folder, numbering, max(min_triangles, 1))


# --- triangles --------------------------------------------------------------------------------------------------------


def _triangles_of(
    part: TsdfMap, own: set[CellKey], pager: CellPager, min_weight: float | None
) -> tuple[Mesh, np.ndarray]:
    """Those of cells `own`: a cube of marching cubes belongs to the block of its lowest corner; and which of their
    vertices others have, too, bool [V]."""
    mesh, voxel = extract_mesh(part, min_weight), part.settings.voxel
    middles = mesh.vertices[mesh.triangles].astype(np.float64).mean(1) - part.origin
    blocks = np.floor(np.floor(middles / voxel - 0.5) / SIDE).astype(np.int64)
    keys = map(tuple, pager.cells.keys_of(blocks).tolist())
    chosen = np.fromiter((key in own for key in keys), bool, len(blocks))
    used, by_others = np.zeros((2, len(mesh.vertices)), bool)
    used[mesh.triangles[chosen]] = True
    by_others[mesh.triangles[~chosen]] = True
    return mesh.part(chosen), by_others[used]


# --- numbers ---------------------------------------------------------------------------------------------------------


@dataclass
class _Numbering:
    """Numbers of vertices and pieces over all boxes.

    Attributes:
        boxes, vertices: so far.
        joins: pairs of pieces that go on in each other.
        triangles: of each piece, in its box.
        seams: number and piece of shared vertices by their bits, of boxes that others are still to come around.
    """

    boxes: int = 0
    vertices: int = 0
    joins: set[tuple[int, int]] = field(default_factory=set)
    triangles: list[int] = field(default_factory=list)
    seams: dict[CellKey, dict[bytes, tuple[int, int]]] = field(default_factory=dict)

    def add(self, box: CellKey, mesh: Mesh, shared: np.ndarray) -> tuple[MeshPart, np.ndarray]:
        """The mesh of a box with numbers, and the piece of each of its vertices.

        Args:
            box: later than those before, in the order of tuples.
            mesh: its triangles.
            shared: which of its vertices other boxes have, bool [V].
        """
        count, of_vertex = pieces_of(mesh)
        pieces = len(self.triangles) + of_vertex
        numbers, first = np.empty(len(mesh.vertices), np.int64), np.ones(len(mesh.vertices), bool)
        rows = np.flatnonzero(shared)
        names = [row.tobytes() for row in mesh.vertices[rows] + 0.0]  # + 0: -0 and 0 are the same
        around = {name: at for other in self._around(box) for name, at in self.seams[other].items()}
        for row, name in zip(rows.tolist(), names, strict=True):
            if name in around:
                numbers[row], first[row] = around[name][0], False
                self.joins.add((int(pieces[row]), around[name][1]))
        numbers[first] = self.vertices + np.arange(np.count_nonzero(first))
        self.vertices += int(np.count_nonzero(first))
        self.seams[box] = {
            name: (int(numbers[row]), int(pieces[row]))
            for row, name in zip(rows.tolist(), names, strict=True)
            if first[row]
        }
        self.triangles += np.bincount(of_vertex[mesh.triangles[:, 0]], minlength=count).tolist()
        self.boxes += 1
        return MeshPart(mesh, numbers, first), pieces

    def _around(self, box: CellKey) -> list[CellKey]:
        """The boxes that have seams with this one; forgets those that no later one can have seams with."""
        for other in [other for other in self.seams if (other[0] + 1, other[1] + 1, other[2] + 1) < box]:
            del self.seams[other]
        return [other for other in self.seams if all(abs(a - b) <= 1 for a, b in zip(other, box, strict=True))]

    def large(self, min_triangles: int) -> np.ndarray:
        """Whether each of the pieces belongs to one of so many triangles in all, bool [pieces]."""
        if not self.triangles:
            return np.zeros(0, bool)
        rows, columns = np.array(sorted(self.joins), np.int64).reshape(-1, 2).T
        links = coo_array((np.ones(len(rows), bool), (rows, columns)), (len(self.triangles),) * 2)
        whole = connected_components(links, directed=False)[1]
        return np.bincount(whole, self.triangles)[whole] >= min_triangles


# --- files -----------------------------------------------------------------------------------------------------------


def _write(folder: Path, number: int, part: MeshPart, pieces: np.ndarray) -> None:
    arrays = {name: getattr(part.mesh, name) for name in _MESH}
    data = arrays_to_bytes(**arrays, numbers=part.numbers, first=part.first, pieces=pieces)
    write_bytes(folder / f"{number}.npz", data)


def _parts(folder: Path, count: int, large: np.ndarray) -> Iterator[tuple[MeshPart, np.ndarray]]:
    """Each part without small pieces, and the numbers of the vertices that it is the first to have and that go."""
    for number in range(count):
        *mesh, numbers, first, pieces = read_arrays(
            folder / f"{number}.npz", _CONTENT, *_MESH, "numbers", "first", "pieces"
        )
        part, stays = MeshPart(Mesh(*mesh), numbers, first), large[pieces]
        yield part.part(stays[part.mesh.triangles[:, 0]]), numbers[first & ~stays]


def _without_specks(folder: Path, numbering: _Numbering, min_triangles: int) -> MeshParts:
    """The parts of all boxes, without small pieces."""
    large, count = numbering.large(min_triangles), numbering.boxes
    objects: set[int] = set()
    gone = [np.zeros(0, np.int64)]
    for part, lost in _parts(folder, count, large):
        objects |= set(part.mesh.objects())
        gone.append(lost)
    dropped = np.concatenate(gone)  # in order

    def read() -> Iterator[MeshPart]:
        for part, _ in _parts(folder, count, large):
            yield replace(part, numbers=part.numbers - np.searchsorted(dropped, part.numbers))

    triangles = int(np.array(numbering.triangles, np.int64)[large].sum())
    return MeshParts(read, numbering.vertices - len(dropped), triangles, sorted(objects))
