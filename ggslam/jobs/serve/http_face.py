# SPDX-License-Identifier: Apache-2.0
"""The functions of a map over HTTP, as JSON: the viewer's server and gate with other answers.

    curl 'http://localhost:8090/status?token=...'
    curl 'http://localhost:8090/query_distance?token=...' -d '{"points": [[0, 0, 1]]}'

An answer is what the function returns with `"ok": true`, or `{"ok": false, "error": "..."}` and a status of 400.
"""

from __future__ import annotations

from typing import Any, Final
from urllib.parse import urlsplit

from ggslam.errors import GgslamError
from ggslam.jobs.serve.services import FUNCTIONS, MapServices
from ggslam.viewer.page_requests import PageRequests
from ggslam.viewer.page_server import PageServer
from ggslam.viewer.page_source import NothingYet

_ASKED: Final = ("status", "verdicts")
"""What a GET may ask: it changes nothing."""


class Functions(NothingYet):
    """A source that answers with functions.

    Args:
        services: that answer.
    """

    def __init__(self, services: MapServices) -> None:
        super().__init__("ggslam", "functions")
        self._services = services

    def answer(self, action: str, values: Any) -> dict[str, Any]:
        """See `PageSource`."""
        return {"ok": True, **self._services.call(action, values)}

    def functions(self) -> dict[str, Any]:
        """The functions that there are."""
        known = {name: FUNCTIONS[name] for name in self._services.names}
        return {"functions": {name: {"takes": takes, "does": does} for name, (takes, does) in known.items()}}


class FunctionRequests(PageRequests):
    """Answers requests for functions."""

    def do_GET(self) -> None:
        """The functions, and what changes nothing."""
        self._through_gate(self._ask)

    def _ask(self) -> None:
        name = urlsplit(self.path).path.strip("/")
        source = self.server.source
        if not name:
            self._send_json(source.functions())
        elif name in _ASKED:
            self._send_json(source.answer(name, None))
        elif name in FUNCTIONS:
            self._send_json({"ok": False, "error": f"{name}: is asked with POST"}, 405)
        else:
            self._send_json({"ok": False, "error": f"there is no {name[:60]!r}; GET / lists what there is"}, 404)

    def _through_gate(self, answer: Any) -> None:
        def tell() -> None:
            try:
                answer()
            except GgslamError as error:
                self._send_json({"ok": False, "error": str(error)}, 400)

        super()._through_gate(tell)


def serve_functions(services: MapServices, host: str, port: int) -> PageServer:
    """Serves functions until the server is closed; arguments and errors as of `PageServer`."""
    return PageServer(host, port, "ggslam", FunctionRequests, Functions(services))
