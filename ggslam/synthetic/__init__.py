# SPDX-License-Identifier: Apache-2.0
"""A generated recording: a furnished room (`scene`, `room`), a ring of rooms and corridors (`house`) or a long
corridor (`corridor`), ray-cast (`raycast`) and written out (`writer`). And a large `world` of boxes for a laser
scanner."""

from ggslam.synthetic.corridor import furnished_corridor
from ggslam.synthetic.exposure import Shutter
from ggslam.synthetic.house import ring_of_rooms
from ggslam.synthetic.movers import MOVERS
from ggslam.synthetic.raycast import RayCaster, RayImages
from ggslam.synthetic.rig import write_synthetic_rig
from ggslam.synthetic.room import furnished_room
from ggslam.synthetic.scene import Scene, SceneBuilder, Shape
from ggslam.synthetic.scenes import SCENES
from ggslam.synthetic.trajectory import TRAJECTORIES, camera_path
from ggslam.synthetic.world import World, cast_rays
from ggslam.synthetic.world_cloud import cloud_tiles, world_cloud
from ggslam.synthetic.world_plan import make_world
from ggslam.synthetic.world_scanner import Scan, Scanner
from ggslam.synthetic.world_walk import walk
from ggslam.synthetic.writer import FRAMES_WITH_MOVERS, write_synthetic_sequence

__all__ = [
    "FRAMES_WITH_MOVERS",
    "MOVERS",
    "SCENES",
    "TRAJECTORIES",
    "RayCaster",
    "RayImages",
    "Scan",
    "Scanner",
    "Scene",
    "SceneBuilder",
    "Shape",
    "Shutter",
    "World",
    "camera_path",
    "cast_rays",
    "cloud_tiles",
    "furnished_corridor",
    "furnished_room",
    "make_world",
    "ring_of_rooms",
    "walk",
    "world_cloud",
    "write_synthetic_rig",
    "write_synthetic_sequence",
]
