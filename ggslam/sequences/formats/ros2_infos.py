# SPDX-License-Identifier: Apache-2.0
"""What is told of live cameras: their camera_info, and the frames that stand still to each other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from ggslam.errors import GgslamError
from ggslam.middleware.node import Received
from ggslam.middleware.types import MessageTypes
from ggslam.sequences.formats.ros2_discovery import wait_until
from ggslam.sequences.formats.ros2_inbox import HEAD_BYTES
from ggslam.sequences.formats.ros_calibration import is_calibrated
from ggslam.system.tuning import Tuning

CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
TF: Final = "tf2_msgs/msg/TFMessage"


class InfoTuning(Tuning):
    """How frames that stand still are waited for."""

    transform_s = 2.0
    """Longest wait for /tf_static to tell where the depth camera stands."""
    messages = 100
    """Messages of /tf_static that are kept."""


class LiveInfos:
    """The camera_info of topics and the fixed frames, as they come.

    Attributes:
        found: topic -> its first message that tells a camera, until then the last one.
        fixed: messages of /tf_static.
    """

    def __init__(self, types: MessageTypes) -> None:
        self.found: dict[str, Any] = {}
        self.fixed: deque[Any] = deque(maxlen=InfoTuning.messages)
        self._types = types
        self._content: dict[str, bytes] = {}
        self._changed: set[str] = set()
        self._events: list[str] = []
        self._lock = threading.Lock()

    def taker(self, topic: str) -> Callable[[Received], None]:
        """What the subscription of a topic calls."""
        return lambda received: self._take(topic, received)

    def _take(self, topic: str, received: Received) -> None:
        content = received.content[HEAD_BYTES:]
        if self._content.get(topic) == content:  # what differs is the time
            return
        try:
            info = self._types.decode(CAMERA_INFO, received.content)
            whole = is_calibrated(info)
        except (GgslamError, ValueError, IndexError):
            return
        with self._lock:
            first = self._content.get(topic)
            if first is None or not self.tells_camera(topic):
                self.found[topic] = info
                if whole:
                    self._content[topic] = content
            elif whole and topic not in self._changed:
                self._changed.add(topic)
                self._events.append(f"{topic} tells another camera than at the start: the first one is kept")

    def tells_camera(self, topic: str) -> bool:
        """Whether a camera_info came that tells one."""
        return topic in self.found and is_calibrated(self.found[topic])

    def take_fixed(self, received: Received) -> None:
        """A message of /tf_static."""
        try:
            self.fixed.append(self._types.decode(TF, received.content))
        except GgslamError:
            return

    def events(self) -> list[str]:
        """What happened since this was asked last, in words."""
        with self._lock:
            events, self._events = self._events, []
        return events

    def wait_for_fixed(self, known: Callable[[list[Any]], bool]) -> list[Any]:
        """Messages of /tf_static, once they tell what is asked for, or time is up."""
        wait_until(lambda: known(list(self.fixed)), InfoTuning.transform_s)
        return list(self.fixed)
