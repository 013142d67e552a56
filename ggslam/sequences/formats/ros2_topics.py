# SPDX-License-Identifier: Apache-2.0
"""A live camera of ROS 2: colour, depth and camera_info of topics, read as a bag of them would be. The newest pair
wins: what comes while a frame is worked on is overwritten and counted, never queued."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

from ggslam.errors import GgslamError, SequenceError
from ggslam.middleware.node import SENSOR_DATA, Node, Qos, Subscription
from ggslam.middleware.opening import open_node
from ggslam.middleware.types import message_types
from ggslam.scene.frame import Frame
from ggslam.sequences.formats.ros2_address import parse_address
from ggslam.sequences.formats.ros2_discovery import find_live_topics, seen_topics, wait_until
from ggslam.sequences.formats.ros2_frames import FrameMaker, TopicInfos
from ggslam.sequences.formats.ros2_inbox import ImagePair, PairInbox
from ggslam.sequences.formats.ros2_infos import CAMERA_INFO, TF, InfoTuning, LiveInfos
from ggslam.sequences.formats.ros_topics import STATIC_FRAMES
from ggslam.system.tuning import Tuning


class LiveTopicsTuning(Tuning):
    """How a live camera is waited for."""

    slice_s = 0.1
    """Seconds between two looks at whether to end while nothing comes."""
    silent_s = 5.0
    """Seconds of silence after which it is told."""
    depth_info_s = 1.0
    """Longest wait for a camera_info of depth after that of colour."""
    tries = 5
    """Pairs that are tried until one can be read."""


class Ros2Camera:
    """Images of two topics; see `live.LiveSource`.

    Args:
        address: as `ros2://camera/color,camera/depth`, see `ros2_address`.
        scale: size of the delivered images, in (0, 1].
        node: to read them with; None: one that the address tells.

    Raises:
        MissingDependency: a package is needed for it.
        MiddlewareError: the network cannot be joined.
        SequenceError: something that is needed does not come, or cannot be read; says what.
    """

    def __init__(self, address: str, scale: float = 1.0, node: Node | None = None) -> None:
        self._address = parse_address(address)
        self._types = message_types(self._address.node.distribution)
        self._node = open_node(self._address.node, "ggslam_camera") if node is None else node
        self._ends: list[Subscription] = []
        self._going_on: Callable[[], bool] = lambda: True
        self._say: Callable[[str], None] = lambda text: None
        self.arrived = 0.0
        try:
            self._topics = find_live_topics(self._node, self._address)
            self._inbox = PairInbox((self._topics["color"], self._topics["depth"]), self._address.tolerance_s)
            self._infos = LiveInfos(self._types)
            self._frames = self._begin(scale)
        except BaseException:
            self.close()
            raise
        self.name = self._topics["color"].strip("/").replace("/", "-")
        self.camera, self.warnings = self._frames.camera, self._frames.warnings

    def _begin(self, scale: float) -> FrameMaker:
        """Subscribes, and waits for the first images and the cameras."""
        kinds = self._node.topics()
        sensor = Qos(depth=SENSOR_DATA.depth) if self._address.reliable else SENSOR_DATA
        for role, take in (("color", self._inbox.taker("color")), ("depth", self._inbox.taker("depth"))):
            topic = self._topics[role]
            self._ends.append(self._node.subscribe(topic, kinds[topic], sensor, take))
        for topic in dict.fromkeys(self._topics[role] for role in self._topics if role.endswith("_info")):
            self._ends.append(self._node.subscribe(topic, CAMERA_INFO, sensor, self._infos.taker(topic)))
        fixed = Qos(latched=True, depth=InfoTuning.messages)
        self._ends.append(self._node.subscribe(STATIC_FRAMES, TF, fixed, self._infos.take_fixed))
        return self._read_first(scale)

    def _read_first(self, scale: float) -> FrameMaker:
        """Reads the first pair that can be read; it is still the first frame, if no newer one comes meanwhile."""
        end, topics, problem = time.monotonic() + self._address.wait_s, self._topics, ""
        wait_until(lambda: self._infos.tells_camera(topics["color_info"]), self._address.wait_s)
        for _ in range(LiveTopicsTuning.tries):
            pair = None
            while pair is None and (time.monotonic() < end or not problem):
                pair = self._inbox.take(LiveTopicsTuning.slice_s)
                problem = problem or (self._what_is_missing() if time.monotonic() > end else "")
            if pair is None or not self._infos.tells_camera(topics["color_info"]):
                raise SequenceError(problem or self._what_is_missing())
            if "depth_info" in topics:
                wait_until(lambda: self._infos.tells_camera(topics["depth_info"]), LiveTopicsTuning.depth_info_s)
            try:
                maker = FrameMaker(
                    self._types, self._node.topics(), self._topic_infos(), pair, scale, self._infos.wait_for_fixed
                )  # fmt: skip
            except GgslamError as error:
                self._inbox.note_damage(f"{topics['color']} or {topics['depth']}", str(error))
                problem = str(error)
                continue
            self._inbox.give_back(pair)
            return maker
        raise SequenceError(problem)

    def _topic_infos(self) -> TopicInfos:
        depth_info = self._topics.get("depth_info")
        return TopicInfos(
            self._topics["color"], self._topics["depth"], self._topics["color_info"],
            self._infos.found[self._topics["color_info"]], depth_info,
            None if depth_info is None else self._infos.found.get(depth_info),
        )  # fmt: skip

    def _what_is_missing(self) -> str:
        """Why there is no first frame."""
        within = f"within {self._address.wait_s:g} s"
        heard = {"color": self._inbox.received["color"], "depth": self._inbox.received["depth"]}
        silent = [self._topics[role] for role, count in heard.items() if not count]
        info = self._topics["color_info"]
        if not self._infos.tells_camera(info):
            if info in self._infos.found:
                return f"`{info}`: tells no camera {within}: its K is zero"
            silent.append(info)
        if silent:
            names = " and ".join(f"`{topic}`" for topic in silent)
            return f"no message on {names} {within}; seen: {seen_topics(self._node.topics())}"
        return f"{self._why_unpaired()} ({within})"

    def _why_unpaired(self) -> str:
        closest, tolerance = self._inbox.matcher.closest_s, self._address.tolerance_s
        gap = f"; the closest are {closest:.3f} s apart: try ?tolerance={1.2 * closest:.2g}" if closest < 1 else ""
        return (
            f"`{self._topics['color']}` and `{self._topics['depth']}` come, but no two images were taken within "
            f"{tolerance:g} s of one another{gap}"
        )

    # --- frames ------------------------------------------------------------------------------------------------------

    def follow(self, going_on: Callable[[], bool], say: Callable[[str], None]) -> None:
        """While nothing comes, frames are waited for as long as `going_on()`; `say` is told what happens."""
        self._going_on, self._say = going_on, say

    def frames(self) -> Iterator[Frame]:
        """Yields the newest pair on each request. Where time goes back, later frames go on in time."""
        index, last, step, shift = 0, None, 1 / 30, 0.0
        while (pair := self._next_pair()) is not None:
            try:
                frame = self._frames.frame(index, pair)
            except GgslamError as error:
                self._inbox.note_damage(f"{self._topics['color']} or {self._topics['depth']}", str(error))
                continue
            time_of = frame.timestamp + shift
            if last is not None and time_of <= last:
                shift += last + step - time_of
                back = f"frame {index}: time went back by {last - time_of:.1f} s"
                self._say(f"{back}; from here on {shift:.3f} s is added")
            elif last is not None:
                step = time_of - last
            last = frame.timestamp + shift
            self.arrived = pair.arrived
            yield replace(frame, timestamp=last)
            index += 1

    def _next_pair(self) -> ImagePair | None:
        """The newest pair, however long it takes; None: the frames end."""
        began, told, before = time.monotonic(), False, self._inbox.received.total()
        while self._going_on():
            pair = self._inbox.take(LiveTopicsTuning.slice_s)
            for text in [*self._inbox.events(), *self._infos.events()]:
                self._say(text)
            silent = time.monotonic() - began
            if pair is not None:
                if told:
                    self._say(f"images come again after {silent:.0f} s")
                return pair
            if self._address.idle_s is not None and silent > self._address.idle_s:
                self._say(f"no images for {silent:.1f} s (idle={self._address.idle_s:g}): the recording ends")
                return None
            if not told and silent > LiveTopicsTuning.silent_s:
                told = True
                names = f"`{self._topics['color']}` and `{self._topics['depth']}`"
                why = f"no images from {names}" if self._inbox.received.total() == before else self._why_unpaired()
                self._say(f"{why}, for {silent:.0f} s; waiting (Ctrl-C ends)")
        return None

    def counts(self) -> dict[str, int]:
        """What came and what became of it, so far."""
        lost, overrun = (sum(getattr(end, name) for end in self._ends[:2]) for name in ("lost", "overrun"))
        return {**self._inbox.counts(), "lost": lost, "overrun": overrun}

    def reasons(self) -> dict[str, int]:
        """Why images were left out, and how often."""
        return self._inbox.reasons()

    def close(self) -> None:
        """Leaves the network. What was counted stays."""
        self._node.close()
