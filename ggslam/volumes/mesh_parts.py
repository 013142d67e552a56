# SPDX-License-Identifier: Apache-2.0
"""A mesh that comes in parts, so that it can be written and drawn without ever being in memory as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ggslam.volumes.mesh import Mesh, empty_mesh


@dataclass(frozen=True)
class MeshPart:
    """Some triangles of a mesh.

    Attributes:
        mesh: the triangles, with all vertices that they have.
        numbers: int64 [V], rows of its vertices in the whole mesh.
        first: bool [V], which vertices no earlier part has; in the whole mesh they follow each other.
    """

    mesh: Mesh
    numbers: np.ndarray
    first: np.ndarray

    def part(self, chosen: np.ndarray) -> MeshPart:
        """Some of the triangles (bool [F]) and their vertices."""
        used = np.zeros(len(self.numbers), bool)
        used[self.mesh.triangles[chosen]] = True
        return MeshPart(self.mesh.part(chosen), self.numbers[used], self.first[used])


class MeshParts:
    """A mesh in parts.

    Args:
        read: gives the parts, in order, as often as it is called.
        vertices, triangles: how many there are.
        objects: that have triangles, in order.
    """

    def __init__(
        self, read: Callable[[], Iterator[MeshPart]], vertices: int, triangles: int, objects: list[int]
    ) -> None:
        self._read, self.vertices, self.triangles, self.objects = read, vertices, triangles, objects

    @staticmethod
    def of(mesh: Mesh) -> MeshParts:
        """A mesh that is in memory, as one part."""
        count = len(mesh.vertices)
        part = MeshPart(mesh, np.arange(count), np.ones(count, bool))
        return MeshParts(lambda: iter([part]), count, len(mesh.triangles), mesh.objects())

    def __iter__(self) -> Iterator[MeshPart]:
        return self._read()

    def apply(self, change: Callable[[Mesh], Mesh]) -> MeshParts:
        """The same with each part changed by a function that leaves vertices and triangles in their order."""
        return MeshParts(
            lambda: (replace(part, mesh=change(part.mesh)) for part in self), self.vertices, self.triangles,
            self.objects,
        )  # fmt: skip

    def sample(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and normals [n, 3] of every so manieth vertex: of all, if that is no more than `most`."""
        step = max(1, -(-self.vertices // most))
        chosen = [(part.mesh, part.first & (part.numbers % step == 0)) for part in self]
        none = empty_mesh()
        return (
            np.concatenate([none.vertices, *(mesh.vertices[rows] for mesh, rows in chosen)]),
            np.concatenate([none.normals, *(mesh.normals[rows] for mesh, rows in chosen)]),
        )

    def of_object(self, label: int) -> Mesh:
        """The triangles of one object (0: of none) and their vertices, in memory."""
        return join_parts(part.part(part.mesh.triangle_labels() == label) for part in self)

    def whole(self) -> Mesh:
        """All of it in memory."""
        return join_parts(self)


def join_parts(parts: Iterable[MeshPart]) -> Mesh:
    """Parts of a mesh as one, with vertices in the order of their numbers."""
    held = list(parts)
    if not held:
        return empty_mesh()
    if len(held) == 1:
        return held[0].mesh
    numbers = np.concatenate([part.numbers for part in held])
    used, first = np.unique(numbers, return_index=True)
    triangles = [np.searchsorted(used, part.numbers)[part.mesh.triangles].astype(np.int32) for part in held]
    vertices, normals, colors, labels = (
        np.concatenate([getattr(part.mesh, name) for part in held])[first]
        for name in ("vertices", "normals", "colors", "labels")
    )
    return Mesh(vertices, normals, colors, labels, np.concatenate(triangles))
