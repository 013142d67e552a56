# SPDX-License-Identifier: Apache-2.0
"""The text of the page: one template and its scripts, for the page of one file and for served ones."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any, Final

from ggslam.system.json_files import json_ready
from ggslam.viewer.packed_splats import MAP_SCRIPTS

STATIC = Path(__file__).with_name("static")
SCRIPTS: Final = (
    *MAP_SCRIPTS, "vectors.js", "camera.js", "shapes.js", "selection.js", "history.js", "source.js", "link.js",
    "tools.js", "measure.js", "search.js", "film.js", "notes.js", "move_handles.js", "object_list.js", "panels.js",
    "selection_panels.js", "record_panels.js", "keyboard.js", "viewer_colors.js", "viewer_selection.js",
    "viewer_edits.js", "viewer_sharing.js", "viewer_looks.js", "viewer_live.js", "page.js",
)  # fmt: skip
"""In the order in which the page needs them."""
FILE_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:"
)
"""What a page of one file may do: nothing from anywhere."""
SERVED_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
)
"""What a served page may do: ask the program that serves it."""


def file_page(title: str, scene: dict[str, Any], splats: bytes) -> str:
    """A page that holds a map.

    Args:
        title: of the window.
        scene: see `scene_values`; with "chunks", one of them, whose header is in "splats".
        splats: packed.
    """
    return _page(title, FILE_POLICY, _json(scene), base64.b64encode(splats).decode("ascii"))


def served_page(title: str) -> str:
    """A page that asks for its map."""
    return _page(title, SERVED_POLICY.replace("; frame-ancestors 'none'", ""), "null", "")


def _page(title: str, policy: str, scene: str, splats: str) -> str:
    script = "\n".join((STATIC / name).read_text(encoding="utf-8") for name in SCRIPTS)
    page = (STATIC / "page.html").read_text(encoding="utf-8")
    page = page.replace("@STYLE@", (STATIC / "page.css").read_text(encoding="utf-8"))
    page = page.replace("@POLICY@", policy).replace("@TITLE@", html.escape(title)).replace("@SCRIPT@", script)
    return page.replace("@SCENE@", scene).replace("@SPLATS@", splats)


def _json(values: Any) -> str:
    """JSON that cannot end the element of the page that it is in, whatever names it holds."""
    return json.dumps(json_ready(values)).replace("<", "\\u003c").replace("@", "\\u0040")
