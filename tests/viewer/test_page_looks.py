# SPDX-License-Identifier: Apache-2.0
"""The page of one file, names of anybody's, light and dark, wide and narrow. Skips where chromium is not installed."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggslam.jobs.view.serve import serve_run, write_page
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import vote_label_image
from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import inverse

from . import browser as b
from .conftest import MAX_SPLATS
from .page_hand import Hand

pytestmark = pytest.mark.browser


def test_a_page_of_one_file_is_looked_at_and_edited(hand: Hand, run: RunFolder, tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    model, size = write_page(run, tmp_path / "room.html", max_splats=MAX_SPLATS, caption="<b>caption</b>")
    assert size == (tmp_path / "room.html").stat().st_size < 2_000_000
    hand.open((tmp_path / "room.html").as_uri())
    before = b.screenshot(hand.browser)[20:500, 80:600]
    assert before.std() > 8 and hand.text("caption") == "<b>caption</b>"
    assert len(hand.browser.find_elements("css selector", "#objects li")) == len(model.objects()) + 1
    # What is clicked in space is what the CPU renderer shows there.
    gaussians, rasterizer = run.segmented_map().gaussians, CpuRasterizer()
    view = rasterizer.forward(gaussians, model.camera, inverse(next(iter(model.frame_poses.values()))), features=False)
    labels = vote_label_image(rasterizer, view, gaussians.object_id.numpy().astype(np.uint16))
    expected = int(labels[round(model.camera.cy), round(model.camera.cx)])
    size_of = hand.ask("[ggslam.canvas.clientWidth, ggslam.canvas.clientHeight]")
    hand.drag([np.array(size_of) / 2])
    b.wait_for(lambda: hand.selected() == [expected])
    count = hand.ask("ggslam.total")
    assert not hand.browser.find_element("id", "do-recolor").is_enabled()  # that takes a program
    hand.keys(Keys.DELETE)
    gone = "(ggslam.map.marks.get('map') || []).reduce((sum, mark) => sum + (mark >> 1 & 1), 0)"
    hand.wait(f"{gone} === {count}")
    assert hand.ask("ggslam.map.pick(...arguments[0])?.id", (np.array(size_of) / 2).tolist()) != expected
    hand.keys(Keys.CONTROL, "z")
    hand.wait(f"{gone} === 0")
    hand.keys(Keys.CONTROL, "y")
    hand.wait(f"{gone} === {count}")
    hand.press("none")
    b.wait_for(lambda: b.screenshot(hand.browser)[20:500, 80:600].std() < before.std() / 2)
    loaded = hand.ask("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert all(name.startswith(("data:", "blob:")) for name in loaded), loaded
    assert b.messages(hand.browser) == []


def test_a_run_without_objects_has_no_list(hand: Hand, run: RunFolder, tmp_path: Path) -> None:
    plain = RunFolder(Path(shutil.copytree(run.path, tmp_path / "plain")))
    (plain.path / "objects.json").unlink()
    write_page(plain, tmp_path / "plain.html", max_splats=1000)
    hand.open((tmp_path / "plain.html").as_uri())
    assert not hand.browser.find_element("id", "objects").is_displayed()
    assert b.messages(hand.browser) == []


def test_names_are_no_markup(hand: Hand, run: RunFolder, tmp_path: Path) -> None:
    named = RunFolder(Path(shutil.copytree(run.path, tmp_path / "r<i>x")))
    table = named.object_table()
    name = "<iframe srcdoc='<script>parent.taken=1</script>'></iframe>![a](http://127.0.0.1:9/leak)</script>"
    replace(table, objects=[replace(table.objects[0], name=name), *table.objects[1:]]).save(named.path / "objects.json")
    server, model = serve_run(named, port=0, max_splats=1000)
    write_page(named, tmp_path / "named.html", max_splats=1000)
    try:
        for address in (server.address, (tmp_path / "named.html").as_uri()):
            hand.open(address)
            assert "r<i>x" in b.said(hand.browser)
            listed = hand.ask("document.querySelector('#objects .label').textContent")
            assert listed == f"{table.objects[0].id} · {name}"
            hand.browser.find_element("css selector", "#objects li").click()
            hand.wait("ggslam.total > 0")
            assert name in hand.text("chosen")
            assert not hand.ask("window.taken || document.querySelectorAll('iframe, h1 i').length")
            assert b.messages(hand.browser) == []
    finally:
        hand.browser.get("about:blank")
        server.close()
        hand.browser.get_log("browser")


_OUTSIDE = """[...document.querySelectorAll("aside button, aside input, aside select, aside label, #tools")]
    .filter((one) => one.checkVisibility()).filter((one) => { const r = one.getBoundingClientRect();
      return r.left < -0.5 || r.right > innerWidth + 0.5; }).map((one) => one.outerHTML.slice(0, 120))"""
_COVERED = """(() => { const found = [];
  const parts = [...document.querySelectorAll("aside button, aside input, aside select")]
    .filter((one) => one.checkVisibility() && !one.closest("li"));
  for (const [k, one] of parts.entries()) for (const other of parts.slice(k + 1)) {
    if (one.contains(other) || other.contains(one)) continue;
    const a = one.getBoundingClientRect(), b = other.getBoundingClientRect();
    const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const high = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (wide > 1.5 && high > 1.5) found.push([one.outerHTML.slice(0, 90), other.outerHTML.slice(0, 90)]); }
  return found; })()"""
_NAMELESS = """[...document.querySelectorAll("button, input, select, [role]")].filter((one) => one.checkVisibility())
    .filter((one) => !(one.textContent.trim() || one.getAttribute("aria-label") || one.labels?.length
      || one.getAttribute("aria-hidden"))).map((one) => one.outerHTML.slice(0, 120))"""


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (400, 800), (360, 640)])
def test_nothing_overlaps(hand: Hand, run: RunFolder, width: int, height: int, tmp_path: Path) -> None:
    """Wide and narrow, with all parts of the panel open and many objects of long names."""
    many = RunFolder(Path(shutil.copytree(run.path, tmp_path / "many")))
    write_page(many, tmp_path / "many.html", max_splats=1000)
    browser: Any = hand.browser
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        hand.open((tmp_path / "many.html").as_uri())
        hand.ask("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        more = """(() => { const { scene } = ggslam, first = scene.objects[0], began = performance.now();
            for (let k = 0; k < 500; k++) scene.objects.push({ ...first, id: 1000 + k, name: `${k} long `.repeat(9) });
            ggslam.sceneChanged(); ggslam.choose("set", { kind: "objects", ids: [1400] });
            return performance.now() - began; })()"""
        assert hand.ask(more) < 2000  # milliseconds; 40 on a quiet machine
        hand.keys("6")
        assert hand.ask(_OUTSIDE) == [] and hand.ask(_COVERED) == [] and hand.ask(_NAMELESS) == []
        assert hand.ask("document.documentElement.scrollWidth") <= width
        assert hand.ask("ggslam.canvas.clientHeight") > 0.4 * height
        assert b.messages(browser) == []
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_light_and_dark(hand: Hand, run: RunFolder, tmp_path: Path) -> None:
    write_page(run, tmp_path / "room.html", max_splats=1000)
    luminance = "getComputedStyle(document.querySelector('aside')).backgroundColor.match(/\\d+/g).map(Number)[0]"
    for wish, bright in (("dark", False), ("light", True)):
        features = [{"name": "prefers-color-scheme", "value": wish}]
        hand.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        hand.open((tmp_path / "room.html").as_uri())
        hand.ask("localStorage.removeItem('ggslam-theme')")
        hand.open((tmp_path / "room.html").as_uri())
        assert (hand.ask(luminance) > 128) is bright
        assert hand.ask("getComputedStyle(document.documentElement).colorScheme") == wish
        assert (max(hand.ask("ggslam.map.background")) > 128) is bright
        hand.press("theme")
        assert (hand.ask(luminance) > 128) is not bright
        hand.ask("localStorage.removeItem('ggslam-theme')")
    hand.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert b.messages(hand.browser) == []
