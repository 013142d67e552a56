# SPDX-License-Identifier: Apache-2.0
"""A browser as a person uses it: finds things by what is written on them, clicks, types, drags."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ggslam.scene.poses import quaternion_to_matrix

PATIENCE_S = 20.0
LIBRARY_NOISE = "computeBoundingSphere(): Computed radius is NaN"
"""three.js says so of the mesh that viser draws all splats with, whose corners have two coordinates instead of three;
a page of nothing but one splat says the same. It only keeps the mesh from being left out when it is out of sight."""


def open_browser(width: int, height: int, *more: str) -> Any:
    """Chromium without a screen that draws in software, started with some `more` arguments; skips the test where it is
    not installed."""
    selenium = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("chromium and chromedriver are not installed")
    options = selenium.ChromeOptions()
    options.binary_location = program
    for argument in (
        "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        f"--window-size={width},{height}", "--disable-dev-shm-usage",
        *more,
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return selenium.Chrome(options=options, service=selenium.ChromeService(driver))


def wait_for(condition: Callable[[], Any]) -> Any:
    """What `condition` gives once it is true."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.2)
    return found


def screenshot(browser: Any) -> np.ndarray:
    """uint8 [H, W, 3]. Software drawing may keep the browser from answering for a while."""
    from selenium.common.exceptions import TimeoutException

    for _ in range(8):
        try:
            picture = cv2.imdecode(np.frombuffer(browser.get_screenshot_as_png(), np.uint8), cv2.IMREAD_COLOR)
        except TimeoutException:
            continue
        assert picture is not None
        return picture
    raise AssertionError("the browser draws nothing")


def errors(browser: Any) -> list[str]:
    """What the console complained about."""
    found = [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    return [message for message in found if LIBRARY_NOISE not in message]


def said(browser: Any) -> str:
    """All text of the page."""
    return str(browser.execute_script("return document.body.innerText"))


def values(browser: Any) -> list[str]:
    """What the inputs hold."""
    return list(browser.execute_script("return [...document.querySelectorAll('input')].map((input) => input.value)"))


def press(browser: Any, selector: str, text: str) -> None:
    """Clicks the first visible element of some text, or input of some value."""
    wait_for(lambda: any(_click(found, text) for found in browser.find_elements("css selector", selector)))


def _click(element: Any, text: str) -> bool:
    from selenium.common.exceptions import WebDriverException

    try:
        if text not in (element.text.strip(), element.get_attribute("value")):
            return False
        element.click()
    except WebDriverException:  # covered, moving, or gone by now
        return False
    return True


def check(browser: Any, label: str) -> None:
    """Clicks the box beside a label."""
    boxes = """return [...document.querySelectorAll("label")]
        .filter((found) => found.innerText.trim() === arguments[0]).map((found) => found.control)"""
    wait_for(lambda: any(found and _click(found, "on") for found in browser.execute_script(boxes, label)))


def write_over(browser: Any, old: str, new: str) -> None:
    """Types something in place of what an input holds."""
    from selenium.webdriver.common.keys import Keys

    press(browser, "input", old)
    field = browser.switch_to.active_element
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(new)


def pixel_of(browser: Any, camera: Any, point: np.ndarray) -> np.ndarray:
    """Where a viser camera shows a point [3], in pixels from the upper left corner of space."""
    size = _space(browser).rect
    ray = quaternion_to_matrix(np.array(camera.wxyz)).T @ (np.asarray(point) - np.array(camera.position))
    focal = size["height"] / 2 / np.tan(camera.fov / 2)
    return np.array([size["width"], size["height"]]) / 2 + focal * ray[:2] / ray[2]


def drag(browser: Any, start: np.ndarray, by: np.ndarray, steps: int = 6) -> None:
    """Presses the mouse at a pixel of space, moves it and lets go; with no movement a click."""
    from selenium.webdriver.common.action_chains import ActionChains

    space = _space(browser)
    x, y = np.rint(start - np.array([space.rect["width"], space.rect["height"]]) / 2).astype(int).tolist()
    hand = ActionChains(browser).move_to_element_with_offset(space, x, y).click_and_hold()
    if np.any(by):
        corners = np.rint(np.linspace(0, 1, steps + 1)[:, None] * by).astype(int)
        for move in np.diff(corners, axis=0).tolist():
            hand = hand.move_by_offset(*move)
    hand.release().perform()


def _space(browser: Any) -> Any:
    return max(browser.find_elements("css selector", "canvas"), key=lambda found: found.rect["width"])


def download_to(browser: Any, folder: Path) -> None:
    """Files that the page hands out go there."""
    folder.mkdir(parents=True, exist_ok=True)
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)})


def downloaded(folder: Path, ending: str) -> Path:
    """The file that arrives."""
    return Path(wait_for(lambda: next(iter(folder.glob(f"*{ending}")), None)))
