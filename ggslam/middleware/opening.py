# SPDX-License-Identifier: Apache-2.0
"""Opens a node over the middleware that is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ggslam.errors import MiddlewareError
from ggslam.middleware.node import Node

Middleware = Literal["zenoh", "dds"]


@dataclass(frozen=True)
class NodeRequest:
    """How to join the network.

    Attributes:
        middleware: as rmw_zenoh_cpp, or as rmw_cyclonedds_cpp does.
        domain: ROS_DOMAIN_ID.
        namespace: of topics that have none, such as `/robot1`.
        address: of Zenoh's router or of another peer, such as `tcp/192.168.1.2:7447`; empty: a router on this machine
            if there is one, and peers nearby. Of DDS the address of the network interface.
        distribution: of ROS 2; None: of ROS_DISTRO.
    """

    middleware: Middleware = "zenoh"
    domain: int = 0
    namespace: str = ""
    address: str = ""
    distribution: str | None = None


def open_node(request: NodeRequest, name: str) -> Node:
    """Joins the network as a node.

    Raises:
        MissingDependency: the middleware's package is not installed.
        MiddlewareError: it cannot be joined, or a name is none.
    """
    if request.middleware == "zenoh":
        from ggslam.middleware.zenoh_node import ZenohNode

        return ZenohNode(request, name)
    if request.middleware == "dds":
        from ggslam.middleware.dds_node import DdsNode

        return DdsNode(request, name)
    raise MiddlewareError(f"`middleware`: expected zenoh or dds, found {request.middleware}")
