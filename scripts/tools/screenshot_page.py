# SPDX-License-Identifier: Apache-2.0
"""A screenshot of the page that `ggslam view --html` writes, once its map is drawn; needs chromium and selenium.

python scripts/tools/screenshot_page.py map.html picture.png
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from selenium import webdriver

SIZE = (1280, 800)
PATIENCE_S = 120.0
SETTLING_S = 8.0
"""For the sharp picture after the first one."""
LOADED = "const e = document.getElementById('loading'); return !e || e.hidden || getComputedStyle(e).display === 'none'"


def main(page: str, out: str) -> None:
    """Opens a page, waits until it shows the map, and writes what is seen."""
    options = webdriver.ChromeOptions()
    for argument in ("--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={SIZE[0]},{SIZE[1]}"):
        options.add_argument(argument)
    browser = webdriver.Chrome(options=options)
    try:
        view = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", view)
        browser.get(Path(page).resolve().as_uri())
        end = time.monotonic() + PATIENCE_S
        while not browser.execute_script(LOADED):
            if time.monotonic() > end:
                raise SystemExit(f"{page}: shows no map after {PATIENCE_S:g} s")
            time.sleep(0.5)
        time.sleep(SETTLING_S)
        browser.save_screenshot(out)
    finally:
        browser.quit()
    print(f"wrote {out}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 3 else sys.exit(__doc__)
