# SPDX-License-Identifier: Apache-2.0
"""Options of commands that join the network of ROS 2."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.middleware.node import HIGHEST_DOMAIN

if TYPE_CHECKING:
    from ggslam.middleware.opening import NodeRequest


class MiddlewareName(str, Enum):
    """What carries messages."""

    zenoh = "zenoh"
    dds = "dds"


Middleware = Annotated[
    MiddlewareName,
    typer.Option(help="Carrier of ROS 2 messages: zenoh, as rmw_zenoh_cpp does, or dds, as rmw_cyclonedds_cpp does."),
]
Domain = Annotated[
    int, typer.Option(envvar="ROS_DOMAIN_ID", show_envvar=True, min=0, max=HIGHEST_DOMAIN, help="ROS 2 domain.")
]
Namespace = Annotated[
    str, typer.Option(metavar="NAME", help="Namespace of ROS 2 topics that do not begin with a slash.")
]
Address = Annotated[
    str,
    typer.Option(metavar="WHERE", help="Zenoh: endpoint to connect to, such as tcp/192.168.1.2:7447. DDS: address of "
                 "the network interface. Default: this machine and its neighbours."),
]  # fmt: skip


def node_request(middleware: MiddlewareName, domain: int, namespace: str, address: str) -> NodeRequest:
    """The node that options ask for."""
    from ggslam.middleware.opening import NodeRequest

    return NodeRequest("zenoh" if middleware is MiddlewareName.zenoh else "dds", domain, namespace, address)
