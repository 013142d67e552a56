# SPDX-License-Identifier: Apache-2.0
"""The web server of the viewer: Python's own, a thread a connection, behind a gate."""

from __future__ import annotations

import errno
import socket
import sys
import threading
from http.server import ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any, Final

from ggslam.errors import ConfigError
from ggslam.system.tuning import Tuning
from ggslam.viewer.access import Gate
from ggslam.viewer.events import Events
from ggslam.viewer.page_requests import PageRequests
from ggslam.viewer.page_source import NothingYet, PageSource

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT: Final = 8080
"""Port of `--port` if it is left out."""


class ServerTuning(Tuning):
    """Limits of the server."""

    connections = 64
    """Most connections at a time; more are closed at once."""


class HttpServer(ThreadingHTTPServer):
    """Listens; see `PageServer`."""

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, family: int, place: Any, gate: Gate, title: str, requests: type[PageRequests] = PageRequests
    ) -> None:
        self.address_family = socket.AddressFamily(family)
        self.gate, self.title, self.events = gate, title, Events()
        self.source: PageSource = NothingYet(title, "waiting for the first frame")
        self._free = threading.BoundedSemaphore(ServerTuning.connections)
        super().__init__(place, requests)

    def server_bind(self) -> None:
        """Binds; Python's own would ask for this machine's name on the network, which may take long."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begins a connection, if there are not too many."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """A connection, in a thread of its own."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that is gone is no news; all else is said."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class PageServer:
    """Serves a page until it is closed.

    Args:
        host: address to listen at; with the default nobody but this machine can connect.
        port: to listen at; 0: any free one.
        title: of the page.
        requests: what answers them.
        source: that is shown; None: one that waits for its map.

    Raises:
        ConfigError: the address cannot be listened at.
    """

    def __init__(
        self, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, title: str = "ggslam",
        requests: type[PageRequests] = PageRequests, source: PageSource | None = None,
    ) -> None:  # fmt: skip
        if not 0 <= port <= 65535:
            raise ConfigError(f"`port`: expected 0 to 65535, found {port}")
        self.host = host
        try:
            if not host:
                raise OSError(errno.EADDRNOTAVAIL, "no address")
            kind = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            self._http = HttpServer(kind[0], kind[4], Gate(host), title, requests)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            argument = "port" if getattr(error, "errno", None) in (errno.EADDRINUSE, errno.EACCES) else "host"
            text = f"{host}:{port}: cannot be listened at: {reason}; choose another with `{argument}`"
            raise ConfigError(text) from None
        if source is not None:
            self._http.source = source
        self._thread = threading.Thread(target=self._http.serve_forever, name="viewer", daemon=True, args=(0.1,))
        self._thread.start()

    @property
    def port(self) -> int:
        """That it listens at."""
        return int(self._http.server_address[1])

    @property
    def address(self) -> str:
        """Where a browser finds it, with the token that lets it in."""
        name = self.host
        if name in ("127.0.0.1", "0.0.0.0", "::"):
            name = "localhost"
        return f"http://{f'[{name}]' if ':' in name else name}:{self.port}/?token={self._http.gate.token}"

    @property
    def source(self) -> PageSource:
        """What is shown."""
        return self._http.source

    @property
    def watchers(self) -> int:
        """How many pages listen for news."""
        return len(self._http.events)

    def show(self, source: PageSource) -> None:
        """Shows another map from now on."""
        self._http.source = source
        self.tell("scene", "splats")

    def tell(self, *what: str, **values: Any) -> None:
        """Tells the pages what changed; see `Events.tell`."""
        self._http.events.tell(*what, **values)

    def close(self) -> None:
        """Ends it; browsers see that the connection is lost."""
        self._http.events.end()
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()
