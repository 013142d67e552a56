# SPDX-License-Identifier: Apache-2.0
"""A live camera of one's own: a class with `name`, `camera`, `frames()` and `close()`.

    python examples/own_camera.py
    PYTHONPATH=examples ggslam run python:own_camera:DrawnRoom --stop 20 --record demo/walk --out demo/walk_run

This one looks at a drawn room; in your own, `frames` asks the driver for the newest pair of images.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.sequences.live import LiveSequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.synthetic import RayCaster, camera_path, furnished_room


class DrawnRoom:
    """A camera that walks through a room of polygons."""

    name = "drawn_room"
    camera = Camera(width=160, height=120, fx=120.0, fy=120.0, cx=79.5, cy=59.5)

    def __init__(self) -> None:
        scene = furnished_room()
        self._poses, self._caster = camera_path(scene, frames=60), RayCaster(scene)

    def frames(self) -> Iterator[Frame]:
        """Colour uint8 [H, W, 3] RGB and depth float32 [H, W] in metres, 0 = none, of the same pixels."""
        for index, T_world_camera in enumerate(self._poses):
            images = self._caster.render(self.camera, T_world_camera)
            yield Frame(index, index, time.monotonic(), images.color, images.depth, self.camera)

    def close(self) -> None:
        """There is no driver to stop."""


def main(stop: str = "20") -> None:
    """Tracks and maps what the camera shows, until `stop` frames have come or Ctrl-C."""
    live = LiveSequence(DrawnRoom(), stop=int(stop))
    slam = Slam(live.camera, load_config("fast-cpu"))
    for frame in live.stream():
        report = slam.step(frame)
        print(f"frame {frame.index}: {report.frame.status}, {report.gaussians} Gaussians")
    result = slam.finish()
    print(f"the camera walked {abs(result.trajectory()[-1][:3, 3]).max():.2f} m along its widest axis")


if __name__ == "__main__":
    main(*sys.argv[1:])
