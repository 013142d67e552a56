# SPDX-License-Identifier: Apache-2.0
"""Sessions of Zenoh as ROS 2 wants them."""

from __future__ import annotations

import json
import os
from typing import Any, Final

from ggslam.errors import MiddlewareError, MissingDependency

ROUTER: Final = "tcp/localhost:7447"
"""Where rmw_zenoh_cpp's router listens."""
LISTEN: Final = "listen:"
CONFIG_FILE: Final = "ZENOH_SESSION_CONFIG_URI"
"""Variable that names a configuration file of sessions, as for rmw_zenoh_cpp."""
QUEUE_BATCHES: Final = 16
"""Batches of 64 KiB that wait for a link: a picture of 1 MB fits, so only a link that stands still loses messages."""
WAIT_US: Final = 1000
"""Longest wait of a sender for room in the queue of a link, microseconds."""
FRAGMENTS_WAIT_US: Final = 50_000
"""The same, of a message of many batches."""


def endpoints(address: str) -> tuple[list[str], list[str]]:
    """Where to connect to and where to listen. Addresses are separated by commas; one with `listen:` in front is
    listened on: `tcp/192.168.1.2:7447`, `listen:tcp/127.0.0.1:7450`.

    Raises:
        MiddlewareError: it has no protocol.
    """
    parts = [part.strip() for part in address.split(",") if part.strip()]
    for part in parts:
        if "/" not in part:
            raise MiddlewareError(f"`{part}` is no address for Zenoh: expected as tcp/192.168.1.2:7447")
    listen = [part.removeprefix(LISTEN) for part in parts if part.startswith(LISTEN)]
    return [part for part in parts if not part.startswith(LISTEN)], listen


def settings(address: str) -> dict[str, Any]:
    """Settings of a session by their paths.

    Without an address: the router of this machine, whenever there is one, and peers that multicast finds. With one:
    only what it names, and the peers that those know of.
    """
    connect, listen = endpoints(address)
    alone = not connect and not listen
    queue = "transport/link/tx/queue"
    return {
        "mode": "peer",
        "connect/endpoints": [ROUTER] if alone else connect,
        "connect/timeout_ms": -1,  # tried again and again in the background
        "connect/exit_on_failure": False,
        "listen/endpoints": ["tcp/[::]:0"] if alone else listen or ["tcp/localhost:0"],
        "scouting/multicast/enabled": alone,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": {"router": True, "peer": True, "client": True},  # latched topics need it
        "transport/shared_memory/enabled": False,
        f"{queue}/size/data": QUEUE_BATCHES,
        f"{queue}/congestion_control/drop/wait_before_drop": WAIT_US,
        f"{queue}/congestion_control/drop/max_wait_before_drop_fragments": FRAGMENTS_WAIT_US,
    }


def open_session(address: str) -> Any:
    """A session of Zenoh. The configuration file that the environment names is used where there is no address.

    Raises:
        MissingDependency: Zenoh is not installed.
        MiddlewareError: it cannot be opened.
    """
    try:
        import zenoh
    except ImportError as error:
        raise MissingDependency(f"Zenoh needs eclipse-zenoh: pip install 'ggslam[ros2]' ({error})") from None
    file = os.environ.get(CONFIG_FILE, "")
    try:
        if file and not address:
            config = zenoh.Config.from_file(file)
        else:
            config = zenoh.Config()
            for path, value in settings(address).items():
                config.insert_json5(path, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = address or file or "this machine"
        raise MiddlewareError(f"`{where}`: Zenoh cannot be joined: {str(error).splitlines()[0]}") from None
