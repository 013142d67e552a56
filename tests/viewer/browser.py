# SPDX-License-Identifier: Apache-2.0
"""Chromium without a screen: opening it, waiting, what it shows and complains about."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

PATIENCE_S = 60.0


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
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def messages(browser: Any) -> list[str]:
    """All that is in the console."""
    return [entry["message"] for entry in browser.get_log("browser")]


def said(browser: Any) -> str:
    """All text of the page."""
    return str(browser.execute_script("return document.body.innerText"))


def download_to(browser: Any, folder: Path) -> None:
    """Files that the page hands out go there."""
    folder.mkdir(parents=True, exist_ok=True)
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)})


def downloaded(folder: Path, ending: str) -> Path:
    """The file that arrives."""
    return Path(wait_for(lambda: next(iter(folder.glob(f"*{ending}")), None)))
