# SPDX-License-Identifier: Apache-2.0
"""A page with nothing but a map: what `MapView` does, without the controls of the real page."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggslam.rendering.types import Gaussians
from ggslam.scene.gaussian_map import SH_C0
from ggslam.scene.poses import inverse
from ggslam.viewer.packed_splats import MAP_SCRIPTS, SCALES, STATIC, pack_splats
from ggslam.viewer.splats import colors_to_uint8

_PAGE = """<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,">
<style>body {{ margin: 0; }} #space {{ position: relative; width: {width}px; height: {height}px; }}
canvas {{ position: absolute; inset: 0; width: 100%; height: 100%; }}</style>
<div id="space"><canvas id="top"></canvas></div>
<script>"use strict";
{script}
const camera = {{ pose: {pose}, near: 0.05, pixels: {focal}, view() {{ return Float32Array.from(this.pose); }},
  focal(width) {{ return this.pixels * width / {width}; }} }};
const map = new MapView(document.getElementById("top"), camera, {{ background: [0, 0, 0] }});
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
const loaded = (async () => {{
  for (const [id, header, packed] of {chunks}) map.setChunk(id, await unpackSplats(bytes(packed), header));
}})();
</script>"""


def write_map_page(
    path: Path, chunks: dict[str, tuple[Gaussians, np.ndarray, np.ndarray]], size: tuple[int, int], focal: float,
    T_world_camera: np.ndarray, seen: np.ndarray | None = None,
) -> Path:  # fmt: skip
    """Writes a page with a map of `size` (width, height) in CSS pixels.

    Args:
        chunks: by name, Gaussians, rows of them and object ids of these rows.
        seen: of all Gaussians, see `viewed_sides`.
    """
    packed = []
    for name, (gaussians, rows, owners) in chunks.items():
        colors = colors_to_uint8(0.5 + SH_C0 * gaussians.sh.numpy()[rows, 0])
        data, low, high = pack_splats(gaussians, rows, colors, owners, None, None if seen is None else seen[rows])
        header = {
            "count": len(rows),
            "low": low.tolist(),
            "high": high.tolist(),
            "scales": SCALES,
            "identity": False,
            "seen": seen is not None,
        }
        packed.append([name, header, base64.b64encode(data).decode("ascii")])
    script = "\n".join((STATIC / name).read_text(encoding="utf-8") for name in MAP_SCRIPTS)
    path.write_text(_PAGE.format(
        width=size[0], height=size[1], focal=focal, script=script, pose=json.dumps(_columns(T_world_camera)),
        chunks=json.dumps(packed),
    ))  # fmt: skip
    return path


def open_map(browser: Any, page: Path, renderer: str) -> None:
    """Opens it and waits until the map is shown."""
    browser.get(f"{page.as_uri()}?renderer={renderer}")
    assert ask(browser, "await loaded; await map.ready; return map.mode") == renderer


def ask(browser: Any, code: str, *values: Any) -> Any:
    """What the body of an asynchronous function gives; `values` are its arguments."""
    answer = browser.execute_async_script(
        f"const done = arguments[arguments.length - 1]; (async (...values) => {{ {code} }})(...arguments)"
        ".then((value) => done({ value }), (error) => done({ error: String(error.stack || error) }));", *values
    )  # fmt: skip
    assert "error" not in answer, answer
    return answer.get("value")


def look_from(browser: Any, T_world_camera: np.ndarray) -> None:
    """Moves the camera, and waits for the sharp picture."""
    ask(browser, "camera.pose = values[0]; map.redraw()", _columns(T_world_camera))


def picture(browser: Any) -> np.ndarray:
    """The sharp picture uint8 [H, W, 3], RGB."""
    code = """const sorted = async () => {
        if (map.mode === "webgl") { map.redraw(); await new Promise((r) => setTimeout(r, 50));
          const busy = () => map.renderer.sorting || map.waiting || map.renderer.wanted;
          while (busy()) await new Promise((r) => setTimeout(r, 20)); } };
      await sorted(); const blob = await map.screenshot(), array = new Uint8Array(await blob.arrayBuffer());
      let text = ""; for (const byte of array) text += String.fromCharCode(byte); return btoa(text);"""
    data = base64.b64decode(ask(browser, code))
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return found[..., ::-1]


def depth_image(browser: Any, width: int, height: int) -> np.ndarray:
    """float32 [H, W], metres."""
    code = """const depth = new Uint8Array((await map.depthImage(...values)).buffer);
      let text = ""; for (const byte of depth) text += String.fromCharCode(byte); return btoa(text);"""
    return np.frombuffer(base64.b64decode(ask(browser, code, width, height)), np.float32).reshape(height, width)


def _columns(T_world_camera: np.ndarray) -> list[float]:
    columns: list[float] = inverse(T_world_camera).T.ravel().tolist()
    return columns
