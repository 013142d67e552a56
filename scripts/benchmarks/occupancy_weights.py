# SPDX-License-Identifier: Apache-2.0
"""What it brings to count a voxel's points: occupancy maps against OctoMap's two ways and against an exact scene.

A scene of known surfaces is seen through depth with a Kinect's noise; then a ball that was always there is taken away,
and another one passes by, in a single view. The references are OctoMap's insertion of whole scans (a voxel counts once
a scan) and of points one by one (every ray counts).

    agree      of the voxels known to both, those with the same state: with whole scans / with points one by one
    occupied   of the occupied voxels, those that the surface does not pass (percent)
    free       of the voxels that hold seen surface, those called free (percent)
    gone       occupied voxels where the ball was, by the number of views after it went
    passed     where the other ball was
    ms         CPU time of a view
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from agreement import agreement
from analytic_scenes import Box, Scene, Sphere, Union, looking_at, render_depth, small_camera

from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.posed_view import PosedView

WALLS = Box((-2.0, -1.3, -2.2), (2.3, 1.4, 1.9), inside_out=True)
STAYS = (
    WALLS,
    Sphere((0.9, 0.6, 0.8), 0.35),
    Box((-1.6, 0.3, 0.6), (-0.9, 1.4, 1.3)),
    Box((0.2, -1.3, 1.2), (0.24, 1.4, 1.24)),
)
GOES, PASSES = Sphere((-0.3, 0.4, 0.9), 0.3), Sphere((0.25, 0.2, 0.1), 0.2)
NOISE = 0.0015
"""Standard deviation of depth at 1 m, metres; it grows with the square of the depth."""
AFTER = (1, 2, 3, 5, 10)


@dataclass(frozen=True)
class Sights:
    """Noisy views of a scene, and where its seen surface truly is, float64 [n, 3]."""

    views: list[PosedView]
    surface: np.ndarray


def sights_of(scene: Scene, count: int, seed: int, size: int = 160) -> Sights:
    """From so many places on an arc."""
    camera, rng = small_camera(size, size * 3 // 4), np.random.default_rng(seed)
    fine: Camera = small_camera(2 * size, 2 * (size * 3 // 4))
    views, surface = [], []
    for turn in np.linspace(-0.9, 0.9, count):
        T = looking_at(np.array([1.2 * np.sin(turn), 0.1, -1.1 * np.cos(turn)]), np.array([0.1, 0.35, 0.8]))
        depth = render_depth(scene, camera, T)
        noisy = depth + NOISE * depth**2 * rng.standard_normal(depth.shape)
        views.append(PosedView(np.where(depth > 0, noisy, 0).astype(np.float32), camera, T))
        surface.append(PosedView(render_depth(scene, fine, T), fine, T).points())
    return Sights(views, np.concatenate(surface))


def print_weights(voxel: float, context: NativeContext, views: int = 16) -> None:
    """The table of one size of voxels."""
    before, after = sights_of(Union((*STAYS, GOES)), views, 0), sights_of(Union(STAYS), max(AFTER), 1)
    passing = sights_of(Union((*STAYS, PASSES)), 1, 2)
    plain, raised = OccupancySettings(), OccupancySettings.with_raised_odds()
    scans, points = _scans(voxel, before, context), _points_one_by_one(voxel, before, context)
    rows = [("whole scans (OctoMap)", replace(plain, quantize=False)), ("once", plain), ("once, raised", raised)]
    rows += [(f"up to {n}", replace(plain, most_hits=n)) for n in (2, 4, 1000)]
    rows += [(f"up to {n}, raised", replace(raised, most_hits=n)) for n in (2, 4)]
    words = f"agree           occupied   free     ms   (gone, passed) after {', '.join(map(str, AFTER))} views"
    print(f"{100 * voxel:g} cm: a voxel is hit           {words}")
    for name, settings in rows:
        ours = OccupancyMap(voxel, settings, context)
        start = time.process_time()
        for view in before.views:
            view.insert_into(ours, 10.0)
        spent = 1e3 * (time.process_time() - start) / views
        agree = [agreement(reference, ours).known for reference in (scans, points)]
        wrong = _false_occupied(ours, Union((*STAYS, GOES))), _false_free(ours, before.surface)
        left = _left_over(ours, passing, after)
        print(
            f"   {name:26} {agree[0]:.4f} / {agree[1]:.4f}   {wrong[0]:7.2f}  {wrong[1]:6.2f} {spent:6.2f}   "
            f"{', '.join(map(str, left))}", flush=True,
        )  # fmt: skip


def _scans(voxel: float, sights: Sights, context: NativeContext) -> OccupancyMap:
    found = OccupancyMap(voxel, OccupancySettings(quantize=False, last_voxel=False), context)
    for view in sights.views:
        view.insert_into(found, 10.0)
    return found


def _points_one_by_one(voxel: float, sights: Sights, context: NativeContext) -> OccupancyMap:
    """Each point as a scan of its own, which changes the map as OctoMap's insertRay does."""
    found = OccupancyMap(voxel, OccupancySettings(quantize=False, last_voxel=False), context)
    for view in sights.views:
        origin = view.T_world_camera[:3, 3]
        for point in view.points()[:, None]:
            found.insert(point, origin)
    return found


def _false_occupied(found: OccupancyMap, scene: Scene) -> float:
    centers, _ = found.occupied_centers()
    return 100 * float((np.abs(scene.distance(centers.astype(float))) > found.resolution * np.sqrt(3) / 2).mean())


def _false_free(found: OccupancyMap, surface: np.ndarray) -> float:
    keys = np.unique(np.floor(surface / found.resolution).astype(np.int64), axis=0)
    states = found.states((keys + 0.5) * found.resolution)
    return 100 * float((states[states >= 0] == 0).mean())


def _left_over(found: OccupancyMap, passing: Sights, later: Sights) -> list[tuple[int, int]]:
    counts = []
    for number, view in enumerate((*passing.views, *later.views)):
        view.insert_into(found, 10.0)
        if number in AFTER:
            centers = found.occupied_centers()[0].astype(float)
            left = [int((ball.distance(centers) < found.resolution).sum()) for ball in (GOES, PASSES)]
            counts.append((left[0], left[1]))
    return counts
