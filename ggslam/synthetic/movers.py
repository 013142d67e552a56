# SPDX-License-Identifier: Apache-2.0
"""Things that move while the furnished room is recorded, with the truth about them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.synthetic.carried import carried_mug
from ggslam.synthetic.drawer import opened_drawer
from ggslam.synthetic.exposure import View
from ggslam.synthetic.motion import Mover, Setting, Views
from ggslam.synthetic.raycast import RayCaster, RayImages
from ggslam.synthetic.scene import Scene, Shape
from ggslam.synthetic.walker import walker
from ggslam.system.tuning import Tuning

_MAKERS = {"mug": carried_mug, "door": opened_drawer, "walker": walker}
"""In the order in which they are fitted in: who walks goes around the others."""
MOVERS = ("walker", "mug", "door")


class MoverTuning(Tuning):
    """How movers are placed."""

    min_frames = 10
    """Fewest frames of a recording with movers."""
    views = 24
    """Frames that tell what the camera sees."""
    view_width = 96
    """Pixels along their width."""
    flush_m = 0.002
    """Largest distance between an object and what is painted on it, in metres."""


class MovingScene:
    """A scene and what moves in it, frame by frame."""

    def __init__(self, scene: Scene, seed: int, movers: Sequence[Mover] = (), further: Sequence[Shape] = ()) -> None:
        self.scene, self.movers = scene, list(movers)
        self._caster = RayCaster(scene, seed, further)
        painted = [mover.painted for mover in movers if mover.painted is not None]
        self._painted = RayCaster(Scene(painted), seed) if painted else None
        self._told: list[list[dict[str, Any]]] = []

    def render(self, frame: int, camera: Camera, T_world_camera: np.ndarray) -> RayImages:
        """One view of a frame; frames come in order."""
        for mover in self.movers:
            self._caster.place(mover.numbers, mover.tracks[frame])
        images = self._caster.render(camera, T_world_camera)
        mask = images.mask
        for mover in self.movers:
            if mover.painted is not None and mover.is_painted is not None and mover.is_painted[frame]:
                assert self._painted is not None
                depth, _ = self._painted.measure(camera, T_world_camera)
                own = (mask == mover.painted.instance) & (np.abs(depth - images.depth) < MoverTuning.flush_m)
                mask = np.where(own, np.uint16(mover.instance), mask)
        self._told.append([mover.describe_frame(frame, mask) for mover in self.movers])
        return replace(images, mask=mask)

    def at_another_pose(self) -> tuple[View, View, View]:
        """Colour, depth and ids of the frame rendered last, as functions of a camera and T_world_camera [4, 4]."""
        return (
            lambda camera, pose: self._caster.render(camera, pose).color,
            lambda camera, pose: self._caster.measure(camera, pose)[0],
            lambda camera, pose: self._caster.measure(camera, pose)[1],
        )

    def truth(self) -> dict[str, Any]:
        """What moved in the frames so far; for JSON."""
        return {
            "world_frame": "metres, z up; poses.txt is camera to world in it, camera axes x right, y down, z forward",
            "moving": "whether the mover, or any part of it, is elsewhere than in the frame before; false in frame 0",
            "T_world": "pose of the mover's own frame: what lies at p in frame i is at "
            "T_world[j] inv(T_world[i]) p in frame j; of what is not rigid this holds for each part",
            "movers": [mover.describe() for mover in self.movers],
            "frames": [{"frame": i, "movers": told} for i, told in enumerate(self._told)],
        }


def movers_of(names: Sequence[str]) -> list[str]:
    """The names, once each.

    Raises:
        SequenceError: there is no such mover.
    """
    wanted = [name.strip() for name in names]
    for name in wanted:
        if name not in MOVERS:
            raise SequenceError(f"movers: expected some of {', '.join(MOVERS)}, found '{name}'")
    return list(dict.fromkeys(wanted))


def find_movers(scene: Scene, camera: Camera, poses: np.ndarray, seed: int, wanted: Iterable[str]) -> MovingScene:
    """Fits movers into a scene so that a camera sees them move.

    Args:
        scene: at rest.
        camera: that records, at `poses` T_world_camera, float64 [frames, 4, 4].
        seed: of what they do.
        wanted: some of `MOVERS`; none is fine.

    Raises:
        SequenceError: too few frames, or no room or no view for a mover.
    """
    wanted = list(wanted)
    if not wanted:
        return MovingScene(scene, seed)
    if len(poses) < MoverTuning.min_frames:
        raise SequenceError(f"movers: expected at least {MoverTuning.min_frames} frames, found {len(poses)}")
    scene = replace(scene, instance_names=dict(scene.instance_names))
    setting = Setting(scene, _look(scene, camera, poses, seed), seed)
    for name, make in _MAKERS.items():
        if name in wanted:
            setting.movers.append(make(setting))
    return MovingScene(scene, seed, setting.movers, setting.shapes)


def _look(scene: Scene, camera: Camera, poses: np.ndarray, seed: int) -> Views:
    """What the camera sees of the scene at rest; the last frame is among it."""
    small = camera.resize(MoverTuning.view_width, round(MoverTuning.view_width * camera.height / camera.width))
    frames = np.unique(np.linspace(0, len(poses) - 1, MoverTuning.views).round().astype(int))
    caster = RayCaster(scene, seed)
    depths, masks = zip(*(caster.measure(small, poses[i]) for i in frames), strict=True)
    return Views(small, poses, frames, np.array(depths), np.array(masks))
