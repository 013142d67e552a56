# SPDX-License-Identifier: Apache-2.0
"""Requests of a page over HTTP: judged by the gate, then answered by what is shown."""

from __future__ import annotations

import io
import json
import logging
import math
import socket
import time
from http.server import BaseHTTPRequestHandler
from typing import Any, Final
from urllib.parse import parse_qs, quote, urlsplit

from ggslam.errors import GgslamError
from ggslam.system.json_files import json_ready
from ggslam.system.tuning import Tuning
from ggslam.viewer.access import AccessTuning, MalformedRequest
from ggslam.viewer.page_source import Download
from ggslam.viewer.page_text import SERVED_POLICY, served_page


class RequestTuning(Tuning):
    """How long a page may take."""

    timeout_s = 20.0
    """Seconds that a connection may stand still while something is read or written."""
    request_s = 60.0
    """Seconds in which a request has to be here, however it drips: whoever has no token holds no connection."""


_log = logging.getLogger(__name__)
_REFUSAL = "403: open the address that ggslam printed; it ends with ?token=...\n"
_HEADERS: Final = {
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin", "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}  # fmt: skip


class _Once:
    """Headers by name; one that is there twice is an error."""

    def __init__(self, headers: Any) -> None:
        self._headers = headers

    def get(self, name: str) -> str | None:
        found = self._headers.get_all(name) or []
        if len(found) > 1:
            raise ValueError(f"{name}: is there twice")
        return found[0] if found else None


class _RequestReader(socket.SocketIO):
    """Reads from a connection until a time."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__(connection, "r")
        self._connection, self.end = connection, math.inf

    def readinto(self, buffer: Any) -> int | None:
        """Raises TimeoutError if nothing comes in time."""
        left = self.end - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request took too long")
        self._connection.settimeout(min(left, RequestTuning.timeout_s))
        try:
            return super().readinto(buffer)
        finally:
            self._connection.settimeout(RequestTuning.timeout_s)


class PageRequests(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    server: Any
    """The `page_server.HttpServer` that it belongs to."""
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "ggslam", ""
    timeout = RequestTuning.timeout_s

    def setup(self) -> None:
        """Reads through a reader that gives up."""
        super().setup()
        self.rfile.close()
        self._reader = _RequestReader(self.connection)
        self.rfile = io.BufferedReader(self._reader)

    def handle_one_request(self) -> None:
        """The next request of the connection, which has to be here in time."""
        self._reader.end = time.monotonic() + RequestTuning.request_s
        super().handle_one_request()

    def do_GET(self) -> None:
        """Page, scene, splats, pictures, events."""
        self._through_gate(self._get)

    def do_POST(self) -> None:
        """Edits and what needs more words than an address has."""
        self._through_gate(self._post)

    do_PUT = do_POST

    def _through_gate(self, answer: Any) -> None:
        """Answers if the gate lets the request in."""
        try:
            reason = self.server.gate.reason_to_refuse(self.path, _Once(self.headers))
        except MalformedRequest:
            self._send(400, "text/plain", b"400: the request cannot be read\n", close=True)
            return
        if reason is not None:
            self._send(403, "text/plain", _REFUSAL.encode(), close=True)
            return
        try:
            answer()
        except GgslamError as error:
            status = 409 if self.command == "GET" else 200  # browsers log other answers as if the page were at fault
            self._send_json({"error": str(error)}, status)
        except (ConnectionError, TimeoutError):  # the page is gone
            self.close_connection = True
        except RecursionError:
            self._send(400, "text/plain", b"400: nested too deeply\n")
        except Exception:
            _log.exception("a page's request failed")
            self._send_json({"error": "ggslam failed; it printed why"}, 500)

    # --- asking ------------------------------------------------------------------------------------------------------

    def _get(self) -> None:
        parts = urlsplit(self.path)
        asked = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        source = self.server.source
        if parts.path == "/":
            self._send(200, "text/html; charset=utf-8", served_page(self.server.title).encode())
        elif parts.path == "/scene":
            self._send_json(source.scene())
        elif parts.path == "/splats":
            content = source.splats(asked.get("chunk", "map"), _number(asked, "level"))
            self._send(200, "application/octet-stream", content)
        elif parts.path == "/frame":
            self._send(200, "image/jpeg", source.frame_picture(_number(asked, "number")))
        elif parts.path == "/events":
            self._events()
        elif parts.path == "/export":
            self._send_result(source.answer("export", {"object": _number(asked, "object")}))
        else:
            self._send(404, "text/plain", b"404: no such page\n")

    def _events(self) -> None:
        self.send_response(200)
        for name, value in {**_HEADERS, "Content-Type": "text/event-stream", "Connection": "close"}.items():
            self.send_header(name, value)
        self.end_headers()
        self.close_connection = True
        listener = self.server.events.join()
        try:
            self.wfile.write(b": connected\n\n")
            while (text := listener.next()) is not None:
                self.wfile.write(text)
        finally:
            self.server.events.leave(listener)

    def _post(self) -> None:
        lengths = self.headers.get_all("Content-Length") or []
        length = lengths[0] if len(lengths) == 1 else ""  # two of them would split one message in two ways
        if not length.isdecimal() or self.headers.get("Transfer-Encoding"):
            self._send(411, "text/plain", b"411: Content-Length is needed\n", close=True)
            return
        if len(length) > 9 or int(length) > AccessTuning.max_message_bytes:
            self._send(413, "text/plain", b"413: too long\n", close=True)
            return
        body = self.rfile.read(int(length))
        try:
            values = json.loads(body) if body else {}
        except (ValueError, RecursionError):
            self._send(400, "text/plain", b"400: expected JSON\n")
            return
        action = urlsplit(self.path).path.strip("/")
        self._send_result(self.server.source.answer(action, values))

    # --- answering ---------------------------------------------------------------------------------------------------

    def _send_result(self, result: dict[str, Any] | Download) -> None:
        if isinstance(result, Download):
            name = {"Content-Disposition": f"attachment; filename*=UTF-8''{quote(result.name)}"}
            self._send(200, result.kind, result.content, name)
        else:
            self._send_json(result)

    def _send_json(self, values: dict[str, Any], status: int = 200) -> None:
        self._send(status, "application/json", json.dumps(json_ready(values)).encode())

    def _send(
        self, status: int, kind: str, content: bytes, more: dict[str, str] | None = None, close: bool = False
    ) -> None:
        self.send_response(status)
        headers = {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content)), **(more or {})}
        if kind.startswith("text/html"):
            headers["Content-Security-Policy"] = SERVED_POLICY
        host = self.headers.get("Host") if status == 200 else None
        if host and self.server.gate.wants_cookie(self.path):
            headers["Set-Cookie"] = self.server.gate.cookie(host)
        if close:
            headers["Connection"] = "close"
            self.close_connection = True
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What is no request of ours: a status and nothing else."""
        self.close_connection = True
        try:
            self.wfile.write(f"HTTP/1.1 {code} {self.responses.get(code, ('',))[0]}\r\nConnection: close\r\n".encode())
            self.wfile.write(b"Content-Length: 0\r\n\r\n")
        except OSError:
            pass

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing is said of requests."""


def _number(asked: dict[str, str], name: str) -> int:
    text = asked.get(name, "0")
    return int(text) if text.isdecimal() and len(text) < 10 else 0
