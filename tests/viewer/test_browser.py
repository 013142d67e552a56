# SPDX-License-Identifier: Apache-2.0
"""The pages in a real browser: chromium without a screen, drawing in software. Skips where it is not installed."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ggslam.run_folder import RunFolder
from ggslam.viewer.server import address, close_server
from ggslam.viewing_jobs import serve_run, write_page

pytestmark = pytest.mark.browser
MAX_SPLATS = 4000
"""Drawn in software, a frame of more would take seconds."""
LIBRARY_NOISE = "computeBoundingSphere(): Computed radius is NaN"
"""three.js says so of viser's splats, whose corners have two coordinates; nothing comes of it."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    selenium = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("chromium and chromedriver are not installed")
    options = selenium.ChromeOptions()
    options.binary_location = program
    for argument in (
        "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--window-size=640,480", "--disable-dev-shm-usage",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    page = selenium.Chrome(options=options, service=selenium.ChromeService(driver))
    yield page
    page.quit()


def wait_for(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """What `condition` gives once it is true."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.3)
    return found


def screenshot(browser: Any) -> np.ndarray:
    """uint8 [H, W, 3]. Software drawing may keep the browser from answering for a while."""
    from selenium.common.exceptions import TimeoutException

    for _ in range(8):
        try:
            data = io.BytesIO(browser.get_screenshot_as_png()).getvalue()
            return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        except TimeoutException:
            continue
    raise AssertionError("the browser draws nothing")


def errors(browser: Any) -> list[str]:
    """What the console complained about."""
    found = [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    return [message for message in found if LIBRARY_NOISE not in message]


def press(browser: Any, selector: str, text: str) -> None:
    """Clicks the first visible element of some text, or input of some value, as a person would."""
    from selenium.common.exceptions import WebDriverException

    def pressed() -> bool:
        for found in browser.find_elements("css selector", selector):
            try:
                if text in (found.text.strip(), found.get_attribute("value")):
                    found.click()
                    return True
            except WebDriverException:  # covered, moving, or gone by now
                continue
        return False

    wait_for(pressed)


def test_an_object_is_removed_through_the_page(browser: Any, run: RunFolder) -> None:
    server, model = serve_run(run, port=0, max_splats=MAX_SPLATS)
    try:
        browser.get(address(server) + "?fixedDpr=0.4")
        wait_for(lambda: "Gaussians" in browser.execute_script("return document.body.innerText"))
        # The part of the window that shows space: what is drawn there has many colours.
        wait_for(lambda: screenshot(browser)[240:460, 40:300].std() > 8)
        record = model.objects()[2]
        press(browser, "[role=tab]", "Objects")
        press(browser, "input[role=combobox]", "(none)")
        press(browser, "[role=option]", record.label)
        press(browser, "button", "Delete")
        wait_for(lambda: model.edits())
        assert record.id not in [left.id for left in model.objects()]
        wait_for(lambda: "removed" in browser.execute_script("return document.body.innerText"))
        assert errors(browser) == []
    finally:
        close_server(server)


def test_the_static_page_shows_splats_and_objects_from_disk(browser: Any, run: RunFolder, tmp_path: Path) -> None:
    model, size = write_page(run, tmp_path / "room.html", max_splats=MAX_SPLATS)
    assert size == (tmp_path / "room.html").stat().st_size < 2_000_000
    browser.get("about:blank")
    browser.get_log("browser")  # a page whose server has ended says so
    browser.get((tmp_path / "room.html").as_uri())
    wait_for(lambda: browser.execute_script("return !!window.ggslam && !!ggslam.renderer.sorted"))
    before = screenshot(browser)
    assert before[20:180, 20:600].std() > 8
    rows = browser.find_elements("css selector", "#objects li")
    assert len(rows) == len(model.objects()) + 1
    # What is clicked in space is what the CPU renderer shows there.
    place = browser.execute_script("const c = document.querySelector('canvas'); return [c.clientWidth, c.clientHeight]")
    pose = model.frame_poses[0]
    expected = model.object_at(pose[:3, 3], pose[:3, 2], model.camera.fx, set())
    script = "return ggslam.renderer.pick(ggslam.camera, arguments[0] / 2, arguments[1] / 2)"
    assert browser.execute_script(script, *place) == expected
    browser.execute_script("document.getElementById('none').click()")
    wait_for(lambda: screenshot(browser)[20:180, 20:600].mean() < before[20:180, 20:600].mean() / 2)
    loaded = browser.execute_script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert all(name.startswith(("data:", "blob:")) for name in loaded), loaded
    assert errors(browser) == []
