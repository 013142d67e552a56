# SPDX-License-Identifier: Apache-2.0
"""A live camera of one's own: a class with `name`, `camera`, `frames()` and `close()`.

    python examples/own_camera.py
    PYTHONPATH=examples ggslam run python:own_camera:DrawnRoom --stop 20 --record demo/walk --out demo/walk_run

This one looks into the corner of a drawn room; in your own, `frames` asks the driver for the newest pair of images.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import numpy as np

from ggslam import Camera, Frame, LiveSequence, Slam, load_config

HALF_SIZE = np.array([2.0, 1.4, 2.4])
"""Of the room, metres; the world's origin is its middle."""


class DrawnRoom:
    """A camera that walks through an empty room with coloured walls."""

    name = "drawn_room"
    camera = Camera(width=160, height=120, fx=120.0, fy=120.0, cx=79.5, cy=59.5)

    def frames(self) -> Iterator[Frame]:
        """Colour uint8 [H, W, 3] RGB and depth float32 [H, W] in metres, 0 = none, of the same pixels."""
        for index in range(60):
            color, depth = self.draw(position=np.array([0.02 * index, 0.1, 0.01 * index]), turn=0.7, nod=0.4)
            yield Frame(index, index, time.monotonic(), color, depth, self.camera)

    def draw(self, position: np.ndarray, turn: float, nod: float) -> tuple[np.ndarray, np.ndarray]:
        """What is seen from a place, metres, looking by `turn` to the right and `nod` down, radians."""
        s, c = np.sin([turn, nod]), np.cos([turn, nod])
        R = np.array([[c[0], 0, s[0]], [0, 1, 0], [-s[0], 0, c[0]]]) @ [[1, 0, 0], [0, c[1], s[1]], [0, -s[1], c[1]]]
        rays = self.camera.rays() @ R.T  # [H, W, 3], 1 m deep each
        with np.errstate(divide="ignore"):
            depth = ((np.sign(rays) * HALF_SIZE - position) / rays).min(-1)  # to the nearest wall
        points = position + depth[..., None] * rays
        waves = np.sin(7 * points) + np.sin(points @ [[3, 11, 5], [9, 4, 13], [6, 8, 10]])
        return (128 + 60 * waves).clip(0, 255).astype(np.uint8), depth.astype(np.float32)

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
