# SPDX-License-Identifier: Apache-2.0
"""Who is on the network, by the tokens of rmw_zenoh_cpp."""

from __future__ import annotations

import threading
import time
from typing import Any

from ggslam.middleware.zenoh_keys import SPACE, Shown, read_token


class Graph:
    """Publishers, subscriptions, services and clients of a domain, as their tokens come and go."""

    def __init__(self, session: Any, domain: int) -> None:
        self._changed = threading.Condition()
        self._shown: dict[str, Shown] = {}
        self._subscriber = session.liveliness().declare_subscriber(f"{SPACE}/{domain}/**", self._take, history=True)
        self._closed = False

    def _take(self, sample: Any) -> None:
        import zenoh

        token = str(sample.key_expr)
        found = read_token(token)
        with self._changed:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._shown.pop(token, None)
            elif found is not None:
                self._shown[token] = found
            self._changed.notify_all()

    def hashes(self, entity: str, name: str, kind: str) -> list[str]:
        """Hash of the type of each such entity there is now: "MP", "MS", "SS" or "SC"."""
        with self._changed:
            return self._hashes(entity, name, kind)

    def wait_for(self, entity: str, name: str, kind: str, deadline: float) -> list[str]:
        """The same; waits until there is one, at most until `deadline` of the monotonic clock."""
        with self._changed:
            self._changed.wait_for(lambda: self._hashes(entity, name, kind), max(0.0, deadline - time.monotonic()))
            return self._hashes(entity, name, kind)

    def _hashes(self, entity: str, name: str, kind: str) -> list[str]:
        wanted = (entity, name, kind)
        return [one.type_hash for one in self._shown.values() if (one.entity, one.name, one.kind) == wanted]

    def topics(self) -> dict[str, str]:
        """Topics and their types."""
        with self._changed:
            return {shown.name: shown.kind for shown in self._shown.values() if shown.entity in ("MP", "MS")}

    def close(self) -> None:
        """Looks no more."""
        if not self._closed:
            self._closed = True
            self._subscriber.undeclare()
