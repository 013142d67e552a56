# SPDX-License-Identifier: Apache-2.0
"""Sends contents through one outlet, in a thread of its own: nobody who hands over contents waits for it."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ggslam.jobs.serve.channels import CHANGED, Flow, flow_of
from ggslam.messages.contents import Channel, Content, Grid
from ggslam.messages.outlet import Outlet
from ggslam.system.tuning import Tuning

_log = logging.getLogger(__name__)


class SendTuning(Tuning):
    """How much is sent, and what waits."""

    map_bytes_per_s = 900_000
    """Most bytes a second, in the long run, of what shows the map: points, splats, meshes, grids, paths."""
    image_bytes_per_s = 1_000_000
    """The same of images."""
    burst_s = 1.0
    """Seconds whose bytes may be sent at once after a pause."""
    waiting = 64
    """Poses, frames and other small contents of a channel that wait; of all else the newest alone does."""
    look_s = 0.5
    """Seconds between two looks at who listens."""
    end_s = 2.0
    """Seconds that an outlet is given to end."""


@dataclass(frozen=True)
class Given:
    """A content that was handed over.

    Attributes:
        channel, content, stamp: as of `Outlet.send`.
        part: which part of a channel's content this is; "" if it is all.
    """

    channel: Channel
    content: Content
    stamp: float
    part: str = ""


@dataclass
class ChannelCounts:
    """What became of a channel's contents: messages and bytes that were sent, and contents that made room for newer
    ones."""

    messages: int = 0
    bytes: int = 0
    left_out: int = 0


class _Budget:
    """Bytes that may be sent."""

    def __init__(self, bytes_per_s: float) -> None:
        self._rate, self._left, self._at = bytes_per_s, bytes_per_s * SendTuning.burst_s, time.monotonic()

    def wait_s(self) -> float:
        """Seconds until something may be sent."""
        now = time.monotonic()
        self._left = min(self._rate * SendTuning.burst_s, self._left + (now - self._at) * self._rate)
        self._at = now
        return 0.0 if self._left > 0 else -self._left / self._rate + 1e-3

    def take(self, count: int) -> None:
        """So many bytes were sent; what is too much is waited for later."""
        self._left -= count


class OutletSender:
    """Sends through one outlet. What nobody listens to is not sent; who begins to listen gets what there is.

    Args:
        outlet: called from this sender's thread only.
        channels: that are opened.
        newest: the newest contents of a channel, part by part.
        joined: is told of a channel that somebody began to listen to.
        is_file: whether it writes a file, which has no budget and leaves nothing out.
    """

    def __init__(
        self, outlet: Outlet, channels: Iterable[Channel], newest: Callable[[Channel], list[Given]],
        joined: Callable[[Channel], None], is_file: bool = False,
    ) -> None:  # fmt: skip
        self.outlet, self.is_file, self._joined = outlet, is_file, joined
        self.counts: dict[str, ChannelCounts] = {}
        self.cpu_s = dict.fromkeys(Flow, 0.0)
        """Processor seconds that this thread spent on messages."""
        self.failure = ""
        """Why something could not be sent, the first time."""
        self._newest = newest
        self._given = threading.Condition()
        self._waiting: dict[Flow, dict[tuple[str, str], deque[Given]]] = {flow: {} for flow in Flow}
        self._channels = {channel.name: channel for channel in channels}
        self._listening: dict[str, int] = {}
        self._sent: dict[tuple[str, str], Given] = {}
        self._looked, self._ended, self._busy = -1e9, False, False
        limits = {Flow.images: SendTuning.image_bytes_per_s, Flow.map: SendTuning.map_bytes_per_s}
        self._budgets = {} if is_file else {flow: _Budget(limit) for flow, limit in limits.items()}
        for channel in self._channels.values():
            outlet.open(channel)
        self._count_listeners()
        outlet.on_join(self.join)
        self._thread = threading.Thread(target=self._work, name=f"publish-{outlet.name}", daemon=True)
        self._thread.start()

    # --- in any thread -----------------------------------------------------------------------------------------------

    def listens(self, channel: Channel) -> bool:
        """Whether somebody listens to a channel, as of a moment ago."""
        return self._listening.get(channel.name, 0) > 0

    def put(self, given: Given) -> None:
        """Hands over a content, if somebody listens; never waits."""
        if not self.listens(given.channel):
            return
        with self._given:
            self._queue(given)
            self._given.notify()

    def join(self, channel: Channel) -> None:
        """Somebody began to listen: what came in parts is sent again as a whole, and what was not sent yet."""
        given = self._newest(channel)
        with self._given:
            self._listening[channel.name] = max(1, self._listening.get(channel.name, 0))
            again = len(given) > 1
            for one in given:
                if again or self._sent.get((one.channel.name, one.part)) is not one:
                    self._queue(one)
            self._looked = -1e9
            self._given.notify()
        self._joined(channel)

    def wait_idle(self, timeout_s: float) -> bool:
        """Waits until all is sent; returns whether it is."""
        with self._given:
            return self._given.wait_for(lambda: not self._busy and not any(self._waiting.values()), timeout_s)

    def close(self) -> bool:
        """Ends it; returns False if the outlet does not come to an end."""
        with self._given:
            self._ended = True
            self._given.notify_all()
        self._thread.join(SendTuning.end_s)
        return not self._thread.is_alive()

    def _queue(self, given: Given) -> None:
        """Notes what is to be sent; the lock is held."""
        flow, key = flow_of(given.channel), (given.channel.name, given.part)
        if isinstance(given.content, Grid) and given.content.at is None:  # none of the one before waits on
            self._waiting[flow].pop((given.channel.name, CHANGED), None)
        queue = self._waiting[flow].setdefault(key, deque())
        if any(one is given for one in queue):
            return
        most = SendTuning.waiting if flow is Flow.small and not given.channel.latched else 1
        if len(queue) >= most and not self.is_file:
            queue.popleft()
            self._counts_of(given.channel).left_out += 1
        queue.append(given)

    def _counts_of(self, channel: Channel) -> ChannelCounts:
        return self.counts.setdefault(channel.name, ChannelCounts())

    # --- the sender's own thread -------------------------------------------------------------------------------------

    def _work(self) -> None:
        while (given := self._next()) is not None:
            if given:
                self._send(given[0])
            if time.monotonic() - self._looked > SendTuning.look_s:
                self._count_listeners()
        self.outlet.close()

    def _next(self) -> list[Given] | None:
        """What is to be sent now; [] to look who listens; None: it ended."""
        with self._given:
            self._busy = False
            self._given.notify_all()
            while not self._ended:
                wait = SendTuning.look_s
                for flow, waiting in self._waiting.items():
                    if not waiting:
                        continue
                    budget = self._budgets.get(flow)
                    blocked = 0.0 if budget is None else budget.wait_s()
                    if blocked <= 0:
                        self._busy = True
                        return [_first_of(waiting)]
                    wait = min(wait, blocked)
                if not self._given.wait(wait):
                    return []
                if self._looked < 0:
                    return []
            return None

    def _send(self, given: Given) -> None:
        began = time.thread_time()
        try:
            self._try(given)
        finally:
            self.cpu_s[flow_of(given.channel)] += time.thread_time() - began

    def _try(self, given: Given) -> None:
        try:
            count = self.outlet.send(given.channel, given.content, given.stamp)
        except Exception as error:  # whatever an outlet does, the run goes on
            if not self.failure:
                self.failure = f"{self.outlet.name}: {given.channel.name}: {error or type(error).__name__}"
                _log.warning("warning: not published: %s", self.failure)
            self._counts_of(given.channel).left_out += 1
            return
        counts = self._counts_of(given.channel)
        counts.messages += 1
        counts.bytes += count
        self._sent[(given.channel.name, given.part)] = given
        if (budget := self._budgets.get(flow_of(given.channel))) is not None:
            budget.take(count)

    def _count_listeners(self) -> None:
        self._looked = time.monotonic()
        try:
            self._listening = {name: self.outlet.listeners(channel) for name, channel in self._channels.items()}
        except Exception as error:
            self.failure = self.failure or f"{self.outlet.name}: {error or type(error).__name__}"


def _first_of(waiting: dict[tuple[str, str], deque[Given]]) -> Given:
    """Takes what waits longest out of what waits."""
    key = next(iter(waiting))
    queue = waiting.pop(key)
    given = queue.popleft()
    if queue:
        waiting[key] = queue  # behind the others
    return given
