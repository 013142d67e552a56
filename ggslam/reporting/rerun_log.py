# SPDX-License-Identifier: Apache-2.0
"""Sends what happens to a rerun viewer or into a file for it (optional extra `rerun`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggslam.errors import ConfigError, MissingDependency, RunFolderError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import matrix_to_quaternion
from ggslam.system.tuning import Tuning

VIEWER = "rerun"
_ENDING = ".rrd"


class RerunImageTuning(Tuning):
    """How images are sent to rerun."""

    jpeg_quality = 80
    """Quality of JPEG, of 100."""


def check_target(target: str) -> None:
    """Raises ConfigError unless `target` is "rerun" (a viewer is opened) or a file NAME.rrd in a folder that is there,
    MissingDependency if rerun is not installed."""
    if target != VIEWER:
        path = Path(target)
        if path.suffix != _ENDING:
            raise ConfigError(f"`log` {target}: expected rerun, to open a viewer, or a file NAME{_ENDING}")
        if not path.parent.is_dir():
            raise ConfigError(f"`log` {target}: no such folder: {path.parent}")
    try:
        from rerun import RecordingStream  # noqa: F401  (a mere folder of that name can be imported, too)
    except ImportError:
        raise MissingDependency("`log` needs rerun: pip install 'ggslam[rerun]'") from None


class RerunLog:
    """A stream to rerun. Entities: `world/camera` and below it `image` and `depth`, `world/map`, `world/path`,
    `world/movers/NUMBER`, `plots/NAME`; timelines `frame` and `time` (seconds since the first frame).

    Args:
        target: "rerun" or a file, see `check_target`.
        name: of the run, for the viewer's title.

    Raises:
        ConfigError, MissingDependency: as `check_target`.
        RunFolderError: the file cannot be written, or no viewer can be opened.
    """

    def __init__(self, target: str, name: str) -> None:
        check_target(target)
        import rerun

        self._rr: Any = rerun
        self._stream: Any = rerun.RecordingStream("ggslam", recording_id=None)
        self._first: float | None = None
        try:
            if target == VIEWER:
                self._stream.spawn()
            else:
                self._stream.save(target)
        except (OSError, RuntimeError) as error:
            raise RunFolderError(f"`log` {target}: {error}") from None
        self._stream.send_recording_name(name)
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)

    def camera(self, camera: Camera) -> None:
        """The camera of all frames."""
        K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        pinhole = self._rr.Pinhole(image_from_camera=K, width=camera.width, height=camera.height)
        self._stream.log("world/camera", pinhole, static=True)

    def moment(self, frame: int, timestamp: float) -> None:
        """What is sent from now on belongs to this frame; timestamp in seconds."""
        self._first = timestamp if self._first is None else self._first
        self._stream.set_time("frame", sequence=frame)
        self._stream.set_time("time", duration=timestamp - self._first)

    def pose(self, T_world_camera: np.ndarray) -> None:
        """Where the camera is [4, 4]."""
        T = np.asarray(T_world_camera)
        self._stream.log("world/camera", self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def image(self, color: np.ndarray) -> None:
        """What the camera sees, uint8 [H, W, 3]; sent as JPEG."""
        good, data = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, RerunImageTuning.jpeg_quality])
        if good:
            encoded = self._rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")
            self._stream.log("world/camera/image", encoded)

    def depth(self, depth: np.ndarray) -> None:
        """Depth float [H, W] metres, 0 = none; sent in millimetres."""
        millimetres = np.clip(np.rint(depth * 1000), 0, 65535).astype(np.uint16)
        self._stream.log("world/camera/depth", self._rr.DepthImage(millimetres, meter=1000.0))

    def points(self, positions: np.ndarray, colors: np.ndarray, radii: np.ndarray) -> None:
        """The map: positions [N, 3] and radii [N] in metres, colours uint8 [N, 3]."""
        self._stream.log("world/map", self._rr.Points3D(positions, colors=colors, radii=radii))

    def path(self, positions: np.ndarray) -> None:
        """The camera's positions so far [N, 3]."""
        self._stream.log("world/path", self._rr.LineStrips3D([positions]))

    def box(self, number: int, T_world_box: np.ndarray, size: np.ndarray) -> None:
        """The box about a mover: its pose [4, 4], the origin in its middle, and its size [3], metres."""
        w, x, y, z = matrix_to_quaternion(T_world_box[:3, :3]).tolist()
        box = self._rr.Boxes3D(
            centers=[T_world_box[:3, 3]], half_sizes=[size / 2], quaternions=[self._rr.Quaternion(xyzw=[x, y, z, w])],
            labels=[f"mover {number}"],
        )  # fmt: skip
        self._stream.log(f"world/movers/{number}", box)

    def drop_box(self, number: int) -> None:
        """The mover moves no more."""
        self._stream.log(f"world/movers/{number}", self._rr.Clear(recursive=False))

    def scalars(self, values: dict[str, float]) -> None:
        """Numbers that become curves; those that are not finite are left out."""
        for name, value in values.items():
            if np.isfinite(value):
                self._stream.log(f"plots/{name}", self._rr.Scalars(value))

    def close(self) -> None:
        """Sends what waits; nothing can be sent any more."""
        self._stream.flush()
        self._stream.disconnect()
