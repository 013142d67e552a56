# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import builtins
import html
import socket
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ggslam.errors import ConfigError, MissingDependency
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder
from ggslam.viewer.objects_tab import object_list
from ggslam.viewer.page import Page
from ggslam.viewer.safe_text import plain
from ggslam.viewer.server import address, close_server, open_server


def test_a_taken_port_is_told() -> None:
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match="`port`"):
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


@pytest.mark.parametrize(
    "name", ["<iframe srcdoc='<script>parent.X=1</script>'>", "![a](http://x/y)", "[a](b)", "**a**", "{a}", "a_b_ `c`"]
)
def test_words_in_markdown_are_no_markup(name: str) -> None:
    text = plain(f"{name}\n# next")
    assert not set(text) & set("<>*_`[](){}!\n\"'") and html.unescape(text) == f"{name} # next"
    assert plain("café 椅子 🛋") == "café 椅子 🛋"


@pytest.mark.parametrize("host", ["", "nonsense.invalid", "8.8.8.8"])
def test_an_address_of_elsewhere_is_told(host: str) -> None:
    pytest.importorskip("viser")
    with pytest.raises(ConfigError, match="`host`"):
        open_server(host, 0)


def test_what_another_page_took_away_is_told(run: RunFolder) -> None:
    pytest.importorskip("viser")
    server = open_server(port=0)
    try:
        model = ViewedRun(run)
        page = Page(server, model, model, "room")
        assert page.objects is not None
        removed = [record.id for record in model.objects()[:4]]

        def remove(object_id: int) -> None:
            page.objects._alone(lambda event: _remove(page.objects, model, object_id))(None)

        with ThreadPoolExecutor(4) as pool:
            list(pool.map(remove, removed))
        assert len(model.edits()) == 4 and not set(removed) & {record.id for record in model.objects()}
        with pytest.raises(ConfigError, match="selected"):
            page.objects._one()
    finally:
        close_server(server)


def _remove(tab: Any, model: ViewedRun, object_id: int) -> None:
    tab.select(object_id)
    tab._edit(model.remove(tab._one()))
