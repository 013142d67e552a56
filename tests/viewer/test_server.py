# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import builtins
import socket
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ggslam.errors import ConfigError, MissingDependency
from ggslam.viewer.objects_tab import object_list
from ggslam.viewer.server import address, close_server, open_server


def test_a_taken_port_is_told() -> None:
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match="--port"):
            open_server(port=taken.getsockname()[1])


def test_only_this_machine_can_connect() -> None:
    pytest.importorskip("viser")
    server = open_server(port=0)
    try:
        assert server.get_host() == "127.0.0.1" and address(server).startswith("http://localhost:")
        assert server.request_share_url() is None
        with socket.create_connection(("127.0.0.1", server.get_port()), timeout=5):
            pass
    finally:
        close_server(server)


def test_without_viser_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def missing(name: str, *rest: Any, **named: Any) -> Any:
        if name == "viser":
            raise ImportError("No module named 'viser'")
        return original(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(MissingDependency, match=r"ggslam\[viewer\]"):
        open_server(port=0)


def test_names_in_the_list_are_no_markup() -> None:
    from ggslam.viewer.model import ListedObject

    record = ListedObject(3, "<b>cup", (1, 2, 3), 1200, np.zeros(3), np.eye(3), np.ones(3), np.zeros(3))
    text = object_list([record], {3}, None)
    assert "<b>" not in text and "&lt;b&gt;cup" in text and "1,200" in text and "opacity" in text
    assert SimpleNamespace(label=record.label).label == "3 · <b>cup"
