# SPDX-License-Identifier: Apache-2.0
"""Things as vision_msgs/Detection3DArray, verdicts as diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ggslam.messages.contents import Thing, Things, Verdicts
from ggslam.messages.ros2_geometry import pose, vector
from ggslam.messages.ros2_images import header
from ggslam.messages.sound_content import plain_text
from ggslam.middleware.types import MessageTypes

DETECTIONS: Final = "vision_msgs/msg/Detection3DArray"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
LEVELS: Final = {"ok": 0, "warning": 1, "error": 2}
"""Of diagnostic_msgs/DiagnosticStatus."""


def detections_message(types: MessageTypes, content: Things, stamp: float) -> bytes:
    """vision_msgs/Detection3DArray: one hypothesis, its name, for each thing; `id` is the thing's."""
    head = header(types, plain_text(content.frame), stamp)
    made = types.make(DETECTIONS, header=head, detections=[_detection(types, head, t) for t in content.things])
    return types.encode(DETECTIONS, made)


def _detection(types: MessageTypes, head: Any, thing: Thing) -> Any:
    place = pose(types, thing.T)
    hypothesis = types.make(
        "vision_msgs/msg/ObjectHypothesis", class_id=plain_text(thing.name), score=float(thing.score)
    )
    uncertain = types.make("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=np.zeros(36))
    box = types.make("vision_msgs/msg/BoundingBox3D", center=place, size=vector(types, thing.size))
    result = types.make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=uncertain)
    return types.make("vision_msgs/msg/Detection3D", header=head, results=[result], bbox=box, id=str(thing.id))


def diagnostics_message(types: MessageTypes, content: Verdicts, stamp: float) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    statuses = []
    for verdict in content.verdicts:
        values = [
            types.make("diagnostic_msgs/msg/KeyValue", key=plain_text(key), value=plain_text(value))
            for key, value in verdict.values.items()
        ]
        statuses.append(
            types.make(
                "diagnostic_msgs/msg/DiagnosticStatus", level=LEVELS[verdict.level], name=plain_text(verdict.name),
                message=plain_text(verdict.text), hardware_id="ggslam", values=values,
            )
        )  # fmt: skip
    return types.encode(DIAGNOSTICS, types.make(DIAGNOSTICS, header=header(types, "", stamp), status=statuses))
