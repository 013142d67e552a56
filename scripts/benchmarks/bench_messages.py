# SPDX-License-Identifier: Apache-2.0
"""What writing messages costs: processor time of one message, beside the same by a general serialiser.

    python scripts/benchmarks/bench_messages.py

ROS 2's messages are also written by the serialiser of mcap-ros2-support, which walks through Python objects, from the
same message; Foxglove's meshes and paths also by objects of foxglove-sdk.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ggslam.messages import foxglove_fields, foxglove_geometry, foxglove_scene
from ggslam.messages.contents import Grid, Mesh, Path, Picture, Points
from ggslam.messages.foxglove_package import color, foxglove_messages, pose, timestamp
from ggslam.messages.ros2_geometry import PATH, path_message
from ggslam.messages.ros2_grids import GRID, grid_message
from ggslam.messages.ros2_images import COMPRESSED, IMAGE, compressed_message, image_message
from ggslam.messages.ros2_markers import MARKERS, markers_message, mesh_marker
from ggslam.messages.ros2_points import CLOUD, cloud_message
from ggslam.middleware.types import message_types

STAMP = 1_700_000_000.25


def processor_ms(work: Callable[[], Any], least_s: float = 0.5) -> float:
    """Least processor time of one call, in milliseconds."""
    best, start = np.inf, time.perf_counter()
    while time.perf_counter() - start < least_s:
        begun = time.process_time()
        work()
        best = min(best, time.process_time() - begun)
    return best * 1000


def by_objects(kind: str, content: bytes) -> Callable[[], bytes]:
    """The same message written by mcap-ros2-support from its objects."""
    from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
    from rosbags.typesys import Stores, get_typestore

    text = get_typestore(Stores.ROS2_JAZZY).generate_msgdef(kind, ros_version=2)[0]
    message = generate_dynamic(kind, text)[kind](content)
    write = serialize_dynamic(kind, text)[kind]
    return lambda: write(message)


def mesh_by_objects(mesh: Mesh) -> bytes:
    """The entity of a mesh by foxglove-sdk's objects."""
    kinds = foxglove_messages()
    assert mesh.rgb is not None
    triangles = kinds.TriangleListPrimitive(
        pose=pose(np.eye(4)), points=[kinds.Point3(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()],
        colors=[color(rgb) for rgb in mesh.rgb.tolist()], indices=mesh.triangles.ravel().tolist(),
    )  # fmt: skip
    entity = kinds.SceneEntity(timestamp=timestamp(STAMP), frame_id=mesh.frame, id="mesh", triangles=[triangles])
    return bytes(kinds.SceneUpdate(entities=[entity]).encode())


def path_by_objects(path: Path) -> bytes:
    """A path by foxglove-sdk's objects."""
    kinds = foxglove_messages()
    made = kinds.PosesInFrame(timestamp=timestamp(STAMP), frame_id=path.frame, poses=[pose(T) for T in path.poses])
    return bytes(made.encode())


def row(name: str, write: Callable[[], bytes], other: Callable[[], bytes] | None) -> str:
    """A row of the table."""
    own = processor_ms(write)
    start = f"| {name} | {len(write()) / 1e6:.2f} | {own:.2f}"
    if other is None:
        return f"{start} | - | - |"
    beside = processor_ms(other)
    return f"{start} | {beside:.2f} | {beside / own:.3g} x |"


def ros2_rows(points: Points, grid: Grid, mesh: Mesh, path: Path, color: Picture, depth: Picture) -> list[str]:
    """Rows of ROS 2."""
    types = message_types("jazzy")
    writers: list[tuple[str, str, Callable[[], bytes], bool]] = [
        ("100,000 points", CLOUD, lambda: cloud_message(types, points, STAMP), True),
        ("grid of 1000 x 1000", GRID, lambda: grid_message(types, grid, STAMP), True),
        ("mesh of 10,000 triangles", MARKERS, lambda: markers_message([mesh_marker(mesh, 0)], STAMP), True),
        ("path of 1,000 poses", PATH, lambda: path_message(path, STAMP), True),
        ("colour 640 x 480", IMAGE, lambda: types.encode(IMAGE, image_message(types, color, STAMP)), True),
        ("colour 640 x 480, JPEG", COMPRESSED,
         lambda: types.encode(COMPRESSED, compressed_message(types, color, STAMP)), False),
        ("depth 640 x 480, PNG", COMPRESSED,
         lambda: types.encode(COMPRESSED, compressed_message(types, depth, STAMP)), False),
    ]  # fmt: skip
    return [
        row(f"ROS 2: {name}", write, by_objects(kind, write()) if compare else None)
        for name, kind, write, compare in writers
    ]


def foxglove_rows(points: Points, grid: Grid, mesh: Mesh, path: Path, color: Picture, depth: Picture) -> list[str]:
    """Rows of Foxglove."""

    def mesh_message() -> bytes:
        return foxglove_scene.scene_message([foxglove_scene.mesh_entity(mesh, STAMP)])

    return [
        row("Foxglove: 100,000 points", lambda: foxglove_fields.cloud_message(points, STAMP), None),
        row("Foxglove: grid of 1000 x 1000", lambda: foxglove_fields.grid_message(grid, STAMP), None),
        row("Foxglove: mesh of 10,000 triangles", mesh_message, lambda: mesh_by_objects(mesh)),
        row("Foxglove: path of 1,000 poses", lambda: foxglove_geometry.path_message(path, STAMP),
            lambda: path_by_objects(path)),
        row("Foxglove: colour 640 x 480, JPEG", lambda: foxglove_geometry.picture_message(color, STAMP), None),
        row("Foxglove: depth 640 x 480, PNG", lambda: foxglove_geometry.picture_message(depth, STAMP), None),
    ]  # fmt: skip


def main() -> None:
    """Prints the table."""
    rng = np.random.default_rng(0)
    points = Points(
        "map", rng.normal(size=(100_000, 3)).astype(np.float32), rng.integers(0, 256, (100_000, 3), dtype=np.uint8)
    )
    grid = Grid("map", np.eye(4), 0.05, rng.integers(-1, 101, (1000, 1000)).astype(np.int8))
    mesh = Mesh(
        "map", rng.normal(size=(5000, 3)).astype(np.float32), rng.integers(0, 5000, (10_000, 3)).astype(np.int32),
        rng.integers(0, 256, (5000, 3), dtype=np.uint8),
    )  # fmt: skip
    path = Path("map", np.tile(np.eye(4), (1000, 1, 1)), STAMP + np.arange(1000) / 30)
    waves = np.sin(np.arange(640) / 20) * np.cos(np.arange(480) / 30)[:, None]
    color = Picture("camera", (np.dstack([waves, -waves, waves**2]) * 100 + 128).astype(np.uint8))
    depth = Picture("camera", (waves + 3 + rng.normal(size=(480, 640)) * 0.003).astype(np.float32))
    print("| message | MB | processor ms | by objects ms | ratio |\n| :--- | ---: | ---: | ---: | ---: |")
    contents = (points, grid, mesh, path, color, depth)
    print("\n".join(ros2_rows(*contents) + foxglove_rows(*contents)))


if __name__ == "__main__":
    main()
