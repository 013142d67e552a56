# SPDX-License-Identifier: Apache-2.0
"""A generated recording: a furnished room (`scene`, `room`) or a ring of rooms and corridors (`house`), ray-cast
(`raycast`) and written out (`writer`)."""

from ggslam.sequences.synthetic.house import ring_of_rooms
from ggslam.sequences.synthetic.raycast import RayCaster, RayImages
from ggslam.sequences.synthetic.room import furnished_room
from ggslam.sequences.synthetic.scene import Scene, SceneBuilder, Shape
from ggslam.sequences.synthetic.scenes import SCENES
from ggslam.sequences.synthetic.trajectory import TRAJECTORIES, camera_path
from ggslam.sequences.synthetic.writer import write_synthetic_sequence

__all__ = [
    "SCENES",
    "TRAJECTORIES",
    "RayCaster",
    "RayImages",
    "Scene",
    "SceneBuilder",
    "Shape",
    "camera_path",
    "furnished_room",
    "ring_of_rooms",
    "write_synthetic_sequence",
]
