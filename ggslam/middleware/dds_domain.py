# SPDX-License-Identifier: Apache-2.0
"""Domains of DDS: their configuration, and participants in them."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from typing import Any, Final
from xml.sax.saxutils import quoteattr

from ggslam.errors import MiddlewareError, MissingDependency
from ggslam.middleware.node import HIGHEST_DOMAIN

CONFIG: Final = "CYCLONEDDS_URI"
"""Variable that adds to the configuration, as for rmw_cyclonedds_cpp; what it says counts."""
RECEIVE_BUFFER: Final = "16MiB"
"""Wanted for a socket; the system gives what it allows (net.core.rmem_max). A picture comes as a burst of 1 MB."""
UNACKNOWLEDGED: Final = "256MiB"
"""A writer would wait for slow readers when this much is not acknowledged. The depth of a topic's history bounds it
long before: older messages make room."""
LOOPBACK_MESSAGE: Final = "65500B"
"""Largest datagram on this machine alone: fewer, so less processor time, than those of a network."""
LOOPBACK_FRAGMENT: Final = "65000B"

Participant = Any


def configuration(address: str) -> str:
    """XML for Cyclone DDS. An address of this machine alone leaves multicast off; so nothing of it is seen outside."""
    alone = address in ("127.0.0.1", "localhost", "::1", "lo")
    general, discovery = "", ""
    if address:
        named = "name" if not any(sign in address for sign in ".:") and address != "localhost" else "address"
        where = "127.0.0.1" if address == "localhost" else address
        general = f"<Interfaces><NetworkInterface {named}={quoteattr(where)}/></Interfaces>"
    if alone:
        general += "<AllowMulticast>false</AllowMulticast>"
        general += f"<MaxMessageSize>{LOOPBACK_MESSAGE}</MaxMessageSize>"
        general += f"<FragmentSize>{LOOPBACK_FRAGMENT}</FragmentSize>"
        discovery = (
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
            '<Peers><Peer Address="127.0.0.1"/></Peers></Discovery>'
        )
    internal = (
        f'<SocketReceiveBufferSize max="{RECEIVE_BUFFER}"/><Watermarks><WhcAdaptive>false</WhcAdaptive>'
        f"<WhcHigh>{UNACKNOWLEDGED}</WhcHigh></Watermarks>"
    )
    body = f"<General>{general}</General>{discovery}<Internal>{internal}</Internal>"
    own = f'<CycloneDDS><Domain Id="any">{body}</Domain></CycloneDDS>'
    return ",".join(part for part in (own, os.environ.get(CONFIG, "")) if part)


@dataclass
class Joined:
    """A domain of this process."""

    domain: Any
    address: str
    participants: int = 0


class Domains:
    """The domains that this process is in: a process has one configuration for each."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._joined: dict[int, Joined] = {}

    def join(self, number: int, address: str) -> Participant:
        """A participant; `leave` ends it.

        Raises:
            MissingDependency: cyclonedds is not installed.
            MiddlewareError: the domain cannot be joined.
        """
        try:
            from cyclonedds.core import DDSException
            from cyclonedds.domain import Domain, DomainParticipant
        except ImportError as error:
            raise MissingDependency(f"DDS needs cyclonedds: pip install 'ggslam[ros2]' ({error})") from None
        if not 0 <= number <= HIGHEST_DOMAIN:
            raise MiddlewareError(f"`domain`: expected 0 to {HIGHEST_DOMAIN}, found {number}")
        with self._lock:
            joined = self._joined.get(number)
            if joined is not None and joined.address != address:
                raise MiddlewareError(f"`{address}`: this process is in domain {number} by `{joined.address}`")
            try:
                if joined is None:
                    joined = self._joined[number] = Joined(self._open(Domain, number, address), address)
                participant = DomainParticipant(number)
            except DDSException as error:
                self._drop_unused(number)
                where = address or "this machine"
                raise MiddlewareError(f"`{where}`: domain {number} cannot be joined: {error.msg}") from None
            joined.participants += 1
            return participant

    def leave(self, number: int, participant: Participant) -> None:
        """Ends a participant, with all that belongs to it."""
        with self._lock:
            delete(participant)
            self._joined[number].participants -= 1
            self._drop_unused(number)

    @staticmethod
    def _open(made: Any, number: int, address: str) -> Any:
        from cyclonedds.core import DDSException

        try:
            return made(number, configuration(address))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
                raise
            return None  # somebody else's code in this process has it, with its own configuration

    def _drop_unused(self, number: int) -> None:
        joined = self._joined.get(number)
        if joined is not None and not joined.participants:
            del self._joined[number]
            if joined.domain is not None:
                delete(joined.domain)


def delete(entity: Any) -> None:
    """Ends an entity of DDS now; cyclonedds would when Python forgets it."""
    entity.__del__()


DOMAINS: Final = Domains()
