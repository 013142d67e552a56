# SPDX-License-Identifier: Apache-2.0
"""The viewer's page under a person's hand: mouse, keys and fingers, and what the page says of itself."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from . import browser as b


class Hand:
    """Works on a page that is open in a browser.

    Args:
        browser: of `browser.open_browser`.
    """

    def __init__(self, browser: Any) -> None:
        self.browser = browser

    def open(self, address: str, renderer: str = "processor") -> None:
        """Opens a page and waits for its map."""
        self.browser.get("about:blank")  # an address that differs after # only would not load the page again
        place, _, view = address.partition("#")
        self.browser.get(f"{place}{'&' if '?' in place else '?'}renderer={renderer}{'#' + view if view else ''}")
        self.wait("window.ggslam && ggslam.drawn && ggslam.loaded")

    def ask(self, code: str, *values: Any) -> Any:
        """What an expression gives; `values` are its `arguments`."""
        return self.browser.execute_script(f"return {code}", *values)

    def wait(self, code: str) -> Any:
        """What an expression gives once it is true."""
        return b.wait_for(lambda: self.ask(code))

    # --- mouse, keys, fingers

    @property
    def canvas(self) -> Any:
        """The map."""
        return self.browser.find_element("id", "map")

    def drag(self, points: list[Any], *modifiers: str) -> None:
        """Presses the mouse at the first of some places of the map, CSS pixels from its corner, moves it through the
        others and lets go; with one place a click. Modifiers (of selenium's `Keys`) are held down."""
        from selenium.webdriver.common.action_chains import ActionChains

        hand, canvas = ActionChains(self.browser, duration=20), self.canvas
        middle = np.array([canvas.rect["width"], canvas.rect["height"]]) / 2
        for key in modifiers:
            hand.key_down(key)
        places = [np.rint(np.asarray(point) - middle).astype(int).tolist() for point in points]
        hand.move_to_element_with_offset(canvas, *places[0]).click_and_hold()
        for place in places[1:]:
            hand.move_to_element_with_offset(canvas, *place)
        hand.release()
        for key in modifiers:
            hand.key_up(key)
        hand.perform()

    def drag_handle(self, number: int, by: tuple[int, int]) -> None:
        """Drags one of the handles that lie over the map, in the order in which they were made."""
        from selenium.webdriver.common.action_chains import ActionChains

        handle = self.browser.find_elements("css selector", "#overlay .handle")[number]
        b.wait_for(lambda: handle.get_attribute("cx"))  # it is placed with the next picture
        ActionChains(self.browser, duration=20).drag_and_drop_by_offset(handle, *by).perform()

    def keys(self, *keys: str) -> None:
        """Presses keys while the map has the focus, together: the first ones stay down until the last."""
        from selenium.webdriver.common.action_chains import ActionChains

        self.ask("document.getElementById('map').focus()")
        hand = ActionChains(self.browser, duration=20)
        for key in keys[:-1]:
            hand.key_down(key)
        hand.send_keys(keys[-1])
        for key in keys[:-1]:
            hand.key_up(key)
        hand.perform()

    def press(self, name: str) -> None:
        """Presses the button of an id, as people do: it is there, in sight and not covered."""
        found = self.browser.find_element("id", name)
        self.ask("arguments[0].closest('details') && (arguments[0].closest('details').open = true)", found)
        self.ask("arguments[0].scrollIntoView({ block: 'center' })", found)
        b.wait_for(found.is_enabled)
        found.click()

    def press_words(self, words: str) -> None:
        """Presses the first button in sight that has some words on it."""
        code = "[...document.querySelectorAll('button')].find((one) => one.textContent === arguments[0])"
        found = self.ask(code, words)
        self.ask("arguments[0].closest('details') && (arguments[0].closest('details').open = true)", found)
        self.ask("arguments[0].scrollIntoView({ block: 'center' })", found)
        found.click()

    def write(self, name: str, text: str) -> None:
        """Types into the field of an id, over what it holds."""
        from selenium.webdriver.common.keys import Keys

        self.press(name)
        self.browser.switch_to.active_element.send_keys(Keys.CONTROL, "a")
        self.browser.switch_to.active_element.send_keys(text)

    def touch(self, *moments: list[tuple[float, float]]) -> None:
        """Fingers on the map: where each of them is at each moment, in CSS pixels; the last moment they are lifted."""
        kinds = ["touchStart", *["touchMove"] * (len(moments) - 1)]
        for kind, fingers in zip(kinds, moments, strict=True):
            points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(fingers)]
            self.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        self.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    # --- what the page shows

    def text(self, name: str) -> str:
        """Of the element of an id, whether it is in sight or not."""
        return str(self.ask("document.getElementById(arguments[0]).textContent", name))

    def selected(self) -> list[int]:
        """Ids of the objects that the list shows as selected."""
        code = "[...document.querySelectorAll('#objects li.selected')].map((item) => Number(item.dataset.id))"
        return list(self.ask(code))

    def eye(self) -> np.ndarray:
        """Where the camera is and what it looks at, float [2, 3], metres."""
        return np.array(self.ask("[ggslam.camera.position, ggslam.camera.target]"), float)

    def at_rest(self) -> np.ndarray:
        """`eye`, once the camera has come to rest."""
        last = self.eye()

        def still() -> bool:
            nonlocal last
            time.sleep(0.15)
            before, last = last, self.eye()
            return bool(np.abs(last - before).max() < 1e-9)

        b.wait_for(still)
        return last

    def place_of(self, point: Any) -> np.ndarray:
        """Where a point [3] is on the map, in CSS pixels."""
        return np.array(self.ask("ggslam.camera.project(arguments[0])", list(map(float, point)))[:2])

    def object_places(self) -> dict[int, np.ndarray]:
        """Places of the map where objects are seen, by id: amid the places of a grid that show them."""
        code = """(() => { const found = [], { clientWidth: w, clientHeight: h } = ggslam.canvas;
            for (let x = 80; x < w - 20; x += 14) for (let y = 20; y < h - 20; y += 14) {
              const hit = ggslam.map.pick(x, y); if (hit && hit.id) found.push([hit.id, x, y]); }
            return found; })()"""
        places: dict[int, list[Any]] = {}
        for number, x, y in self.ask(code):
            places.setdefault(number, []).append((x, y))
        return {
            number: min(map(np.array, found), key=lambda place: np.abs(place - np.median(found, axis=0)).sum())
            for number, found in sorted(places.items(), key=lambda item: -len(item[1]))
        }
