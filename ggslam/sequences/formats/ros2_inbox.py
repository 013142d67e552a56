# SPDX-License-Identifier: Apache-2.0
"""Images as they come over the network, paired by time; the newest pair waits to be taken, still encoded."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from ggslam.middleware.node import Received
from ggslam.sequences.formats.ros_messages import cdr_stamp
from ggslam.sequences.live_pairs import Kind, PairMatcher, Stamped
from ggslam.system.tuning import Tuning

HEAD_BYTES: Final = 12
"""CDR's head of four bytes and the time of a std_msgs/Header."""


class InboxTuning(Tuning):
    """What is told of what comes."""

    told = 3
    """Damaged messages, and jumps of a clock, that are told one by one; the others are only counted."""
    settle_s = 0.2
    """Seconds without an image after which no better partner is waited for."""
    alive_s = 1.0
    """Seconds since its last image that a publisher counts as one that still sends."""


@dataclass(frozen=True)
class ImagePair:
    """A pair of image messages; `arrived`: when it was complete, seconds since 1970."""

    color: Stamped[Received]
    depth: Stamped[Received]
    arrived: float


def stamp_of(content: bytes) -> float | None:
    """Time in the header of a message, seconds; None: it is no whole header."""
    if len(content) <= HEAD_BYTES:
        return None
    return cdr_stamp(content[:HEAD_BYTES])


def _with_time(pair: ImagePair) -> ImagePair:
    """A pair whose stamps are those of its coming, where it has none."""
    color, depth = (replace(i, stamp=i.content.at) if i.stamp == 0 else i for i in (pair.color, pair.depth))
    return replace(pair, color=color, depth=depth)


class PairInbox:
    """Takes image messages in the middleware's threads and holds the newest pair for whoever asks: one that was not
    taken in time makes room and is counted.

    Args:
        topics: names of colour and depth, for messages.
        tolerance_s: largest time between the two.
    """

    def __init__(self, topics: tuple[str, str], tolerance_s: float) -> None:
        self.received: Counter[str] = Counter()
        self.pairs = self.overwritten = self.taken = 0
        self.damaged: Counter[str] = Counter()
        self._topics: dict[Kind, str] = {"color": topics[0], "depth": topics[1]}
        self._matcher: PairMatcher[Received] = PairMatcher(tolerance_s)
        self._zeros: Counter[Kind] = Counter()
        self._writers: dict[Kind, dict[str, float]] = {"color": {}, "depth": {}}
        self._told_writers: dict[Kind, bool] = {"color": False, "depth": False}
        self._slot: ImagePair | None = None
        self._last_at = 0.0
        self._events: deque[str] = deque(maxlen=20)
        self._changed = threading.Condition()

    @property
    def matcher(self) -> PairMatcher[Received]:
        """What pairs the images; its counts may be read."""
        return self._matcher

    def taker(self, kind: Kind) -> partial[None]:
        """What a subscription of colour or depth calls."""
        return partial(self._add, kind)

    def _add(self, kind: Kind, received: Received) -> None:
        with self._changed:
            self.received[kind] += 1
            self._last_at = time.monotonic()
            self._note_writer(kind, received.writer)
            stamp = stamp_of(received.content)
            if stamp is None:
                return self._note_damage(self._topics[kind], f"{len(received.content)} bytes are no message")
            jumps = self._matcher.jumps
            # Drivers that leave the time out write 0 each time; then it is that of coming.
            self._zeros[kind] = self._zeros[kind] + 1 if stamp == 0 else 0
            if self._slot is not None and self._zeros[kind] > 1:
                self._slot = _with_time(self._slot)
            for pair in self._matcher.add(kind, received.at if self._zeros[kind] > 1 else stamp, received):
                self._put(*pair)
            if self._matcher.jumps > jumps:
                self._tell_jump(self._topics[kind])
        return None

    def _tell_jump(self, topic: str) -> None:
        if self._matcher.jumps > InboxTuning.told:
            return
        back = self._matcher.went_back_s
        self._events.append(f"the time of {topic} went back by {back:.1f} s (played again?): matching begins anew")

    def _put(self, color: Stamped[Received], depth: Stamped[Received]) -> None:
        self.pairs += 1
        self.overwritten += self._slot is not None
        self._slot = ImagePair(color, depth, max(color.content.at, depth.content.at))
        self._changed.notify_all()

    def take(self, timeout_s: float) -> ImagePair | None:
        """The newest pair; None: none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._slot is not None, timeout_s)
            if self._slot is None and time.monotonic() - self._last_at > InboxTuning.settle_s:
                for settled in self._matcher.settle():
                    self._put(*settled)
            pair, self._slot = self._slot, None
            self.taken += pair is not None
            return pair

    def give_back(self, pair: ImagePair) -> None:
        """A pair that was taken only to look at it; where a newer one waits, that one counts."""
        with self._changed:
            self.taken -= 1
            if self._slot is None:
                self._slot = _with_time(pair) if max(self._zeros.values(), default=0) > 1 else pair
            else:
                self.overwritten += 1

    def _note_writer(self, kind: Kind, writer: str) -> None:
        """Two cameras on one topic take turns; one that was started anew does not come back as it was."""
        now, seen = time.monotonic(), self._writers[kind]
        alive = [other for other, at in seen.items() if now - at < InboxTuning.alive_s]
        takes_turns = writer in alive and next(reversed(seen)) != writer
        if takes_turns and not self._told_writers[kind]:
            self._told_writers[kind] = True
            self._events.append(f"two publishers send to {self._topics[kind]} at once: their images are mixed")
        seen.pop(writer, None)
        seen[writer] = now  # the newest last

    def note_damage(self, topic: str, why: str) -> None:
        """A message that could not be decoded."""
        with self._changed:
            self._note_damage(topic, why)

    def _note_damage(self, topic: str, why: str) -> None:
        self.damaged[topic] += 1
        if self.damaged.total() <= InboxTuning.told:
            more = "; further ones are only counted" if self.damaged.total() == InboxTuning.told else ""
            self._events.append(f"a damaged message of {topic} was left out: {why}{more}")

    def events(self) -> list[str]:
        """What happened since this was asked last, in words."""
        with self._changed:
            events = list(self._events)
            self._events.clear()
            return events

    def counts(self) -> dict[str, int]:
        """Messages and pairs so far."""
        with self._changed:
            return {
                "color": self.received["color"], "depth": self.received["depth"], "pairs": self.pairs,
                "taken": self.taken, "waiting": int(self._slot is not None),
                "overwritten": self.overwritten, "unmatched": self._matcher.unmatched.total(),
                "damaged": self.damaged.total(),
            }  # fmt: skip

    def reasons(self) -> dict[str, int]:
        """Why images were left out, and how often."""
        with self._changed:
            damaged = {f"damaged, {topic}": count for topic, count in self.damaged.items()}
            return {name: count for name, count in {**self._matcher.unmatched, **damaged}.items() if count}
