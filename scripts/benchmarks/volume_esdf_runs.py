# SPDX-License-Identifier: Apache-2.0
"""The distance field: updates against computing anew and against the plain libraries' transforms, queries, memory, and
accuracy on scenes with known distances. A part of bench_volumes.py."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from ggslam.native.loader import NativeContext
from ggslam.sequences import open_sequence
from ggslam.volumes.esdf import DistanceField, FieldSettings, UpdateStats
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, SIDE, VOXELS, TsdfMap
from ggslam.volumes.volume_settings import VolumeSettings

QUERIES = 2_000_000
Scene = Callable[[np.ndarray], np.ndarray]
"""Signed distances [N] of points [N, 3], metres, positive in free space."""


@dataclass(frozen=True)
class DenseGrid:
    """A map as arrays over the box of its blocks, [z, y, x].

    Attributes:
        origin: [3], voxel (0, 0, 0) in voxels (x, y, z).
        known: bool, seen.
        free: bool, seen and in front of surfaces.
        surface: bool, has a surface point of the field.
    """

    origin: np.ndarray
    known: np.ndarray
    free: np.ndarray
    surface: np.ndarray


def dense_grid(tsdf: TsdfMap, surface: np.ndarray) -> DenseGrid:
    """The map on a grid, with surface points [S, 3] in metres."""
    blocks = tsdf.blocks().coordinates
    low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
    voxels = tsdf.read(blocks)

    def spread(values: np.ndarray) -> np.ndarray:
        grid = np.zeros((*(high - low)[::-1], SIDE, SIDE, SIDE), bool)
        grid[tuple((blocks - low).T[::-1])] = values.reshape(-1, SIDE, SIDE, SIDE)
        return np.ascontiguousarray(grid.transpose(0, 3, 1, 4, 2, 5)).reshape((high - low)[::-1] * SIDE)

    known = spread(voxels.weight > 0)
    occupied = np.zeros(known.shape, bool)
    cells = np.floor(surface / tsdf.settings.voxel).astype(int) - low * SIDE
    occupied[tuple(cells.T[::-1])] = True
    return DenseGrid(low * SIDE, known, spread((voxels.weight > 0) & (voxels.value >= 0)), occupied)


def edt_distance(grid: DenseGrid, threads: int) -> np.ndarray | None:
    """Signed distance in voxels with the package `edt`, what is not free taken for obstacle; the surface is put half
    way between voxels. None if the package is not there."""
    try:
        import edt
    except ImportError:
        return None
    distance = edt.sdf(grid.free, parallel=threads)
    return distance - np.where(distance > 0, 0.5, -0.5).astype(np.float32)


def scipy_distance(grid: DenseGrid) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance in voxels from the nearest voxel with a surface point, and the gradient [z, y, x, 3]."""
    distance, nearest = distance_transform_edt(~grid.surface, return_indices=True)
    gradient = np.stack(np.indices(grid.surface.shape, np.int32) - nearest, -1)[..., ::-1]
    sign = np.where(grid.free, 1.0, -1.0)
    return distance * sign, gradient * (sign / np.maximum(distance, 1e-9))[..., None]


def seconds_of(call: Callable[[], object], repeats: int) -> float:
    """The shortest of some calls."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


# --- a recording, fused frame by frame -------------------------------------------------------------------------------


def esdf_part(
    recording: Path,
    voxels: tuple[float, ...] = (0.08, 0.04, 0.02),
    every: int = 5,
    frames: int | None = None,
    threads: int | None = None,
) -> None:
    """Prints, for each voxel size, what updates every few frames cost against computing anew, and against `edt` and
    scipy on the same grid; then queries and memory."""
    print(f"distance field, {recording.name}, an update every {every} frames, up to {FieldSettings().max_distance:g} m")
    for voxel in voxels:
        tsdf = TsdfMap(TsdfSettings(voxel=voxel), NativeContext(threads))
        field = DistanceField(tsdf)
        updates: list[UpdateStats] = []
        anew: list[float] = []
        sequence = open_sequence(recording, stop=frames)
        for index in range(len(sequence)):
            frame = sequence.frame(index, masks=False)
            if frame.T_world_camera is not None:
                tsdf.integrate(frame.depth, sequence.camera, frame.T_world_camera)
            if (index + 1) % every:
                continue
            updates.append(field.update())
            anew.append(DistanceField(tsdf).update().milliseconds)
        print_updates(voxel, updates, anew)
        print_last(field)


def pace_part(
    recording: Path, voxels: tuple[float, ...] = (0.04, 0.02), budgets: tuple[float, ...] = (0.0, 33.0),
    frames: int | None = None, threads: int | None = None,
) -> None:  # fmt: skip
    """Prints how long TSDF and field take with every frame, without and with a limit."""
    print(f"TSDF and distance field after every frame, {recording.name}")
    sequence = open_sequence(recording, stop=frames)
    for voxel in voxels:
        for budget in budgets:
            settings = VolumeSettings(tsdf=TsdfSettings(voxel=voxel), budget_ms=budget)
            tsdf = TsdfMap(settings.tsdf, NativeContext(threads), points=True)
            field, rows = DistanceField(tsdf), []
            for index in range(len(sequence)):
                frame = sequence.frame(index, masks=False)
                if frame.T_world_camera is None:
                    continue
                start = time.perf_counter()
                tsdf.integrate(frame.depth, sequence.camera, frame.T_world_camera, frame.color)
                spent = 1e3 * (time.perf_counter() - start)
                stats = field.update(settings.left_for_field_ms(spent), frame.T_world_camera[:3, 3])
                rows.append((spent, 1e3 * (time.perf_counter() - start) - spent, stats.stale_blocks / stats.blocks))
            fusion, update, stale = np.array(rows).T
            whole, limit = fusion + update, f"{budget:g} ms" if budget else "no limit"
            print(
                f"  {100 * voxel:.0f} cm, {limit}: fusion {fusion.mean():.1f} ms, field {update.mean():.1f}, both "
                f"{whole.mean():.1f}, 95 % {np.percentile(whole, 95):.1f}, largest {whole.max():.1f}; "
                f"{100 * stale.mean():.0f} % of the blocks wait",
                flush=True,
            )


def print_updates(voxel: float, updates: list[UpdateStats], anew: list[float]) -> None:
    """Medians over the second half of the recording, when most of the scene is mapped."""
    half = len(anew) // 2
    late = updates[half:]
    ms, whole = float(np.median([s.milliseconds for s in late])), float(np.median(anew[half:]))
    share = float(np.median([s.recomputed_blocks / s.blocks for s in late]))
    changed = float(np.median([s.changed_blocks / s.blocks for s in late]))
    print(
        f"  {100 * voxel:.0f} cm: update {ms:.1f} ms, anew {whole:.1f} ms, ratio {whole / ms:.2f}; blocks changed "
        f"{100 * changed:.0f} %, recomputed {100 * share:.0f} % of {late[-1].blocks}; longest "
        f"{max(s.milliseconds for s in updates):.1f} ms",
        flush=True,
    )


def print_last(field: DistanceField) -> None:
    """The finished map: updated against anew, the libraries, a change of one block, queries, memory."""
    tsdf = field.tsdf
    fresh = DistanceField(tsdf)
    stats = fresh.update()
    blocks = fresh.coordinates()
    truth, updated = fresh.read(blocks), field.read(blocks)
    field.recompute()
    same = np.array_equal(updated, field.read(blocks), equal_nan=True)
    print(
        f"    same as anew from the points held, bit by bit: {same}; "
        f"from the map's own points {np.nanmax(np.abs(updated - truth)) / tsdf.settings.voxel:.4f} voxels at most"
    )
    surface, _ = fresh.surface()
    grid = dense_grid(tsdf, surface)
    print_libraries(tsdf, grid)
    print_small_change(fresh)
    points = np.random.default_rng(0).uniform(0, SIDE, (QUERIES, 3)) + SIDE * np.resize(blocks, (QUERIES, 3))
    points *= tsdf.settings.voxel
    rate = QUERIES / seconds_of(lambda: fresh.query(points), 3)
    known = int((~np.isnan(truth)).sum())
    print(
        f"    queries, distance and gradient: {rate / 1e6:.1f} M points/s; memory {fresh.memory_bytes / known:.1f} MB "
        f"per million known voxels ({fresh.memory_bytes / (stats.blocks * VOXELS):.1f} with the unknown ones beside)",
        flush=True,
    )


def print_libraries(tsdf: TsdfMap, grid: DenseGrid) -> None:
    """Computing anew against the libraries on the grid of the map's blocks. Making the grid is not counted; the native
    time includes finding the surface, sub-voxel distances and gradients, which the libraries do not give."""
    native = 1e-3 * min(DistanceField(tsdf).update().milliseconds for _ in range(3))
    scipy = seconds_of(lambda: distance_transform_edt(~grid.surface, return_indices=True), 1)
    print(
        f"    anew on {grid.known.size / 1e6:.2f} M voxels ({grid.known.mean():.0%} known): native {1e3 * native:.0f} "
        f"ms, scipy with indices {1e3 * scipy:.0f} ms (scipy / native {scipy / native:.1f})"
    )
    try:
        import edt
    except ImportError:
        return
    threads = (1, tsdf.context.threads)
    signed = min(seconds_of(lambda n=n: edt.sdf(grid.free, parallel=n), 3) for n in threads)  # type: ignore[misc]
    plain = min(seconds_of(lambda n=n: edt.edt(~grid.surface, parallel=n), 3) for n in threads)  # type: ignore[misc]
    print(
        f"    edt.sdf {1e3 * signed:.0f} ms (edt / native {signed / native:.2f}), edt.edt, unsigned, "
        f"{1e3 * plain:.0f} ms ({plain / native:.2f})"
    )


def print_small_change(field: DistanceField) -> None:
    """An obstacle that comes and goes: a block in the middle of the free space becomes one."""
    tsdf = field.tsdf
    blocks = field.coordinates()
    distance = field.read(blocks)
    lone = blocks[[np.argmax(np.where(np.isnan(distance).any(axis=1), -1, np.nan_to_num(distance).min(axis=1)))]]
    before = tsdf.read(lone)
    value = np.full((1, VOXELS), FREE_VALUE)
    value[0, [219, 220, 227, 228, 283, 284, 291, 292]] = -FREE_VALUE
    times, shares = [], []
    for voxels in (value, before.value) * 3:
        tsdf.write(lone, value=voxels, weight=np.maximum(before.weight, 1))
        stats = field.update()
        times.append(stats.milliseconds)
        shares.append(stats.recomputed_blocks / stats.blocks)
    whole = min(DistanceField(tsdf).update().milliseconds for _ in range(2))
    print(
        f"    an obstacle of 2^3 voxels in free space comes: {min(times[::2]):.1f} ms, goes: {min(times[1::2]):.1f} ms "
        f"(anew / update {whole / min(times[::2]):.1f}, {whole / min(times[1::2]):.1f}); "
        f"recomputed {100 * shares[0]:.0f} and {100 * shares[1]:.0f} % of the blocks"
    )


# --- scenes with known distances -------------------------------------------------------------------------------------


def turn() -> np.ndarray:
    """Some rotation [3, 3]."""
    return np.linalg.qr(np.array([[0.9, -0.3, 0.2], [0.35, 0.88, -0.25], [-0.1, 0.3, 0.95]]))[0]


def scenes() -> dict[str, Scene]:
    """The scenes, within 1.6 m of the origin along each axis."""
    rotation, middle, half = turn(), np.array([0.05, 0.02, 0.04]), np.array([1.15, 1.02, 1.1])
    normals = np.array([[0.1, 0.2, 1], [-0.1, 0.1, -1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def solid(points: np.ndarray, half: np.ndarray) -> np.ndarray:
        q = np.abs((points - middle) @ rotation) - half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return {
        "sphere, outside": lambda p: np.linalg.norm(p - middle, axis=-1) - 0.7,
        "sphere, inside": lambda p: 1.2 - np.linalg.norm(p - middle, axis=-1),
        "box room": lambda p: (half - np.abs(p - middle)).min(axis=-1),
        "box room, turned": lambda p: -solid(p, half),
        "two planes": lambda p: np.minimum(p @ normals[0] + 1.2, p @ normals[1] + 1.1),
        "solid box, turned": lambda p: solid(p, 0.4 * half),
    }


def accuracy_part(voxel: float = 0.04, reach: float = 1.6) -> None:
    """Prints errors of distance and gradient at voxel centres in front of the surfaces, the nearest surface point being
    mapped; gradients more than a voxel from where several surface points are nearest."""
    print(
        f"accuracy at {100 * voxel:.0f} cm: distance in voxels (mean, largest), gradient in degrees (mean, 99 %, "
        "largest)"
    )
    for name, scene in scenes().items():
        tsdf = TsdfMap(TsdfSettings(voxel=voxel))
        edges = int(round(reach / (SIDE * voxel)))
        blocks = np.stack(np.meshgrid(*3 * [np.arange(-edges, edges)], indexing="ij"), -1).reshape(-1, 3)
        write(tsdf, scene, blocks)
        field = DistanceField(tsdf)
        field.update()
        grid = dense_grid(tsdf, field.surface()[0])
        points = (np.argwhere(np.ones(grid.known.shape, bool))[:, ::-1] + grid.origin + 0.5) * voxel
        truth, gradient = scene(points), slopes(scene, points)
        foot = points - truth[:, None] * gradient
        held = (truth > 0) & (truth < 2 - voxel) & (np.abs(foot) < reach - 2 * voxel).all(axis=1)
        smooth = held.copy()
        smooth[held] = is_smooth(scene, points[held], voxel)
        values = field.query(points)
        found = {"native": (values.distance / voxel, values.gradient)}
        plain = edt_distance(grid, 2)
        if plain is not None:
            found["edt"] = (plain.reshape(-1), np.stack(np.gradient(plain)[::-1], -1).reshape(-1, 3))
        distance, direction = scipy_distance(grid)
        found["scipy"] = (distance.reshape(-1), direction.reshape(-1, 3))
        for method, (distances, gradients) in found.items():
            print_errors(name, method, np.abs(distances - truth / voxel)[held], turned(gradients, gradient)[smooth])


def print_errors(scene: str, method: str, error: np.ndarray, angle: np.ndarray) -> None:
    """A line of the table."""
    print(
        f"  {scene:18s} {method:7s} {error.mean():.3f} {error.max():.2f}   {angle.mean():.2f} "
        f"{np.percentile(angle, 99):.2f} {angle.max():.2f}   above 5 degrees: "
        f"{100 * (angle > 5).mean():.2f} % of {len(angle)}",
        flush=True,
    )


def write(tsdf: TsdfMap, scene: Scene, blocks: np.ndarray) -> None:
    """Writes the blocks of a scene, seen to the truncation behind surfaces."""
    k, j, i = np.unravel_index(np.arange(VOXELS), (SIDE, SIDE, SIDE))
    centres = (blocks[:, None] * SIDE + np.stack([i, j, k], -1) + 0.5) * tsdf.settings.voxel
    level = scene(centres.reshape(-1, 3)).reshape(len(blocks), VOXELS) / tsdf.settings.truncation
    value = np.round(np.clip(level, -1, 1) * FREE_VALUE)
    free = (value == FREE_VALUE).all(axis=1)
    tsdf.write(blocks[~free], value=value[~free], weight=np.where(level >= -1, FULL_WEIGHT, 0)[~free])
    tsdf.write_free(blocks[free], np.full(free.sum(), FULL_WEIGHT))


def slopes(scene: Scene, points: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Gradient [N, 3] of a scene's distance."""
    return np.stack([(scene(points + step * e) - scene(points - step * e)) / (2 * step) for e in np.eye(3)], -1)


def is_smooth(scene: Scene, points: np.ndarray, reach: float) -> np.ndarray:
    """Whether the gradient does not jump within `reach` along the axes and diagonals: bool [N]."""
    here, smooth = slopes(scene, points), np.ones(len(points), bool)
    for step in np.ndindex(3, 3, 3):
        there = slopes(scene, points + reach * (np.array(step) - 1))
        smooth &= np.einsum("na,na->n", here, there) > 0.9
    return smooth


def turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between vectors [N, 3], degrees."""
    length = np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-9)
    return np.degrees(np.arccos(np.clip(np.einsum("na,na->n", a, b) / length, -1, 1)))
