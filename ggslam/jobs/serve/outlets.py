# SPDX-License-Identifier: Apache-2.0
"""Opens what a map is published through."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from ggslam.errors import ConfigError, GgslamError, MissingDependency
from ggslam.messages.outlet import Outlet
from ggslam.middleware.node import Node
from ggslam.middleware.opening import NodeRequest, open_node
from ggslam.middleware.types import MessageTypes, message_types

FOXGLOVE_PORT: Final = 8765
"""That Foxglove itself suggests."""
HTTP_PORT: Final = 8090
_PORTS: Final = {"foxglove": FOXGLOVE_PORT, "http": HTTP_PORT}


@dataclass(frozen=True)
class PublishRequest:
    """What a map is published through.

    Attributes:
        names: of `foxglove`, `ros2`, and files `.mcap`.
        host, foxglove_port: where Foxglove finds it.
        node: how ROS 2 is joined.
        overwrite: whether files that are there are replaced.
        optional: whether what is not installed is left out.
    """

    names: tuple[str, ...]
    host: str = "127.0.0.1"
    foxglove_port: int = FOXGLOVE_PORT
    node: NodeRequest = NodeRequest()
    overwrite: bool = False
    optional: bool = False


@dataclass
class Opened:
    """What was opened.

    Attributes:
        outlets: each with whether it writes a file.
        node: of ROS 2; None: it was not asked for.
        types: of its messages.
        lines: for people: where each is found.
    """

    outlets: list[tuple[Outlet, bool]] = field(default_factory=list)
    node: Node | None = None
    types: MessageTypes | None = None
    lines: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Places:
    """Where to publish: names of outlets, and the ports that were told."""

    names: tuple[str, ...]
    foxglove_port: int | None = None
    http_port: int | None = None

    @property
    def only_files(self) -> bool:
        """Whether nobody can join."""
        return self.http_port is None and all(_is_file(name) for name in self.names)


def parse_places(text: str) -> Places:
    """Of a list with commas: foxglove[:PORT], ros2, http[:PORT], FILE.mcap.

    Raises:
        ConfigError: one is none of these, or there twice.
    """
    names, ports = [], dict[str, int]()
    for word in (word.strip() for word in text.split(",")):
        name, _, port = word.partition(":")
        if name in ("foxglove", "http") and (not port or (port.isdecimal() and int(port) < 65536)):
            ports[name] = int(port) if port else _PORTS[name]
            names.append(name)
        elif word == "ros2" or _is_file(word):
            names.append(word)
        else:
            expected = "foxglove[:PORT], ros2, http[:PORT] or FILE.mcap"
            raise ConfigError(f"`publish`: expected {expected}, found {word[:80]!r}")
    if len(set(names)) < len(names):
        raise ConfigError(f"`publish`: expected each place once, found {text[:80]!r}")
    return Places(tuple(name for name in names if name != "http"), ports.get("foxglove"), ports.get("http"))


def _is_file(word: str) -> bool:
    return Path(word).suffix.lower() == ".mcap"


@contextmanager
def open_outlets(request: PublishRequest) -> Iterator[Opened]:
    """Opens outlets, and leaves the network at the end. The outlets themselves are closed by who sends, or at once if
    one of them cannot be opened.

    Raises:
        MissingDependency: a package is not installed.
        GgslamError: a port is taken, a file is there, or the network cannot be joined.
    """
    with ExitStack() as opened:
        found = Opened()
        for name in request.names:
            try:
                _open(name, request, found, opened)
            except GgslamError as error:
                if not (request.optional and isinstance(error, MissingDependency)):
                    for outlet, _ in found.outlets:
                        outlet.close()
                    raise
                found.lines.append(f"without {name}: {error}")
        yield found


def _open(name: str, request: PublishRequest, found: Opened, opened: ExitStack) -> None:
    if name == "ros2":
        from ggslam.messages.ros2_outlet import Ros2Outlet

        found.types = message_types(request.node.distribution)
        found.node = open_node(request.node, "ggslam")
        opened.callback(found.node.close)
        found.outlets.append((Ros2Outlet(found.node, found.types), False))
        where = f" in {request.node.namespace}" if request.node.namespace else ""
        found.lines.append(f"ros2: {request.node.middleware}, domain {request.node.domain}{where}, topics ggslam/...")
    elif name == "foxglove":
        from ggslam.messages.foxglove_outlet import FoxgloveOutlet

        server = FoxgloveOutlet(request.host, request.foxglove_port)
        found.outlets.append((server, False))
        found.lines.append(f"foxglove: ws://{request.host}:{server.port}")
    else:
        from ggslam.messages.foxglove_outlet import FileOutlet

        found.outlets.append((FileOutlet(Path(name), request.overwrite), True))
        found.lines.append(f"file: {name}")
