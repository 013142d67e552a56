# SPDX-License-Identifier: Apache-2.0
"""Nodes that cannot be opened say why."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from ggslam.errors import MiddlewareError, MissingDependency
from ggslam.middleware.dds_domain import DOMAINS
from ggslam.middleware.node import NodeRequest
from ggslam.middleware.opening import open_node
from ggslam.middleware.types import MessageTypes
from ggslam.middleware.zenoh_session import open_session


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, action in (
        ("zenoh", lambda: open_session("")),
        ("cyclonedds.domain", lambda: DOMAINS.join(1, "")),
        ("rosbags.typesys", lambda: MessageTypes("jazzy")),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingDependency, match=r"pip install 'ggslam\[ros2\]'"):
            action()


@pytest.mark.parametrize(
    ("fields", "name", "told"),
    [
        ({"middleware": "smoke"}, "own", "smoke"),
        ({"middleware": "zenoh"}, "own node", "own node"),
        ({"middleware": "dds", "namespace": "a b"}, "own", "/a b"),
        ({"middleware": "dds", "distribution": "groovy"}, "own", "groovy"),
        ({"middleware": "zenoh", "address": "nowhere"}, "own", "nowhere"),
        ({"middleware": "dds", "domain": 500}, "own", "500"),
    ],
)
def test_bad_requests_are_named(fields: dict[str, Any], name: str, told: str) -> None:
    pytest.importorskip("rosbags")
    pytest.importorskip("zenoh")
    pytest.importorskip("cyclonedds")
    with pytest.raises(MiddlewareError, match=told):
        open_node(NodeRequest(**fields), name)
