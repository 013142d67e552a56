# SPDX-License-Identifier: Apache-2.0
"""Who may open the page, asked as browsers and programs ask: over the network."""

from __future__ import annotations

import asyncio
import http.client
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest

from ggslam.viewer.access import AccessTuning, Gate
from ggslam.viewer.server import address, close_server, open_server

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    opened = open_server(port=0)
    yield opened
    close_server(opened)


def get(server: Any, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.request("GET", path, headers={"Host": f"localhost:{server.get_port()}", **headers})
    answer = connection.getresponse()
    answer.read()
    return answer


def cookie_of(server: Any) -> str:
    answer = get(server, "/?" + urlsplit(address(server)).query)
    assert answer.status == 200
    text = answer.headers["Set-Cookie"]
    assert "HttpOnly" in text and "SameSite=Strict" in text
    return text.split(";")[0]


def test_the_printed_address_opens_and_its_cookie_lets_in(server: Any) -> None:
    cookie = cookie_of(server)
    assert get(server, "/", Cookie=cookie).status == 200
    assert get(server, "/", Cookie=f"other=1; {cookie}").status == 200


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=wrong", "/assets/index.js", "/?token=%ff"])
def test_without_the_token_nothing_is_shown(server: Any, path: str) -> None:
    answer = get(server, path)
    assert answer.status == 403 and answer.headers["Set-Cookie"] is None


@pytest.mark.parametrize("host", ["attacker.example", "localhost.attacker.example", "127.0.0.1.nip.io"])
def test_a_name_bent_to_this_machine_is_refused(server: Any, host: str) -> None:
    port = server.get_port()
    assert get(server, "/", Host=f"{host}:{port}", Cookie=cookie_of(server)).status == 403


def test_another_page_is_refused(server: Any) -> None:
    cookie = cookie_of(server)
    own = f"localhost:{server.get_port()}"
    others = ("http://attacker.example", "null", f"http://localhost:{server.get_port() + 1}", f"https://{own}",
              f"file://{own}", own, f"//{own}", f"http://{own}/", f"http://x@{own}", "http://[")  # fmt: skip
    for origin in others:
        assert get(server, "/", Cookie=cookie, Origin=origin).status == 403


@pytest.mark.parametrize(("sender", "status"), [("same-site", 403), ("cross-site", 403), ("none", 200),
                                                ("same-origin", 200)])  # fmt: skip
def test_frames_and_images_of_another_page_get_nothing(server: Any, sender: str, status: int) -> None:
    more = {"Sec-Fetch-Site": sender}
    assert get(server, "/", Cookie=cookie_of(server), **more).status == status
    assert get(server, "/?" + urlsplit(address(server)).query, **more).status == 200  # a link that was given


MALFORMED = (
    "Host: :80", "Host: [::1", "Host: [x]:80", "Host: a:99999", "Host: a:b", "Host: user@localhost", "Host: a/b",
    "Host: localhost\r\nHost: localhost", "Host: localhost\r\nOrigin: http://a\r\nOrigin: http://b",
    "Host: localhost\r\nCookie: a=1\r\nCookie: b=2",
)  # fmt: skip
NO_HTTP = ("garbage\r\n\r\n", "POST / HTTP/1.1\r\nHost: a\r\n\r\n", f"GET / HTTP/1.1\r\nX: {'a' * 20000}\r\n\r\n",
           "GET / HTTP/1.1\r\n" + "A: x\r\n" * 500 + "\r\n", "GET / HTTP/1.1\r\n\xff: a\r\n\r\n")  # fmt: skip
GIVEN = [f"GET / HTTP/1.1\r\n{headers}\r\n\r\n" for headers in MALFORMED]


@pytest.mark.parametrize("text", [*GIVEN, "GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n", *NO_HTTP])
def test_what_is_no_request_gets_400_at_most_and_no_traceback(
    server: Any, text: str, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=10) as raw:
        raw.sendall(text.encode("latin-1"))
        answer = b""
        while piece := raw.recv(4096):
            answer += piece
    assert answer == b"" if text in NO_HTTP else answer.startswith(b"HTTP/1.1 400 "), answer[:200]
    assert "Traceback" not in capfd.readouterr().err and not caplog.records


def connect(server: Any, message: bytes | None = None, **headers: str) -> str:
    """What becomes of a websocket: `open`, the status of a refusal, or why it was closed after a message."""
    from websockets.asyncio.client import connect as websocket
    from websockets.exceptions import ConnectionClosed, InvalidStatus

    async def attempt() -> str:
        try:
            async with websocket(
                f"ws://localhost:{server.get_port()}/", additional_headers=headers, max_size=None, open_timeout=10
            ) as opened:
                if message is None:
                    return "open"
                await opened.send(message)
                while True:
                    await asyncio.wait_for(opened.recv(), 10)
        except InvalidStatus as refusal:
            return str(refusal.response.status_code)
        except ConnectionClosed as end:
            return f"closed {end.rcvd.code if end.rcvd else '?'}"

    return asyncio.run(attempt())


def test_sockets_are_judged_like_pages(server: Any) -> None:
    cookie, own = cookie_of(server), f"http://localhost:{server.get_port()}"
    assert connect(server, Cookie=cookie, Origin=own) in ("open", "closed 1002")
    assert connect(server, Origin=own) == "403"
    assert connect(server, Cookie=cookie, Origin="http://attacker.example") == "403"
    assert connect(server, Cookie="ggslam-1=guess", Origin=own) == "403"


def test_messages_have_an_end(server: Any) -> None:
    said = connect(server, b"x" * (AccessTuning.max_message_bytes + 1), Cookie=cookie_of(server))
    assert said.startswith("closed")


@pytest.mark.parametrize(
    ("host", "name", "good"),
    [("127.0.0.1", "localhost:8080", True), ("127.0.0.1", "[::1]:8080", True), ("127.0.0.1", "192.168.1.4:8080", False),
     ("0.0.0.0", "192.168.1.4:8080", True), ("0.0.0.0", "attacker.example", False), ("::", "[fe80::1]:80", True),
     ("robot.local", "robot.local:8080", True), ("127.0.0.1", "", False)],
)  # fmt: skip
def test_names_of_this_machine(host: str, name: str, good: bool) -> None:
    gate = Gate(host)
    assert (gate.reason_to_refuse(f"/?token={gate.token}", {"Host": name}) is None) is good
