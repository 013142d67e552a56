# SPDX-License-Identifier: Apache-2.0
"""Publishes what is told of a map through several outlets, each of which has a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

from ggslam.jobs.serve.channels import Flow
from ggslam.jobs.serve.sending import ChannelCounts, Given, OutletSender
from ggslam.messages.contents import Channel, Content
from ggslam.messages.outlet import Outlet
from ggslam.system.plurals import quantity


class MapPublisher:
    """Contents are handed over channel by channel, part by part; the newest of each wins, and nothing here waits for an
    outlet or for who listens.

    Args:
        outlets: to publish through, each with whether it writes a file.
        channels: that are published.
    """

    def __init__(self, outlets: Iterable[tuple[Outlet, bool]], channels: Iterable[Channel]) -> None:
        self.channels = tuple(channels)
        self._lock = threading.Lock()
        self._newest: dict[str, dict[str, Given]] = {}
        self._joined: list[Callable[[Channel], None]] = []
        self._began = time.monotonic()
        self.senders = [
            OutletSender(outlet, self.channels, self.newest, self._tell_joined, is_file) for outlet, is_file in outlets
        ]

    def is_wanted(self, channel: Channel) -> bool:
        """Whether anybody listens to a channel: of others nothing need be computed."""
        return any(sender.listens(channel) for sender in self.senders)

    def on_join(self, told: Callable[[Channel], None]) -> None:
        """`told` is called, from any thread, when somebody began to listen to a channel."""
        self._joined.append(told)

    def put(self, channel: Channel, content: Content, stamp: float, part: str = "", keep: bool = True) -> None:
        """Hands over a content.

        Args:
            channel: of `channels`.
            content: not changed afterwards.
            stamp: when it was so, seconds.
            part: which part of the channel's content this is; "": it is all of it.
            keep: whether who begins to listen later gets it, too.
        """
        given = Given(channel, content, stamp, part)
        if keep:
            with self._lock:
                self._newest.setdefault(channel.name, {})[part] = given
        for sender in self.senders:
            sender.put(given)

    def forget(self, channel: Channel, part: str = "") -> None:
        """Who begins to listen from now on does not get a part."""
        with self._lock:
            self._newest.get(channel.name, {}).pop(part, None)

    def newest(self, channel: Channel) -> list[Given]:
        """The newest content of a channel, part by part."""
        with self._lock:
            return list(self._newest.get(channel.name, {}).values())

    def wait_idle(self, timeout_s: float) -> bool:
        """Waits until all that was handed over is sent; returns whether it is."""
        end = time.monotonic() + timeout_s
        return all(sender.wait_idle(max(0.0, end - time.monotonic())) for sender in self.senders)

    def close(self) -> None:
        """Ends all outlets; what waits is not sent."""
        for sender in self.senders:
            sender.close()

    def _tell_joined(self, channel: Channel) -> None:
        for told in self._joined:
            told(channel)

    # --- figures -----------------------------------------------------------------------------------------------------

    def cpu_s(self, flow: Flow) -> float:
        """Processor seconds that writing messages of a kind took."""
        return sum(sender.cpu_s[flow] for sender in self.senders)

    def counts(self) -> dict[str, dict[str, ChannelCounts]]:
        """By outlet and channel."""
        return {sender.outlet.name: dict(sender.counts) for sender in self.senders}

    def record(self) -> dict[str, Any]:
        """The same for files: of each outlet its channels, what it could not take, and why, if it failed."""
        return {
            "seconds": time.monotonic() - self._began,
            "processor_seconds": {flow.value: self.cpu_s(flow) for flow in Flow},
            "outlets": {
                sender.outlet.name: {
                    "channels": {name: asdict(counts) for name, counts in sorted(sender.counts.items())},
                    "not_taken": sender.outlet.left_out(), "failure": sender.failure,
                } for sender in self.senders
            },
        }  # fmt: skip

    def line(self) -> str:
        """A line for people."""
        parts = []
        for sender in self.senders:
            counts = list(sender.counts.values())
            left_out = sum(count.left_out for count in counts) + sender.outlet.left_out()
            megabytes = sum(count.bytes for count in counts) / 1e6
            text = f"{sender.outlet.name}: {quantity(sum(count.messages for count in counts), 'message')}"
            text += f", {megabytes:.1f} MB" + (f", {left_out} left out" if left_out else "")
            parts.append(text + (f" ({sender.failure})" if sender.failure else ""))
        return "published " + "; ".join(parts)
