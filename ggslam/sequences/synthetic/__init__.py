# SPDX-License-Identifier: Apache-2.0
"""A generated recording: a furnished room (`scene`, `room`), ray-cast (`raycast`) and written out (`writer`)."""

from ggslam.sequences.synthetic.raycast import RayCaster, RayImages
from ggslam.sequences.synthetic.room import furnished_room
from ggslam.sequences.synthetic.scene import Scene, SceneBuilder, Shape
from ggslam.sequences.synthetic.trajectory import TRAJECTORIES, camera_path
from ggslam.sequences.synthetic.writer import write_synthetic_sequence

__all__ = [
    "TRAJECTORIES",
    "RayCaster",
    "RayImages",
    "Scene",
    "SceneBuilder",
    "Shape",
    "camera_path",
    "furnished_room",
    "write_synthetic_sequence",
]
