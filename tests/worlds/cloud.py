# SPDX-License-Identifier: Apache-2.0
"""The full map of a generated world: points spread evenly over every surface that can be seen, with their normals."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from worlds.world import World, spread

TILE = 10.0
"""Edge of the squares that are sampled one by one, metres."""
_ABOVE = 1e-3
"""Metres above a surface that must be free for it to be seen."""


def world_cloud(world: World, spacing: float = 0.1, seed: int = 0) -> np.ndarray:
    """Points of all surfaces, float32 [N, 3], about one per `spacing` x `spacing` metres, on the surface itself.

    A world of 100 x 100 m has about 4 to 5 million at 0.1 m. `cloud_tiles` gives the same points piece by piece.
    """
    return np.concatenate([points for points, _ in cloud_tiles(world, spacing, seed)])


def cloud_tiles(world: World, spacing: float = 0.1, seed: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The points of `cloud` and their outward normals, float32 [n, 3] each, tile by tile.

    A tile has the floor and ceiling of its square and the boxes whose centre is in it, which may reach out of it.

    Args:
        spacing: metres between neighbouring points; a face has at least one.
        seed: of their places; each tile has its own random numbers.
    """
    count = int(np.ceil(world.size / TILE))
    column, row = np.clip((world.boxes[:, :2] // TILE).astype(np.int64), 0, count - 1).T
    number = row * count + column
    order = np.argsort(number, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=count**2))])
    for tile in range(count**2):
        rng = np.random.default_rng([world.seed, seed, 9, tile])
        faces = [_box_faces(world.boxes[order[start[tile] : start[tile + 1]]]), _level_faces(world, tile, count)]
        points, normals = _sample(np.concatenate(faces), spacing, rng)
        seen = _free(world, points + _ABOVE * normals)
        yield points[seen].astype(np.float32), normals[seen].astype(np.float32)


def _box_faces(boxes: np.ndarray) -> np.ndarray:
    """The six faces of boxes [n, 7] as centre, first and second half edge and normal, float64 [6 n, 4, 3]."""
    cosine, sine = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    zero = np.zeros(len(boxes))
    axes = np.stack([np.stack(a, 1) for a in ((cosine, sine, zero), (-sine, cosine, zero), (zero, zero, zero + 1))], 1)
    edges = axes * boxes[:, 3:6, None]
    faces = [
        np.stack([boxes[:, :3] + sign * edges[:, k], edges[:, k - 2], edges[:, k - 1], sign * axes[:, k]], 1)
        for k in range(3)
        for sign in (-1, 1)
    ]
    return np.concatenate(faces)


def _level_faces(world: World, tile: int, count: int) -> np.ndarray:
    """Floor and ceiling of a tile, float64 [2, 4, 3] as in `_box_faces`."""
    low = np.array(divmod(tile, count)[::-1]) * TILE
    half = (np.minimum(low + TILE, world.size) - low) / 2
    x, y = low + half
    edges = [(half[0], 0.0, 0.0), (0.0, half[1], 0.0)]
    return np.array([[(x, y, 0.0), *edges, (0.0, 0.0, 1.0)], [(x, y, world.height), *edges, (0.0, 0.0, -1.0)]])


def _sample(faces: np.ndarray, spacing: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A point at random in each field of a lattice over each face: points and normals, float64 [n, 3]."""
    across, down = np.maximum(np.rint(2 * np.linalg.norm(faces[:, 1:3], axis=2) / spacing), 1).astype(np.int64).T
    face, index = spread(across * down)
    u, v = rng.random((2, len(face)))
    u = 2 * (index % across[face] + u) / across[face] - 1
    v = 2 * (index // across[face] + v) / down[face] - 1
    return faces[face, 0] + u[:, None] * faces[face, 1] + v[:, None] * faces[face, 2], faces[face, 3]


def _free(world: World, points: np.ndarray) -> np.ndarray:
    """Whether points [n, 3] are within the world and in no box."""
    high = np.array([world.size, world.size, world.height])
    return ((points > 0) & (points < high)).all(1) & ~world.inside(points)
