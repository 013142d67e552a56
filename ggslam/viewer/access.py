# SPDX-License-Identifier: Apache-2.0
"""Access to the page: only with the printed address, and only under this machine's own names.

A browser lets every page that is open in it send requests to localhost. So a request must name a host that is ours (a
name of somebody else's that was bent to 127.0.0.1 is not), come from no other page, and carry the token of the printed
address or the cookie that it was exchanged for.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from ggslam.system.tuning import Tuning


class AccessTuning(Tuning):
    """Limits of what a page sends."""

    max_message_bytes = 1 << 20
    """Largest message, in bytes; what is drawn on a screen takes the most."""


_ANYWHERE = ("0.0.0.0", "::", "")
_HOST = re.compile(r"(?:\[(?P<six>[0-9A-Fa-f:.]{2,45})\]|(?P<name>[A-Za-z0-9._-]{1,253}))(?::(?P<port>[0-9]{1,5}))?")
_SCHEME = "http"
"""Of all our pages. One that a proxy serves under another name or scheme is not ours."""


class MalformedRequest(ValueError):
    """A request that is no good HTTP."""


@dataclass
class Gate:
    """Judges requests for the page.

    Attributes:
        host: that the server listens at.
        token: of the printed address.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))

    def reason_to_refuse(self, path: str, headers: Any) -> str | None:
        """Why a request is refused; None: it is not.

        Args:
            path: of the request, with its query.
            headers: mapping by name.

        Raises:
            MalformedRequest: they are not what HTTP allows: no address, or a header twice.
        """
        try:
            return self._reason_to_refuse(path, headers)
        except (ValueError, LookupError) as error:
            raise MalformedRequest(str(error)) from None

    def _reason_to_refuse(self, path: str, headers: Any) -> str | None:
        host = headers.get("Host") or ""
        if not self._is_own(_name_and_port(host)[0]):
            return f"host {host[:80]!r} is none of this server's"
        origin = headers.get("Origin")
        if origin is not None and origin.lower() != f"{_SCHEME}://{host.lower()}":
            return f"a page of {origin[:80]!r} may not use it"
        if self._has_token(path):
            return None
        # A page of another port is of the same site: frames, images and links in it carry the cookie and no origin.
        sender = headers.get("Sec-Fetch-Site")
        if sender not in (None, "none", "same-origin"):
            return f"a page of another origin ({sender[:20]!r}) may not use it"
        if self._has_cookie(headers.get("Cookie") or "", host):
            return None
        return "without the token of the printed address"

    def wants_cookie(self, path: str) -> bool:
        """Whether a request brings the token, which a cookie takes the place of from then on."""
        return self._has_token(path)

    def cookie(self, host: str) -> str:
        """Value of Set-Cookie for a host and port: scripts cannot read it, other pages' requests do not carry it."""
        return f"{_cookie_name(host)}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _has_token(self, path: str) -> bool:
        given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self.token.encode())

    def _has_cookie(self, text: str, host: str) -> bool:
        try:
            found = SimpleCookie(text).get(_cookie_name(host))
        except CookieError:
            return False
        return found is not None and hmac.compare_digest(found.value.encode(), self.token.encode())

    def _is_own(self, name: str | None) -> bool:
        if not name:
            return False
        if name in ("localhost", "127.0.0.1", "::1", self.host):
            return True
        if self.host not in _ANYWHERE:
            return False
        if name == socket.gethostname().lower():
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True  # an address cannot be bent to another machine as a name can


def _name_and_port(host: str) -> tuple[str, int]:
    """What a Host header says.

    Raises:
        ValueError: it is no host, with or without a port.
    """
    if not host:
        return "", 80
    match = _HOST.fullmatch(host)
    if match is None or int(match["port"] or 80) > 0xFFFF:
        raise ValueError("no host")
    if match["six"]:
        ipaddress.IPv6Address(match["six"])
    return (match["six"] or match["name"]).lower(), int(match["port"] or 80)


def _cookie_name(host: str) -> str:
    """Cookies do not tell ports apart; two viewers on one machine must not share one."""
    return f"ggslam-{_name_and_port(host)[1]}"
