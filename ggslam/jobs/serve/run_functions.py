# SPDX-License-Identifier: Apache-2.0
"""What a finished run answers."""

from __future__ import annotations

import base64
import binascii
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggslam.errors import ConfigError, SequenceError
from ggslam.jobs.localize.single_frames import FrameLocalizer
from ggslam.jobs.plan.plan_path import plan_path
from ggslam.jobs.serve.channels import FLOOR, MAP
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.run_contents import RunContents
from ggslam.jobs.serve.services import Function, choice_in, point_in, points_in, text_in
from ggslam.messages.contents import Verdicts
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, matrix_to_quaternion, transform_points
from ggslam.system.images import decode_image
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import copy_untrusted_folder, is_plain_name
from ggslam.volumes.esdf import FieldValues


class LocalizeTuning(Tuning):
    """Images that are located."""

    max_pixels = 16_000_000
    """Largest image, in pixels."""
    depth_scale = 1000.0
    """Units of a depth image per metre, unless it is told."""


def save_target(beside: Path, name: str) -> Path:
    """Where a map of the asked name is saved: a new folder or file in `beside`, whatever is asked.

    Raises:
        ConfigError: it is no name, or there is something.
    """
    if not is_plain_name(name) or not name.isprintable() or name[0] in ".-":  # hidden, or an option
        raise ConfigError(f"name: expected a name to save as, of something new in {beside}")
    if (beside / name).exists():
        raise ConfigError(f"name: {beside / name} is there already")
    return beside / name


def verdict_values(verdicts: Verdicts) -> list[dict[str, Any]]:
    """For JSON."""
    return [{"name": v.name, "level": v.level, "text": v.text, "values": v.values} for v in verdicts.verdicts]


def distance_values(found: FieldValues, R_map_frame: np.ndarray, most_m: float) -> dict[str, Any]:
    """For JSON: distances with gradients in a frame whose axes in the map's are R_map_frame [3, 3]."""
    return {
        "distance": [float(d) if known else None for d, known in zip(found.distance, found.known, strict=True)],
        "gradient": (found.gradient @ R_map_frame).astype(float).tolist(), "known": found.known.tolist(),
        "most_m": most_m,
    }  # fmt: skip


class RunFunctions:
    """Functions of a finished run.

    Args:
        contents: of the run.
        publisher: of its contents.
    """

    def __init__(self, contents: RunContents, publisher: MapPublisher) -> None:
        self._contents, self._publisher = contents, publisher
        self._folder, self._volumes = contents.folder, contents.volumes
        self._localizer: FrameLocalizer | None = None

    def functions(self) -> dict[str, Function]:
        """By name."""
        return {
            "status": self.status, "verdicts": self.verdicts, "save_map": self.save_map, "localize": self.localize,
            "query_distance": self.query_distance, "plan": self.plan,
        }  # fmt: skip

    def status(self, values: dict[str, Any]) -> dict[str, Any]:
        """What is published."""
        return {
            "map": str(self._folder.path), "live": False, "frames": len(self._contents.poses),
            "published": self._publisher.record(), "problems": dict(self._contents.problems),
        }  # fmt: skip

    def verdicts(self, values: dict[str, Any]) -> dict[str, Any]:
        """How good the run is."""
        return {"verdicts": verdict_values(self._contents.verdicts())}

    def save_map(self, values: dict[str, Any]) -> dict[str, Any]:
        """Copies the run."""
        source = self._folder.path.resolve()
        target = save_target(source.parent, text_in(values, "name"))
        if not source.is_dir():
            raise ConfigError(f"{source}: is a file; copy it")
        staged = target.with_name(f".{target.name}-{secrets.token_hex(4)}")
        try:
            copy_untrusted_folder(source, staged, error=ConfigError)
            staged.rename(target)
        except (OSError, ConfigError) as error:
            shutil.rmtree(staged, ignore_errors=True)
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{target}: cannot be written: {error.strerror or error}") from None
        return {"path": str(target)}

    def query_distance(self, values: dict[str, Any]) -> dict[str, Any]:
        """Distances at points of the map's or the floor's frame; null where nothing is known."""
        points, frame = points_in(values, "points"), choice_in(values, "frame", (MAP, FLOOR))
        field = self._volumes.field()
        T_map_frame = np.eye(4)
        if frame == FLOOR:
            T_map_frame = inverse(self._volumes.floor())
        found = field.query(transform_points(points, T_map_frame))
        return distance_values(found, T_map_frame[:3, :3], field.settings.max_distance)

    def plan(self, values: dict[str, Any]) -> dict[str, Any]:
        """A path on the floor."""
        start, goal = point_in(values, "start"), point_in(values, "goal")
        frame = choice_in(values, "frame", (MAP, FLOOR))
        robot = text_in(values, "robot", "") or None
        place = self._volumes.place()
        found = plan_path(place, start.tolist(), goal.tolist(), robot=robot, frame=frame)
        if not found.is_found:
            return {"found": False, "reason": str(found.reason), "frame": frame, "points": []}
        return {"found": True, "frame": frame, "points": found.points.tolist(), "length_m": float(found.length),
                "least_clearance_m": float(found.least_clearance)}  # fmt: skip

    # --- localising --------------------------------------------------------------------------------------------------

    def localize(self, values: dict[str, Any]) -> dict[str, Any]:
        """Pose of an image with depth."""
        color = _image(values, "color", cv2.IMREAD_COLOR)[..., ::-1]
        depth = _image(values, "depth", cv2.IMREAD_UNCHANGED)
        scale = values.get("depth_scale", LocalizeTuning.depth_scale)
        if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 1e-3 <= scale <= 1e6:
            raise ConfigError(f"depth_scale: expected units per metre, found {str(scale)[:40]}")
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise ConfigError("depth: expected a PNG of one channel with 16 bits")
        metres = depth.astype(np.float32) * np.float32(1 / scale)
        return self.locate(np.ascontiguousarray(color), metres, _camera(values.get("camera")))

    def locate(self, color: np.ndarray, depth: np.ndarray, camera: Camera | None) -> dict[str, Any]:
        """The same of arrays.

        Args:
            color: uint8 [H, W, 3].
            depth: float32 [H, W], metres, 0: none.
            camera: of both; None: that of the run, for whose size the images are scaled.

        Raises:
            GgslamError: images and camera do not fit, or the map cannot be read.
        """
        if depth.shape != color.shape[:2]:
            raise ConfigError(f"depth: expected the size of color, {color.shape[1]}x{color.shape[0]}")
        if camera is None:
            camera = self._contents.camera
            color, depth = _to_size(color, depth, camera)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        if self._localizer is None:
            self._localizer = FrameLocalizer(self._folder.path)
        try:
            found = self._localizer.locate(Frame(0, 0, 0.0, color, depth, camera))
        except SequenceError as error:
            raise ConfigError(f"color, depth: {error}") from None
        if not found.status.is_located:
            return {"located": False, "reason": found.reason or "it was not found in the map"}
        T = found.T_world_sensor
        return {
            "located": True, "frame": MAP, "position": T[:3, 3].tolist(),
            "orientation_wxyz": matrix_to_quaternion(T[:3, :3]).tolist(), "T_map_optical": T.tolist(),
            "overlap": float(found.overlap), "rmse_m": float(found.rmse_m),
        }  # fmt: skip

    def close(self) -> None:
        """Removes what was made of the map."""
        if self._localizer is not None:
            self._localizer.close()
            self._localizer = None


def _image(values: Mapping[str, Any], name: str, flags: int) -> np.ndarray:
    given = values.get(name)
    if not isinstance(given, str):
        raise ConfigError(f"{name}: expected an image in base64, found {type(given).__name__}")
    try:
        content = base64.b64decode(given, validate=True)
    except (binascii.Error, ValueError):
        raise ConfigError(f"{name}: is no base64") from None
    return decode_image(name, content, flags, LocalizeTuning.max_pixels, ConfigError)


def _camera(given: object) -> Camera | None:
    if given is None:
        return None
    if not isinstance(given, dict):
        raise ConfigError(f"camera: expected width, height, fx, fy, cx, cy, found {type(given).__name__}")
    try:
        return Camera(**given)
    except Exception:
        raise ConfigError("camera: expected numbers width, height, fx, fy, cx, cy of a camera") from None


def _to_size(color: np.ndarray, depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Images as large as the camera's."""
    height, width = depth.shape
    if (width, height) == (camera.width, camera.height):
        return color, depth
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        expected = f"expected {camera.width}x{camera.height} or a multiple of it, or camera"
        raise ConfigError(f"color: {expected}, found {width}x{height}")
    size = (camera.width, camera.height)
    return (
        cv2.resize(color, size, interpolation=cv2.INTER_AREA),
        cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST),
    )
