# SPDX-License-Identifier: Apache-2.0
"""A generated recording: a furnished room (`scene`, `room`), or a ring of rooms or a long corridor (`houses`), ray-cast
(`raycast`) and written out (`writer`)."""

from ggslam.synthetic.exposure import Shutter
from ggslam.synthetic.movers import MOVERS
from ggslam.synthetic.raycast import RayCaster, RayImages
from ggslam.synthetic.rig import write_synthetic_rig
from ggslam.synthetic.room import furnished_room
from ggslam.synthetic.scene import Scene, SceneBuilder, Shape
from ggslam.synthetic.scenes import SCENES
from ggslam.synthetic.trajectory import TRAJECTORIES, camera_path
from ggslam.synthetic.writer import SynthTuning, write_synthetic_sequence

__all__ = [
    "MOVERS",
    "SCENES",
    "TRAJECTORIES",
    "RayCaster",
    "RayImages",
    "Scene",
    "SceneBuilder",
    "Shape",
    "Shutter",
    "SynthTuning",
    "camera_path",
    "furnished_room",
    "write_synthetic_rig",
    "write_synthetic_sequence",
]
