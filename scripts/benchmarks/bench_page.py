#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How often a run's page is drawn while the mouse drags, in a browser without a GPU.

    python scripts/benchmarks/bench_page.py out/livingroom --folder /tmp/page
    python scripts/benchmarks/bench_page.py out/livingroom --folder /tmp/page --splats 64000 --seconds 10

Writes the run as pages of one file with the most visible Gaussians, opens each in headless chromium at 1280 x 800 CSS
pixels, and drags the mouse over the map through CDP events, 60 a second, around a circle. Pictures of the map that
reached the canvas during the drag are counted. Each number of splats is measured three times: by WebGL that the
processor emulates (SwiftShader) at half resolution, the reference of the ratio, where reading back a pixel after each
picture makes sure that it is complete; by the page's workers in the same browser (`emulated`: SwiftShader still puts
the page together); and by the workers in a browser that was started without any GPU (`none`). `pixels` is what a CSS
pixel had when the drag ended, `sharp` the time from its last coarse picture to the sharp one.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from commands import ROOT

sys.path.insert(0, str(ROOT))
from ggslam.jobs.view.serve import write_page
from ggslam.runs.folder import RunFolder
from tests.viewer.browser import open_browser, wait_for

EVENTS_PER_S = 60
CASES = [("webgl", "emulated"), ("processor", "emulated"), ("processor", "none")]
_COUNT = """
const map = window.ggslam.map, shown = map.renderer.onframe, gl = map.renderer.gl;
window.counted = { coarse: 0, coarseAt: 0, sharpAt: 0 };
if (gl) { map.resolution.least = map.resolution.most = map.resolution.scale = 0.5; map.redraw(); }
map.renderer.onframe = (shot, complete) => {
  if (gl) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  if (shot.sharp) counted.sharpAt = performance.now(); else { counted.coarse++; counted.coarseAt = performance.now(); }
  shown(shot, complete);
};
"""


@dataclass(frozen=True)
class Result:
    """Of a drag: pictures/s, ms a picture, pixels of the picture per CSS pixel, seconds until it was sharp."""

    pictures_per_s: float
    frame_ms: float
    scale: float
    sharp_s: float


def mouse(browser: Any, kind: str, x: float, y: float) -> None:
    pressed = {"button": "left", "buttons": 1, "clickCount": 1}
    browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, **pressed})


def drag(browser: Any, seconds: float) -> Result:
    """Drags around a circle in the middle of the map."""
    box = browser.execute_script(
        "const r = ggslam.map.canvas.getBoundingClientRect(); return [r.x, r.y, r.width, r.height]"
    )
    x, y = box[0] + box[2] / 2, box[1] + box[3] / 2
    radius = min(box[2], box[3]) / 4
    mouse(browser, "mousePressed", x + radius, y)
    warm, start, first, steps = 1.0, time.monotonic(), 0, 0
    while (now := time.monotonic() - start) < warm + seconds:
        if now > warm and not first:
            first, since = browser.execute_script("return [counted.coarse, performance.now()]")
            first = first or 1
        angle = 2 * math.pi * now / 4
        mouse(browser, "mouseMoved", x + radius * math.cos(angle), y + radius * math.sin(angle))
        steps += 1
        time.sleep(max(0.0, start + steps / EVENTS_PER_S - time.monotonic()))
    count, until, stats = browser.execute_script("return [counted.coarse, performance.now(), ggslam.map.stats]")
    mouse(browser, "mouseReleased", x, y)
    sharp = wait_for(lambda: browser.execute_script("return Math.max(0, counted.sharpAt - counted.coarseAt)"))
    return Result(1000 * (count - first) / (until - since), stats["frameMs"], stats["scale"], sharp / 1000)


def measured(page: Path, renderer: str, gpu: str, seconds: float) -> Result:
    browser = open_browser(1280, 890, *(["--disable-gpu"] if gpu == "none" else []))
    try:
        inner = browser.execute_script("return [innerWidth, innerHeight]")
        browser.set_window_size(1280 + 1280 - inner[0], 890 + 800 - inner[1])
        browser.get(f"{page.as_uri()}?renderer={renderer}")
        wait_for(lambda: browser.execute_script("return !!window.ggslam && !!ggslam.drawn"))
        time.sleep(1)
        browser.execute_script(_COUNT)
        return drag(browser, seconds)
    finally:
        browser.quit()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--folder", type=Path, required=True, help="for the pages")
    parser.add_argument("--splats", type=int, nargs="+", default=[10_000, 64_000, 100_000])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--only", action="store_true", help="measure the workers without a GPU only")
    arguments = parser.parse_args()
    folder = RunFolder.open(arguments.run)
    print(
        f"{'splats':>8}  {'renderer':<11}{'GPU':<9}{'pictures/s':>11}{'ms each':>9}{'pixels':>8}{'sharp s':>9}  ratio"
    )
    for count in arguments.splats:
        page = arguments.folder.resolve() / f"page-{count}.html"
        write_page(folder, page, max_splats=count)
        reference = None
        for renderer, gpu in CASES if not arguments.only else [CASES[-1]]:
            found = measured(page, renderer, gpu, arguments.seconds)
            reference = reference or found.pictures_per_s
            numbers = f"{found.pictures_per_s:>11.1f}{found.frame_ms:>9.1f}{found.scale:>8.2f}{found.sharp_s:>9.2f}"
            ratio = found.pictures_per_s / max(reference, 1e-3)
            print(f"{count:>8}  {renderer:<11}{gpu:<9}{numbers}{ratio:>7.1f}", flush=True)


if __name__ == "__main__":
    main()
