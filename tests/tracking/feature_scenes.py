# SPDX-License-Identifier: Apache-2.0
"""Rooms made of planes, as a depth camera and a LiDAR see them."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


def picture(size: int = 1024) -> np.ndarray:
    """A square of blobs that can be told apart, float32 [size, size]."""
    rng = np.random.default_rng(4)
    image = np.full((size, size), 0.5, np.float32)
    for sigma in (3, 8, 25):
        blobs = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        image += 0.15 * blobs / blobs.std()
    return np.clip(image, 0, 1)


PICTURE = picture()


def room_view(T: np.ndarray, corner: bool = True, sigma: float = 0.0, seed: int = 0, camera: Camera = CAMERA) -> Frame:
    """A wall z = 2; with `corner` also walls x = 0.6 and y = 0.5, and a box in front of them; with depth noise."""
    rays = camera.rays().astype(float) @ T[:3, :3].T
    origin = T[:3, 3]
    depth = plane_depths(rays, origin, np.array([0.6, 0.5, 2.0] if corner else [np.inf, np.inf, 2.0]))
    if corner:
        depth = np.minimum(depth, box_depth(rays, origin, np.array([-0.4, -0.1, 1.4]), np.array([-0.1, 0.2, 1.7])))
    hit = origin + rays * depth[..., None]
    u, v = ((hit[..., axis] + hit[..., 2] - 2) * 256 + 512 for axis in (0, 1))
    grey = cv2.remap(PICTURE, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    depth = depth + sigma * np.random.default_rng(seed).normal(size=depth.shape)
    return Frame(0, 0, 0.0, np.repeat(np.uint8(grey * 255)[..., None], 3, 2), depth.astype(np.float32), camera)


def plane_depths(rays: np.ndarray, origin: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """How far along rays [..., 3] the nearest of the planes x, y, z = `planes` is."""
    return ((planes - origin) / np.where(rays > 1e-9, rays, 1e-9)).min(-1)


def box_depth(rays: np.ndarray, origin: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """How far along rays [..., 3] a box is, infinite where it is missed."""
    safe = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    one, two = (low - origin) / safe, (high - origin) / safe
    enter, leave = np.minimum(one, two).max(-1), np.maximum(one, two).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def lidar_scan(T: np.ndarray, sigma: float = 0.0, rings: int = 32, columns: int = 900) -> np.ndarray:
    """Points [n, 3] in the sensor's frame of a hall 24 x 16 x 8 m with two pillars, seen from inside."""
    elevation = np.radians(np.linspace(-25, 15, rings))[:, None]
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi - np.pi
    rays = np.stack(np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    ), -1)  # fmt: skip
    world, origin = rays @ T[:3, :3].T, T[:3, 3]
    safe = np.where(np.abs(world) < 1e-9, 1e-9, world)
    distance = np.where(safe > 0, (np.array([12.0, 8, 4]) - origin) / safe, (np.array([-12.0, -8, -4]) - origin) / safe)
    distance = distance.min(-1)
    for x, y in ((5.0, 3.0), (-6.0, -2.0)):
        corner = np.array([x, y, -4.0])
        distance = np.minimum(distance, box_depth(world, origin, corner, corner + [1.0, 1.0, 8.0]))
    distance = distance + sigma * np.random.default_rng(1).normal(size=distance.shape)
    return (rays * distance[..., None]).reshape(-1, 3)
