# SPDX-License-Identifier: Apache-2.0
"""Opens what a map is published through."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from ggslam.errors import ConfigError, MissingDependency
from ggslam.messages.outlet import Outlet
from ggslam.middleware.node import Node
from ggslam.middleware.opening import NodeRequest, open_node
from ggslam.middleware.types import MessageTypes, message_types

FOXGLOVE_PORT: Final = 8765
"""That Foxglove itself suggests."""
_FILE = ".mcap"


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


def parse_outlets(text: str) -> tuple[str, ...]:
    """Names of a list with commas.

    Raises:
        ConfigError: one is none, or there twice.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in ("foxglove", "ros2") and Path(name).suffix.lower() != _FILE:
            raise ConfigError(f"`publish`: expected foxglove, ros2 or FILE{_FILE}, found {name[:80]!r}")
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"`publish`: expected foxglove, ros2 or FILE{_FILE}, each once, found {text[:80]!r}")
    return names


@contextmanager
def open_outlets(request: PublishRequest) -> Iterator[Opened]:
    """Opens outlets, and leaves the network at the end. The outlets themselves are closed by who sends.

    Raises:
        MissingDependency: a package is not installed.
        GgslamError: a port is taken, a file is there, or the network cannot be joined.
    """
    with ExitStack() as opened:
        found = Opened()
        for name in request.names:
            try:
                _open(name, request, found, opened)
            except MissingDependency as error:
                if not request.optional:
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
