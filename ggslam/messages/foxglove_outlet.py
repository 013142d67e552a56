# SPDX-License-Identifier: Apache-2.0
"""Tells a map to Foxglove: over a WebSocket, or in an MCAP file."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ggslam.errors import InputError, MiddlewareError
from ggslam.messages.contents import Channel, Content
from ggslam.messages.foxglove_channel import FoxgloveChannel, foxglove_topic
from ggslam.messages.foxglove_package import foxglove_package
from ggslam.messages.sound_content import sound_content
from ggslam.system.tuning import Tuning


class FoxgloveTuning(Tuning):
    """The WebSocket server."""

    backlog = 64
    """Messages that wait for a slow client; then the oldest is left out."""


class _Outlet:
    """What the server and the file have in common. Each has its own context: outlets of a process do not mix."""

    def __init__(self) -> None:
        self._context: Any = foxglove_package().Context()
        self._channels: dict[Channel, FoxgloveChannel] = {}
        self._refused = 0

    def open(self, channel: Channel) -> None:
        """Makes a channel known."""
        self._channels[channel] = FoxgloveChannel(self._context, channel)

    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        """Sends; returns the bytes of the message, 0 if nothing of the content can be told."""
        sound = sound_content(content)
        if sound is None:
            self._refused += 1
            return 0
        return self._channels[channel].send(sound, stamp)

    def left_out(self) -> int:
        """Contents that could not be told. What the server leaves out for slow clients it does not tell."""
        return self._refused


class FoxgloveOutlet(_Outlet):
    """A server for Foxglove's WebSocket connection.

    Attributes:
        port: where it listens.
    """

    name = "foxglove"

    def __init__(self, host: str = "127.0.0.1", port: int = 8765) -> None:
        """Raises MiddlewareError if it cannot listen there; `port` 0 takes a free one."""
        super().__init__()
        self._told: list[Callable[[Channel], None]] = []
        self._clients: dict[str, set[int]] = {}
        logging.getLogger("foxglove.websocket").setLevel(logging.CRITICAL)  # a client that hung up is no error
        try:
            self._server = foxglove_package().start_server(
                name="ggslam", host=host, port=port, server_listener=_Listener(self), context=self._context,
                message_backlog_size=FoxgloveTuning.backlog,
            )  # fmt: skip
        except Exception as error:  # the package raises RuntimeError, and others for what is no address
            raise MiddlewareError(f"foxglove: cannot listen at {host}:{port}: {error}") from None
        self.port: int = self._server.port

    def url(self) -> str:
        """What opens it in Foxglove."""
        return self._server.app_url() or ""

    def listeners(self, channel: Channel) -> int:
        """How many clients subscribe to a channel."""
        return len(self._clients.get(foxglove_topic(channel), ()))

    def on_join(self, told: Callable[[Channel], None]) -> None:
        """`told` is called in a thread of the server."""
        self._told.append(told)

    def join(self, client: int, topic: str) -> None:
        """A client began to listen."""
        self._clients[topic] = self._clients.get(topic, set()) | {client}
        for channel, opened in list(self._channels.items()):
            if foxglove_topic(channel) == topic:
                opened.resend()
                for told in list(self._told):
                    told(channel)

    def leave(self, client: int, topic: str) -> None:
        """A client listens no more."""
        self._clients[topic] = self._clients.get(topic, set()) - {client}

    def close(self) -> None:
        """Ends the server."""
        for opened in self._channels.values():
            opened.close()
        self._server.stop()


class _Listener:
    """Takes what the server tells of its clients."""

    def __init__(self, outlet: FoxgloveOutlet) -> None:
        self._outlet = outlet

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """A client began to listen."""
        self._outlet.join(client.id, channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """A client listens no more."""
        self._outlet.leave(client.id, channel.topic)


class FileOutlet(_Outlet):
    """An MCAP file, for Foxglove and everything else that reads it. One that nothing was told to is removed at the end:
    it would be in the way of the next try."""

    name = "file"

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        """Raises InputError if the file is there already, or cannot be written."""
        super().__init__()
        self._path, self._is_empty = path, True
        try:
            self._writer = foxglove_package().open_mcap(path, allow_overwrite=overwrite, context=self._context)
        except FileExistsError:
            raise InputError(f"`{path}` is there already") from None
        except OSError as error:
            raise InputError(f"`{path}` cannot be written: {error}") from None

    def listeners(self, channel: Channel) -> int:
        """1: the file."""
        return 1

    def on_join(self, told: Callable[[Channel], None]) -> None:
        """Nobody joins a file."""

    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        """Writes a message."""
        self._is_empty = False
        return super().send(channel, content, stamp)

    def close(self) -> None:
        """Finishes the file."""
        for opened in self._channels.values():
            opened.close()
        with suppress(RuntimeError):  # closed before
            self._writer.close()
        if self._is_empty:
            self._path.unlink(missing_ok=True)
            self._is_empty = False
