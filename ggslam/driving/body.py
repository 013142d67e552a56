# SPDX-License-Identifier: Apache-2.0
"""The robot's own body in front of its sensor: rays that it ends or hides tell nothing of the world.

A ray that enters the body before it ends is no measurement, wherever it ends: what lies behind a solid body cannot be
seen, so such a reading comes from the body's edge, where depth is mixed, and would leave obstacles beside the robot
wherever it goes. What is hidden stays unknown, and unknown space is not free. A shape that the sensor itself is in,
such as its housing or a box around the whole robot, hides only the readings that end in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class BodyTuning(Tuning):
    """How bodies are cut out."""

    margin_m = 0.03
    """Metres by which shapes are taken larger: depth noise, and models that are not exact."""


@dataclass(frozen=True)
class BodyShape:
    """A solid part of a body.

    Attributes:
        kind: of the shape; a cylinder's axis is its z axis.
        half: [3], half of its extent along its own axes, metres; of a cylinder and a sphere the first is the radius.
        T_sensor_shape: float64 [4, 4].
    """

    kind: Literal["box", "cylinder", "sphere"]
    half: tuple[float, float, float]
    T_sensor_shape: np.ndarray

    def span(self, ends: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
        """Where rays from the sensor to `ends` [..., 3] enter and leave the shape, both [...], in lengths of the rays:
        1 is at the end. Negative: behind the sensor; rays that miss it enter at inf and leave at -inf."""
        T = inverse(self.T_sensor_shape)
        start, way = T[:3, 3], ends.astype(np.float64) @ T[:3, :3].T
        grown = np.array(self.half) + margin
        if self.kind == "sphere":
            return _round_span(start, way, grown[0])
        if self.kind == "box":
            return _slab_span(start, way, grown)
        sides, caps = _round_span(start[:2], way[..., :2], grown[0]), _slab_span(start[2:], way[..., 2:], grown[2:])
        return _common(np.maximum(sides[0], caps[0]), np.minimum(sides[1], caps[1]))


def _common(enter: np.ndarray, leave: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    missed = ~(enter <= leave)
    return np.where(missed, np.inf, enter), np.where(missed, -np.inf, leave)


def _slab_span(start: np.ndarray, way: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of start [k] + t way [..., k] within +- half [k]."""
    enter, leave = np.full(way.shape[:-1], -np.inf), np.full(way.shape[:-1], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(len(half)):
            # Along a slab: everywhere in it, or nowhere.
            still, inside = way[..., axis] == 0, abs(start[axis]) <= half[axis]
            ends = [(side * half[axis] - start[axis]) / way[..., axis] for side in (-1, 1)]
            low = np.where(still, -np.inf if inside else np.inf, np.minimum(*ends))
            high = np.where(still, np.inf if inside else -np.inf, np.maximum(*ends))
            enter, leave = np.maximum(enter, low), np.minimum(leave, high)
    return _common(enter, leave)


def _round_span(start: np.ndarray, way: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Of start [k] + t way [..., k] within `radius` of zero."""
    a, b, c = (way**2).sum(-1), way @ start, float(start @ start) - radius**2
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(b * b - a * c)
        enter, leave = (-b - root) / a, (-b + root) / a
    still = a == 0  # along a cylinder's axis, or of no length
    enter = np.where(still, -np.inf if c <= 0 else np.inf, enter)
    return _common(enter, np.where(still, np.inf if c <= 0 else -np.inf, leave))


@dataclass(frozen=True, eq=False)
class Body:
    """The parts of a body that keep their places relative to the sensor.

    Attributes:
        shapes: in the frame of the sensor; of a camera x is right, y down, z forward.
        margin: metres by which they are taken larger.
    """

    shapes: tuple[BodyShape, ...]
    margin: float = BodyTuning.margin_m

    def hides(self, ends: np.ndarray) -> np.ndarray:
        """Which rays from the sensor to `ends` [..., 3] in its frame, metres, tell nothing: bool [...]. That is so of
        points of a scan and of a depth image alike."""
        hidden = np.zeros(ends.shape[:-1], bool)
        for low, high in self._spans(ends):
            hidden |= (low <= 1) & (high >= 1)
        return hidden

    def without(self, points: np.ndarray) -> np.ndarray:
        """Those of a scan's points [n, 3 or more], in the sensor's frame, that tell something."""
        return np.asarray(points[~self.hides(points[:, :3])])

    def in_frame(self, T_new_sensor: np.ndarray) -> Body:
        """The same in another sensor's frame."""
        shapes = tuple(replace(s, T_sensor_shape=T_new_sensor @ s.T_sensor_shape) for s in self.shapes)
        return Body(shapes, self.margin)

    def hidden_depth(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Which pixels of a depth image [H, W] (metres, 0 none, +inf nothing found) tell nothing: bool [H, W]."""
        hidden = np.zeros(depth.shape, bool)
        for low, high in _pixel_spans(self, camera):
            hidden |= (depth >= low) & (depth <= high)
        return hidden & (depth > 0)

    def _spans(self, ends: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Of each shape: the lengths of rays towards `ends` [..., 3], in their own, between which they are hidden."""
        for shape in self.shapes:
            enter, leave = shape.span(ends, self.margin)
            if self._is_around_sensor(shape):
                yield np.zeros_like(enter), leave
            else:
                ahead = leave >= 0
                yield np.where(ahead, enter, np.inf), np.where(ahead, np.inf, -np.inf)

    def _is_around_sensor(self, shape: BodyShape) -> bool:
        enter, leave = shape.span(np.eye(3), self.margin)
        return bool((enter <= 0).all() and (leave >= 0).all())


class CameraBody:
    """A body as the cameras of a recording have it.

    Args:
        body: in the frame of the camera, of a rig in that of its first one.
        T_first_camera: [n, 4, 4], of a rig's cameras, see `scene.rig`; None: one camera.
    """

    def __init__(self, body: Body, T_first_camera: np.ndarray | None = None) -> None:
        self._bodies = [body] if T_first_camera is None else [body.in_frame(T) for T in inverse(T_first_camera)]

    def without(self, frame: Frame) -> Frame:
        """A frame whose depth, and where its sensor found nothing, leave out what the body hides."""
        hidden = self.hidden_pixels(frame.depth_or_infinity(), frame.camera, frame.camera_number)
        if not hidden.any():
            return frame
        no_return = None if frame.no_return is None else frame.no_return & ~hidden
        return replace(frame, depth=np.where(hidden, np.float32(0), frame.depth), no_return=no_return)

    def hidden_pixels(self, depth: np.ndarray, camera: Camera, number: int = 0) -> np.ndarray:
        """Pixels, bool [H, W], of a depth image of camera `number` that tell nothing."""
        return self._bodies[number].hidden_depth(depth, camera)


@lru_cache(maxsize=8)
def _pixel_spans(body: Body, camera: Camera) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each shape that is in view: the depths between which pixels are hidden, float32 [H, W] each."""
    spans = [(low.astype(np.float32), high.astype(np.float32)) for low, high in body._spans(camera.rays())]
    return [(low, high) for low, high in spans if (low <= high).any()]
