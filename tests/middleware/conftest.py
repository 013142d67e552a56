# SPDX-License-Identifier: Apache-2.0
"""Peers in processes of their own, on 127.0.0.1 only."""

from __future__ import annotations

import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from ggslam.middleware.node import Node
from ggslam.middleware.opening import Middleware, NodeRequest, open_node

PEER = Path(__file__).with_name("peer.py")
PACKAGES = {"zenoh": "zenoh", "dds": "cyclonedds"}


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

    def peer(self) -> subprocess.Popen[str]:
        """A peer that is ready; it connects to the node of this process."""
        command = [sys.executable, str(PEER), self.middleware, self.address(False), str(self.domain)]
        made = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert made.stdout is not None and made.stdout.readline() == "ready\n"
        return made


def free_port() -> int:
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


@pytest.fixture(params=["zenoh", "dds"])
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    pytest.importorskip(PACKAGES[request.param])
    pytest.importorskip("rosbags")
    yield Network(request.param, free_port(), random.randrange(100, 200))


def end(peer: subprocess.Popen[str]) -> str:
    """Ends a peer as it wants to be ended; what it said at last."""
    said, _ = peer.communicate(timeout=10)
    assert peer.returncode == 0
    return said
