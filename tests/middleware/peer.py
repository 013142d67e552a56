# SPDX-License-Identifier: Apache-2.0
"""A process at the other end: sends back what comes on /ping, has a latched topic, and offers services.

    python peer.py zenoh ADDRESS DOMAIN

It says "ready" and runs until its input ends.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from ggslam.middleware.node import LATCHED, Qos
from ggslam.middleware.opening import NodeRequest, open_node
from ggslam.middleware.types import message_types

IMAGE, TEXT, TRIGGER = "sensor_msgs/msg/Image", "std_msgs/msg/String", "std_srvs/srv/Trigger"
PAIRS = "ggslam_msgs/srv/Pairs"


def register() -> None:
    message_types("jazzy").register_service(PAIRS, "geometry_msgs/Point[] points\n", "float64[] lengths\n")


def main(middleware: Any, address: str, domain: int) -> None:
    register()
    types = message_types("jazzy")
    node = open_node(NodeRequest(middleware, domain, "", address, "jazzy"), "peer")
    pong = node.publisher("/pong", IMAGE, Qos(depth=50))
    node.subscribe("/ping", IMAGE, Qos(depth=50), lambda received: pong.send(received.content))
    latched = node.publisher("/latched", TEXT, LATCHED)
    for text in ("old", f"from {os.getpid()}"):
        latched.send(types.encode(TEXT, types.make(TEXT, data=text)))

    def trigger(_: Any) -> Any:
        return types.make(TRIGGER + "_Response", success=True, message=f"by {os.getpid()}")

    def pairs(request: Any) -> Any:
        import numpy as np

        lengths = np.array([point.x + point.y for point in request.points])
        return types.make(PAIRS + "_Response", lengths=lengths)

    node.offer("/trigger", TRIGGER, trigger)
    node.offer("/pairs", PAIRS, pairs)
    node.offer("/broken", TRIGGER, lambda _: 1 / 0)
    print("ready", flush=True)
    sys.stdin.read()
    node.close()
    print("closed", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
