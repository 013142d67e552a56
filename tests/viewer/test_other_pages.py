# SPDX-License-Identifier: Apache-2.0
"""A page of somebody else that is open in the same browser as the viewer, in a real browser: it gets nothing."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from ggslam.viewer.access import Gate
from ggslam.viewer.page_server import PageServer

from . import browser as b

pytestmark = pytest.mark.browser
BENT_NAME = "attacker.example"
"""A name of somebody else's that the browser finds at this machine."""
PAGE = """<!doctype html><title>other</title><body><script>
const target = "http://localhost:PORT/", said = window.said = {};
function note(name, promise) { promise.then((ok) => said[name] = ok, (error) => said[name] = "refused"); }
note("socket", new Promise((yes, no) => {
  const events = new EventSource("http://localhost:PORT/events", { withCredentials: true });
  events.onopen = () => yes("open"); events.onmessage = () => yes("message"); events.onerror = no;
}));
note("fetch", fetch(target, { credentials: "include" }).then((answer) => answer.text()));
note("post", fetch(target, { method: "POST", credentials: "include", body: "x" }).then((answer) => answer.text()));
note("silent", fetch(target, { mode: "no-cors", credentials: "include" }).then((answer) => answer.type));
note("image", new Promise((yes, no) => {
  const image = new Image(); image.onload = () => yes("shown"); image.onerror = no; image.src = target;
}));
for (const method of ["get", "post"]) note(method + " form", new Promise((yes) => {
  const frame = document.body.appendChild(Object.assign(document.createElement("iframe"), { name: method }));
  const form = document.body.appendChild(Object.assign(document.createElement("form"), { target: method }));
  form.action = target; form.method = method;
  frame.onload = () => yes("answered"); form.submit(); setTimeout(() => yes("nothing"), 3000);
}));
note("frame", new Promise((yes) => {
  const frame = document.body.appendChild(document.createElement("iframe"));
  frame.onload = () => yes("answered"); frame.src = target;
}));
</script>"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    page = b.open_browser(500, 400, f"--host-resolver-rules=MAP {BENT_NAME} 127.0.0.1")
    yield page
    page.quit()


@pytest.fixture
def server() -> Iterator[Any]:
    opened = PageServer(port=0, title="my map")
    yield opened
    opened.close()


@pytest.fixture
def other_port(server: Any) -> Iterator[int]:
    """Where another page of this machine is served."""

    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(PAGE.replace("PORT", str(server.port)).encode())

        def log_message(self, *arguments: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Other) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        yield other.server_port
        other.shutdown()


@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("localhost", "127.0.0.1")), BENT_NAME]
)
def test_a_page_of_another_origin_gets_nothing(
    browser: Any, server: Any, other_port: int, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser.get(server.address)  # the cookie is in the browser from now on
    b.wait_for(lambda: server.watchers)
    judged: list[str | None] = []
    real = Gate.reason_to_refuse

    def judge(gate: Gate, path: str, headers: Any) -> str | None:
        judged.append(real(gate, path, headers))
        return judged[-1]

    monkeypatch.setattr(Gate, "reason_to_refuse", judge)
    browser.get(f"http://{name}:{other_port}/")
    said = b.wait_for(lambda: len(browser.execute_script("return window.said")) == 8 and browser.execute_script(
        "return window.said"))  # fmt: skip
    assert {said[what] for what in ("socket", "fetch", "post", "image")} == {"refused"}, said
    assert len(judged) >= 5 and all(judged), judged  # what a page cannot see of an answer was refused as well
    browser.get(f"http://localhost:{server.port}/")  # and its own page still opens
    b.wait_for(lambda: "my map" in b.said(browser))


def test_a_bent_name_shows_nothing(browser: Any, server: Any) -> None:
    browser.get(server.address.replace("localhost", BENT_NAME))
    assert "403: open the address that ggslam printed" in b.said(browser)
    assert not server.watchers and not browser.get_cookies()
