# SPDX-License-Identifier: Apache-2.0
"""Contents with random numbers, one of every kind."""

from __future__ import annotations

import numpy as np

from ggslam.messages.contents import (
    Channel,
    Content,
    Grid,
    Lens,
    Mesh,
    Path,
    Picture,
    Points,
    Pose,
    Splats,
    Thing,
    Things,
    Transforms,
    Verdict,
    Verdicts,
)
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix

STAMP = 1_700_000_000.123456789
LENGTHY = "Ünïcode 椅子 " * 80
HUGE = 2**40 + 3


def random_pose(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(rng.normal(size=4))
    T[:3, 3] = rng.normal(size=3)
    return T


def sample_points(count: int = 300, seed: int = 0) -> Points:
    rng = np.random.default_rng(seed)
    values = {"id": rng.integers(0, 65536, count).astype(np.uint16), "distance": rng.random(count, np.float32)}
    rgb = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    return Points("map", rng.normal(size=(count, 3)).astype(np.float32), rgb, values)


def sample_splats(count: int = 50, coefficients: int = 4) -> Splats:
    rng = np.random.default_rng(1)
    q = rng.normal(size=(count, 4)).astype(np.float32)
    return Splats(
        "map", rng.normal(size=(count, 3)).astype(np.float32), rng.uniform(0.01, 1, (count, 3)).astype(np.float32),
        q / np.linalg.norm(q, axis=1, keepdims=True), rng.uniform(0.01, 0.99, count).astype(np.float32),
        rng.normal(size=(count, coefficients, 3)).astype(np.float32), rng.integers(0, 65536, count).astype(np.uint16),
    )  # fmt: skip


def sample_mesh(part: str = "a", vertices: int = 40, triangles: int = 60, colored: bool = True) -> Mesh:
    rng = np.random.default_rng(2)
    rgb = rng.integers(0, 256, (vertices, 3), dtype=np.uint8) if colored else None
    corners = rng.integers(0, max(vertices, 1), (triangles, 3)).astype(np.int32)
    return Mesh("map", rng.normal(size=(vertices, 3)).astype(np.float32), corners, rgb, part)


def sample_grid(height: int = 7, width: int = 11, at: tuple[int, int] | None = None) -> Grid:
    rng = np.random.default_rng(3)
    T = np.eye(4)
    T[:3, 3] = -1.5, 2.5, 0.1
    return Grid("map", T, 0.05, rng.integers(-1, 101, (height, width)).astype(np.int8), at)


def sample_things() -> Things:
    rng = np.random.default_rng(4)
    return Things("map", (
        Thing(5, "cup", random_pose(rng), np.array([0.1, 0.2, 0.3]), (255, 0, 51), 0.75),
        Thing(HUGE, LENGTHY, random_pose(rng), np.array([1.0, 2.0, 3.0]), velocity=np.array([0.5, -0.25, 0.125])),
        Thing(7, "chair\0", random_pose(rng), np.array([1.0, 1.0, 1.0]), note="moved"),
    ))  # fmt: skip


def sample_contents() -> dict[Channel, Content]:
    """One of every kind, by channel."""
    rng = np.random.default_rng(5)
    poses = np.stack([random_pose(rng) for _ in range(9)])
    smooth = np.linspace(0, 255, 64).astype(np.uint8)
    channels = [np.tile(smooth, (48, 1)), np.tile(smooth[:48, None], (1, 64)), np.full((48, 64), 80, np.uint8)]
    color = np.stack(channels, -1)
    depth = rng.integers(0, 9000, (48, 64)).astype(np.float32) / np.float32(1000)
    return {
        Channel("/tf", Transforms): Transforms((("map", "odom", poses[0]), ("odom", "camera", poses[1]))),
        Channel("pose", Pose): Pose("map", poses[2]),
        Channel("path", Path, True): Path("karte_ü", poses, STAMP + np.arange(9) / 30),
        Channel("image", Picture): Picture("camera", color),
        Channel("depth", Picture): Picture("camera", depth),
        Channel("camera_info", Lens, True): Lens("camera", Camera(64, 48, 55.5, 56.5, 31.25, 23.75)),
        Channel("points", Points, True): sample_points(),
        Channel("splats", Splats, True): sample_splats(),
        Channel("mesh", Mesh): sample_mesh(),
        Channel("grid", Grid, True): sample_grid(),
        Channel("objects", Things, True): sample_things(),
        Channel("/diagnostics", Verdicts): Verdicts((
            Verdict("tracking", "ok", "fine"), Verdict("depth", "error", "no depth", {"frames": "7"}),
        )),
    }  # fmt: skip
