# SPDX-License-Identifier: Apache-2.0
"""Opens a node over the middleware that is asked for."""

from __future__ import annotations

from ggslam.errors import MiddlewareError
from ggslam.middleware.node import Middleware, Node, NodeRequest

__all__ = ["Middleware", "Node", "NodeRequest", "open_node"]


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
