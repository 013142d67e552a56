# SPDX-License-Identifier: Apache-2.0
"""Who may open the page, asked as browsers and programs ask: over the network."""

from __future__ import annotations

import http.client
import re
import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest

from ggslam.viewer.access import AccessTuning, Gate
from ggslam.viewer.page_server import PageServer


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    opened = PageServer(port=0)
    yield opened
    opened.close()


def get(server: PageServer, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("GET", path, headers={"Host": f"localhost:{server.port}", **headers})
    answer = connection.getresponse()
    answer.read()
    return answer


def cookie_of(server: PageServer) -> str:
    answer = get(server, "/?" + urlsplit(server.address).query)
    assert answer.status == 200
    text = answer.headers["Set-Cookie"]
    assert "HttpOnly" in text and "SameSite=Strict" in text
    return text.split(";")[0]


def test_the_printed_address_opens_and_its_cookie_lets_in(server: PageServer) -> None:
    cookie = cookie_of(server)
    assert get(server, "/", Cookie=cookie).status == 200
    assert get(server, "/", Cookie=f"other=1; {cookie}").status == 200


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=wrong", "/assets/index.js", "/?token=%ff"])
def test_without_the_token_nothing_is_shown(server: PageServer, path: str) -> None:
    answer = get(server, path)
    assert answer.status == 403 and answer.headers["Set-Cookie"] is None


@pytest.mark.parametrize("host", ["attacker.example", "localhost.attacker.example", "127.0.0.1.nip.io"])
def test_a_name_bent_to_this_machine_is_refused(server: PageServer, host: str) -> None:
    port = server.port
    assert get(server, "/", Host=f"{host}:{port}", Cookie=cookie_of(server)).status == 403


def test_another_page_is_refused(server: PageServer) -> None:
    cookie = cookie_of(server)
    own = f"localhost:{server.port}"
    others = ("http://attacker.example", "null", f"http://localhost:{server.port + 1}", f"https://{own}",
              f"file://{own}", own, f"//{own}", f"http://{own}/", f"http://x@{own}", "http://[")  # fmt: skip
    for origin in others:
        assert get(server, "/", Cookie=cookie, Origin=origin).status == 403


@pytest.mark.parametrize(("sender", "status"), [("same-site", 403), ("cross-site", 403), ("none", 200),
                                                ("same-origin", 200)])  # fmt: skip
def test_frames_and_images_of_another_page_get_nothing(server: PageServer, sender: str, status: int) -> None:
    more = {"Sec-Fetch-Site": sender}
    assert get(server, "/", Cookie=cookie_of(server), **more).status == status
    assert get(server, "/?" + urlsplit(server.address).query, **more).status == 200  # a link that was given


MALFORMED = (
    "Host: :80", "Host: [::1", "Host: [x]:80", "Host: a:99999", "Host: a:b", "Host: user@localhost", "Host: a/b",
    "Host: localhost\r\nHost: localhost", "Host: localhost\r\nOrigin: http://a\r\nOrigin: http://b",
    "Host: localhost\r\nCookie: a=1\r\nCookie: b=2",
)  # fmt: skip
NO_HTTP = ("GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n",
           "garbage\r\n\r\n", "POST / HTTP/1.1\r\nHost: a\r\n\r\n", f"GET / HTTP/1.1\r\nX: {'a' * 20000}\r\n\r\n",
           "GET / HTTP/1.1\r\n" + "A: x\r\n" * 500 + "\r\n", "GET / HTTP/1.1\r\n\xff: a\r\n\r\n")  # fmt: skip
GIVEN = [f"GET / HTTP/1.1\r\n{headers}\r\n\r\n" for headers in MALFORMED]


@pytest.mark.parametrize("text", [*GIVEN, *NO_HTTP])
def test_what_is_no_request_gets_400_at_most_and_no_traceback(
    server: PageServer, text: str, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as raw:
        raw.sendall(text.encode("latin-1"))
        answer = b""
        while piece := raw.recv(4096):
            answer += piece
    refused = (b"HTTP/1.1 400 ", b"HTTP/1.1 403 ", b"HTTP/1.1 431 ")  # 403: a request for another machine
    assert answer.startswith(refused), answer[:200]
    assert text in NO_HTTP or answer.startswith(b"HTTP/1.1 400 ")
    assert "Traceback" not in capfd.readouterr().err and not caplog.records


def post(server: PageServer, path: str, body: bytes, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("POST", path, body, {"Host": f"localhost:{server.port}", **headers})
    answer = connection.getresponse()
    answer.read()
    return answer


def test_edits_are_judged_like_pages(server: PageServer) -> None:
    cookie, own = cookie_of(server), f"http://localhost:{server.port}"
    assert post(server, "/undo", b"{}", Cookie=cookie, Origin=own).status == 200
    assert post(server, "/undo", b"{}", Origin=own).status == 403
    assert post(server, "/undo", b"{}", Cookie=cookie, Origin="http://attacker.example").status == 403
    assert post(server, "/undo", b"{}", Cookie="ggslam-1=guess", Origin=own).status == 403
    fetched = {"Sec-Fetch-Site": "cross-site"}
    assert post(server, "/undo", b"{}", Cookie=cookie, **fetched).status == 403


def test_messages_have_an_end(server: PageServer) -> None:
    cookie = cookie_of(server)
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as raw:
        length = AccessTuning.max_message_bytes + 1
        headers = f"Host: localhost:{server.port}\r\nCookie: {cookie}\r\nContent-Length: {length}"
        raw.sendall(f"POST /edit HTTP/1.1\r\n{headers}\r\n\r\n".encode())
        assert raw.recv(4096).startswith(b"HTTP/1.1 413 ")
    for bad in ({"Content-Length": "-1"}, {"Transfer-Encoding": "chunked"}):
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        connection.putrequest("POST", "/edit", skip_host=True)
        for name, value in {"Host": f"localhost:{server.port}", "Cookie": cookie, **bad}.items():
            connection.putheader(name, value)
        connection.endheaders()
        assert connection.getresponse().status == 411
    assert post(server, "/edit", b"[" * 100_000, Cookie=cookie).status == 400


def test_a_page_may_fetch_nothing_from_elsewhere(server: PageServer) -> None:
    answer = get(server, "/", Cookie=cookie_of(server))
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "connect-src 'self'" in policy
    assert not re.search(r"https?:|\*", policy)
    assert answer.headers["X-Content-Type-Options"] == "nosniff" and answer.headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize("path", ["/../../etc/passwd", "/%2e%2e/x", "/static/page.js", "/scene/../x", "//etc/passwd"])
def test_there_are_no_files_behind_the_page(server: PageServer, path: str) -> None:
    assert get(server, path, Cookie=cookie_of(server)).status in (400, 404)


def test_connections_that_say_nothing_do_not_keep_others_out(server: PageServer) -> None:
    idle = [socket.create_connection(("127.0.0.1", server.port), timeout=10) for _ in range(20)]
    try:
        idle[0].sendall(b"GET / HTTP/1.1\r\nHost: localh")
        assert get(server, "/", Cookie=cookie_of(server)).status == 200
    finally:
        for one in idle:
            one.close()


@pytest.mark.parametrize(
    ("host", "name", "good"),
    [("127.0.0.1", "localhost:8080", True), ("127.0.0.1", "[::1]:8080", True), ("127.0.0.1", "192.168.1.4:8080", False),
     ("0.0.0.0", "192.168.1.4:8080", True), ("0.0.0.0", "attacker.example", False), ("::", "[fe80::1]:80", True),
     ("robot.local", "robot.local:8080", True), ("127.0.0.1", "", False)],
)  # fmt: skip
def test_names_of_this_machine(host: str, name: str, good: bool) -> None:
    gate = Gate(host)
    assert (gate.reason_to_refuse(f"/?token={gate.token}", {"Host": name}) is None) is good
