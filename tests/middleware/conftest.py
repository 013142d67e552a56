# SPDX-License-Identifier: Apache-2.0
"""Tests that take `network` run over Zenoh and over DDS."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from networks import Network, free_port

PACKAGES = {"zenoh": "zenoh", "dds": "cyclonedds"}


@pytest.fixture(params=["zenoh", "dds"])
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    pytest.importorskip(PACKAGES[request.param])
    pytest.importorskip("rosbags")
    yield Network(request.param, free_port(), random.randrange(100, 200))
