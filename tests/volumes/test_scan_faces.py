# SPDX-License-Identifier: Apache-2.0
"""Laser scans as depth images: exact where the scanner measured planes, empty where it measured nothing."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import Box, Scene, Sphere, Union
from scipy.spatial import cKDTree

from ggslam.native.loader import NativeContext
from ggslam.scene.poses import transform_points
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.posed_view import PosedScan
from ggslam.volumes.scan_faces import ScanFaces
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.volume_settings import VolumeSettings

ROOM = Box((-2.5, -3.0, -1.2), (3.5, 2.0, 1.4), inside_out=True)
CONTEXT = NativeContext(1)


def scan(scene: Scene, T_world_sensor: np.ndarray, rings: int = 64, columns: int = 720, span: float = 45) -> np.ndarray:
    """Exact points in the sensor's frame, ring by ring; those that meet nothing are left out."""
    elevation = np.radians(np.linspace(-span, span, rings))[:, None]
    azimuth = (np.arange(columns) + 0.3) / columns * 2 * np.pi
    flat = np.cos(elevation)
    rays = np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), -1)
    rays = rays.reshape(-1, 3)
    lengths = scene.ray_lengths(T_world_sensor[:3, 3], rays @ T_world_sensor[:3, :3].T)
    there = np.isfinite(lengths)
    return (rays * lengths[:, None])[there].astype(np.float32)


def pose(x: float, y: float, turn: float = 0.3) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = (np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))
    T[:3, 3] = x, y, 0.05
    return T


def test_every_pixel_shows_the_plane_that_was_measured() -> None:
    T = pose(0.4, -0.3)
    points = scan(ROOM, T)
    faces = ScanFaces.of(points)
    assert abs(faces.columns - 720) <= 2
    depth = faces.draw(points, 0.5, 0.1, 20.0, CONTEXT)
    seen, off = 0, []
    for image, T_sensor_face in zip(depth, faces.T_sensor_faces, strict=True):
        found = faces.camera.back_project(image)[image > 0].astype(float)
        off.append(np.abs(ROOM.distance(transform_points(found, T @ T_sensor_face))))
        seen += len(found)
    assert seen > 0.9 * 4 * faces.camera.width**2  # all around, up to where the rings end
    assert np.percentile(np.concatenate(off), 95) < 1e-4  # triangles that round off corners of the room are the rest


def test_the_order_of_points_does_not_matter() -> None:
    points = scan(ROOM, pose(0.4, -0.3))
    faces = ScanFaces.of(points)
    shuffled = np.random.default_rng(0).permutation(points)
    with_gaps = np.concatenate([shuffled, np.full((5, 3), np.nan, np.float32), np.zeros((3, 3), np.float32)])
    assert ScanFaces.of(with_gaps).columns == pytest.approx(faces.columns, abs=3)
    expected = faces.draw(points, 0.5, 0.1, 20.0, CONTEXT)
    assert np.array_equal(expected, faces.draw(with_gaps, 0.5, 0.1, 20.0, NativeContext(2)))


def test_nothing_joins_what_lies_before_and_behind() -> None:
    """A ball a metre before a wall: between the two there is nothing."""
    scene = Union((Box((-2.0, -4.0, -2.0), (3.0, 4.0, 2.0), inside_out=True), Sphere((1.5, 0.0, 0.0), 0.4)))
    points = scan(scene, np.eye(4))
    faces = ScanFaces.of(points)
    (front, *_) = faces.draw(points, 0.3, 0.1, 20.0, CONTEXT)
    found = faces.camera.back_project(front)[front > 0].astype(float)
    placed = transform_points(found, faces.T_sensor_faces[0])
    assert np.abs(scene.distance(placed)).max() < 0.05


def test_too_few_points_show_nothing() -> None:
    for points in (np.zeros((0, 3), np.float32), np.ones((1, 3), np.float32), np.full((9, 3), np.nan, np.float32)):
        faces = ScanFaces.of(points)
        assert not faces.draw(points, 0.5, 0.1, 20.0, CONTEXT).any()


@pytest.mark.parametrize(("rings", "median", "ninety_five"), [(64, 0.0005, 0.01), (16, 0.0005, 0.03)])
def test_fused_scans_are_where_the_walls_are(rings: int, median: float, ninety_five: float) -> None:
    """Metres, of voxels of 5 cm."""
    maps = VolumeMaps(VolumeSettings(tsdf=TsdfSettings(voxel=0.05)), esdf=True, occupancy=0.1)
    total = 0
    for k in range(6):
        T = pose(-0.6 + 0.3 * k, 0.1 * k, 0.2 * k)
        points = scan(ROOM, T, rings, span=35)
        maps.add_together([PosedScan(points, T, ScanFaces.of(points))])
        total += len(points)
    maps.finish()
    assert maps.points == total and len(maps.times.rows) == 6
    off = np.abs(ROOM.distance(maps.mesh(50).vertices.astype(float)))
    assert len(off) > 5000 and np.median(off) < median and np.percentile(off, 95) < ninety_five
    assert maps.field is not None and maps.occupancy is not None
    centers, _ = maps.occupancy.occupied_centers()
    assert np.abs(ROOM.distance(centers.astype(float))).max() < 0.1 * np.sqrt(3) / 2 + 1e-5
    inside = np.array([(2.8, 0.5, 0.1), (1.5, 1.4, 0.1), (0.5, -2.6, 0.0)])
    if rings == 64:  # of 16 some are too far from one another for voxels of this size
        assert maps.field.query(inside).distance == pytest.approx(ROOM.distance(inside), abs=0.02)
        assert (maps.occupancy.states(inside) == 0).all()


def test_surfaces_far_from_the_scanner_are_as_true_as_near_ones_but_have_gaps() -> None:
    """A hall of 55 m, noise of 2 cm, voxels of 20 cm: errors in metres, by the distance from the scanner. Gaps: points
    without mesh within a voxel, where rings are farther apart than the truncation."""
    hall = Box((-25.0, -9.0, -1.8), (30.0, 8.0, 5.0), inside_out=True)
    maps = VolumeMaps(VolumeSettings(tsdf=TsdfSettings(voxel=0.2, max_depth=40.0)))
    rng, places, measured = np.random.default_rng(0), [], []
    for k in range(8):
        T = pose(-1.0 + 0.4 * k, 0.1 * k, 0.05 * k)
        points = scan(hall, T, 64, 1024, span=14)
        lengths = np.linalg.norm(points, axis=1, keepdims=True)
        points = (points * (1 + 0.02 * rng.standard_normal(lengths.shape) / lengths)).astype(np.float32)
        maps.add_together([PosedScan(points, T, ScanFaces.of(points))])
        places.append(T[:3, 3])
        measured.append(transform_points(points[::10].astype(float), T))
    vertices = maps.mesh(50).vertices.astype(float)
    off, seen = np.abs(hall.distance(vertices)), np.concatenate(measured)
    gap = cKDTree(vertices).query(seen)[0] > 0.2
    away, seen_away = (cKDTree(np.array(places)).query(p)[0] for p in (vertices, seen))
    expected = (0, 10, 0.006, 0.015, 0.02), (10, 20, 0.004, 0.03, 0.1), (20, 31, 0.004, 0.06, 0.2)
    for low, high, median, most, gaps in expected:
        here, there = (away >= low) & (away < high), (seen_away >= low) & (seen_away < high)
        assert here.sum() > 1000 and np.median(off[here]) < median and np.percentile(off[here], 95) < most
        assert gap[there].mean() < gaps
