# SPDX-License-Identifier: Apache-2.0
"""Networks of tests, on 127.0.0.1 only, and peers in processes of their own."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.middleware.node import Node
from ggslam.middleware.opening import Middleware, NodeRequest, open_node
from ggslam.middleware.types import message_types

PEER = Path(__file__).with_name("peer.py")


def wait_until(there: Callable[[], bool], timeout_s: float = 8.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while not there():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


@dataclass
class Network:
    """A network of its own: of Zenoh by a free port, of DDS by a domain drawn at random."""

    middleware: Middleware
    port: int
    domain: int

    def address(self, listens: bool) -> str:
        if self.middleware == "dds":
            return "127.0.0.1"
        return f"listen:tcp/127.0.0.1:{self.port}" if listens else f"tcp/127.0.0.1:{self.port}"

    def node(self, name: str = "own", listens: bool = True) -> Node:
        return open_node(NodeRequest(self.middleware, self.domain, "", self.address(listens), "jazzy"), name)

    def peer(self, listens: bool = False) -> subprocess.Popen[str]:
        """A peer that is ready; it connects to the node of this process, or is connected to."""
        command = [sys.executable, str(PEER), self.middleware, self.address(listens), str(self.domain)]
        made = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert made.stdout is not None and made.stdout.readline() == "ready\n"
        return made


def free_port() -> int:
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


def end(peer: subprocess.Popen[str]) -> str:
    """Ends a peer as it wants to be ended; what it said at last."""
    said, _ = peer.communicate(timeout=10)
    assert peer.returncode == 0
    return said


def image(number: int, height: int = 480, width: int = 640) -> bytes:
    """An image, rgb8, as CDR; its stamp is its number of seconds."""
    types, kind = message_types("jazzy"), "sensor_msgs/msg/Image"
    stamp = types.make("builtin_interfaces/msg/Time", sec=number, nanosec=0)
    header = types.make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")
    data = np.random.default_rng(number).integers(0, 255, height * width * 3, np.uint8)
    return types.encode(kind, types.make(
        kind, header=header, height=height, width=width, encoding="rgb8", is_bigendian=0, step=3 * width, data=data
    ))  # fmt: skip
