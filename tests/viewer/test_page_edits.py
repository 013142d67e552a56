# SPDX-License-Identifier: Apache-2.0
"""A map edited by mouse and keyboard in chromium, judged by the run that is saved. Skips where it is not installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder
from ggslam.viewer.model import ListedObject

from . import browser as b
from .page_hand import Hand

pytestmark = pytest.mark.browser
_UNCOVERED = """(() => { const { x, y, width, height } = arguments[0].getBoundingClientRect();
    return document.elementFromPoint(x + width / 2, y + height / 2) === arguments[0]; })()"""


def record_of(model: ViewedRun, number: int) -> ListedObject:
    return next(record for record in model.objects() if record.id == number)


def edited(hand: Hand, model: ViewedRun, count: int) -> None:
    """Waits until both the page and the program have so many edits."""
    b.wait_for(lambda: len(model.edits()) == count)
    hand.wait(f"document.querySelectorAll('#edits li').length === {count} && ggslam.tools.name === 'look'")


def test_objects_are_picked_hidden_and_shown(served: tuple[Hand, ViewedRun]) -> None:
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    first, second, third = list(hand.object_places().items())[:3]
    hand.drag([first[1]])
    b.wait_for(lambda: hand.selected() == [first[0]])
    assert f"{record_of(model, first[0]).gaussians:,} Gaussians" in hand.text("chosen")
    hand.drag([second[1]], Keys.SHIFT)
    hand.drag([third[1]], Keys.SHIFT)
    b.wait_for(lambda: hand.selected() == sorted([first[0], second[0], third[0]]))
    hand.drag([first[1]], Keys.ALT)
    b.wait_for(lambda: hand.selected() == sorted([second[0], third[0]]))
    hand.keys("h")
    hand.wait("document.querySelectorAll('#objects li.hidden').length === 2")
    assert hand.ask("ggslam.map.pick(...arguments[0])?.id", second[1].tolist()) not in (second[0], third[0])
    hand.keys("u")
    hand.wait("document.querySelectorAll('#objects li.hidden').length === 0")
    item = hand.browser.find_element("css selector", f"#objects li[data-id='{first[0]}']")
    item.send_keys(Keys.ENTER)
    b.wait_for(lambda: hand.selected() == [first[0]])
    hand.press("only")
    hand.wait("document.querySelectorAll('#objects li:not(.hidden)').length === 1")
    hand.keys(Keys.ESCAPE)
    b.wait_for(lambda: hand.selected() == [])


def test_an_object_is_edited_and_saved(served: tuple[Hand, ViewedRun], tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    places = hand.object_places()
    size = np.array(hand.ask("[ggslam.canvas.clientWidth, ggslam.canvas.clientHeight]"))

    def amid(number: int) -> bool:  # its handles are on the map
        middle = hand.place_of(record_of(model, number).center)
        return bool(((middle > [150, 170]) & (middle < size - 120)).all())

    one, other = [number for number in places if amid(number)][:2]
    place, there = places[one], places[other]
    before = record_of(model, one)
    b.download_to(hand.browser, tmp_path / "files")
    hand.drag([place])
    b.wait_for(lambda: hand.selected() == [one])
    hand.write("name", "thing")
    hand.press("do-rename")
    edited(hand, model, 1)
    hand.wait(f"document.querySelector('#objects li[data-id=\"{one}\"]').textContent.includes('thing')")
    hand.press("do-export")
    assert len(read_gaussian_ply(b.downloaded(tmp_path / "files", ".ply"), with_moments=False)) == before.gaussians
    hand.ask("document.querySelector('input[type=color]').value = '#10c020'")
    hand.press("do-recolor")
    edited(hand, model, 2)
    # The arm that points up, dragged upward by 50 of its 90 pixels, then numbers: 0.25 m higher, turned by 30 degrees.
    hand.keys("7")
    up = 50 * hand.ask("ggslam.metresPerPixel(ggslam.tools.current.box.center)")
    hand.drag_handle(2, (0, -50))
    lifted = hand.ask("ggslam.tools.current.numbers()[2]")
    assert 0.5 * up < lifted < 2 * up  # the arm is seen from above
    for label, value in (("Move: up", "0.25"), ("Move: turn °", "30")):
        field = hand.browser.find_element("css selector", f"[aria-label='{label}']")
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys(value, Keys.ENTER)
    hand.press("do-move")
    edited(hand, model, 3)
    moved = record_of(model, one).centroid - before.centroid
    assert moved @ model.up == pytest.approx(0.25, abs=0.02)
    hand.drag([there])
    b.wait_for(lambda: hand.selected() == [other])
    hand.keys(Keys.DELETE)
    edited(hand, model, 4)
    hand.wait(f"!document.querySelector('#objects li[data-id=\"{other}\"]')")
    hand.keys(Keys.CONTROL, "z")
    hand.wait(f"!!document.querySelector('#objects li[data-id=\"{other}\"]')")
    assert len(model.edits()) == 3
    hand.keys(Keys.CONTROL, Keys.SHIFT, "z")
    hand.wait(f"!document.querySelector('#objects li[data-id=\"{other}\"]')")
    assert hand.ask("document.querySelectorAll('#edits li').length") == 4
    hand.write("target", "saved-by-hand")
    hand.press("do-save")
    b.wait_for(lambda: "saved to" in hand.text("said"))
    saved = RunFolder.open(model.save_folder() / "saved-by-hand")
    table = saved.object_table()
    assert table.record(one).name == "thing" and other not in [record.id for record in table.objects]
    assert len(saved.gaussians()) < len(model.folder.gaussians())


def test_two_pages_keep_what_both_add(served: tuple[Hand, ViewedRun]) -> None:
    """Keys of the film and notes; whoever is writing goes on."""
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    browser, first = hand.browser, hand.browser.current_window_handle
    address = hand.ask("location.href")
    browser.switch_to.new_window("tab")
    hand.open(address)
    hand.keys("k")
    hand.wait("ggslam.film.keys.length === 1 && !ggslam.keeping")
    browser.switch_to.window(first)
    hand.wait("ggslam.film.keys.length === 1")
    hand.keys("k")
    hand.wait("ggslam.film.keys.length === 2 && !ggslam.keeping")
    browser.switch_to.window(browser.window_handles[-1])
    hand.wait("ggslam.film.keys.length === 2")
    _, place = next(iter(hand.object_places().items()))
    hand.keys("9")
    hand.drag([place])
    b.wait_for(lambda: hand.ask("document.activeElement.getAttribute('aria-label')") == "Text of the note")
    browser.switch_to.active_element.send_keys("half")
    rename = "ggslam.source.post('edit', { kind: 'rename', object: arguments[0], name: 'other' })"  # by somebody else
    hand.ask(rename, model.objects()[0].id)
    hand.wait("ggslam.scene.edits.length === 1")
    browser.switch_to.active_element.send_keys(" a note", Keys.ENTER)
    hand.wait("!ggslam.keeping && document.querySelector('#notes .label')?.textContent === 'half a note'")
    browser.close()
    browser.switch_to.window(first)
    hand.wait("document.querySelector('#notes .label')?.textContent === 'half a note'")


def test_splats_become_an_object_and_a_room_is_cropped(served: tuple[Hand, ViewedRun]) -> None:
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    whole = len(model.gaussians())
    hand.press_words("splats")
    (one, place), *_ = hand.object_places().items()
    hand.keys("5")
    hand.drag([place, place + [30, 0]])
    count = int(hand.wait("ggslam.steps.length && ggslam.chosen.size && ggslam.total"))
    b.wait_for(lambda: hand.text("chosen").startswith(f"{hand.ask('ggslam.total'):,} Gaussians"))
    hand.keys("1")
    hand.write("name", "piece")
    hand.press("do-assign")
    edited(hand, model, 1)
    piece = next(record for record in model.objects() if record.name == "piece")
    assert piece.gaussians >= count > 0  # the page shows some of them
    # A box round the middle of the map, one face of it dragged inward.
    hand.keys("6")
    box = hand.ask("ggslam.tools.current.shape()")
    hand.wait("document.querySelector('#overlay .handle[cx]')")
    handles = hand.browser.find_elements("css selector", "#overlay .handle")
    seen = [k for k, handle in enumerate(handles) if handle.is_displayed()]
    face = next(k for k in seen if hand.ask(_UNCOVERED, handles[k]))
    hand.drag_handle(face, (25, 25))
    dragged = hand.ask("ggslam.tools.current.shape()")
    changed = [k for k in range(3) if abs(dragged["size"][k] - box["size"][k]) > 1e-6]
    assert changed == [face // 2]
    sizes = hand.browser.find_elements("css selector", "#cropping input[aria-label^='Crop: size']")
    for field in sizes:
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys("1.5", Keys.ENTER)
    shape = hand.ask("ggslam.tools.current.shape()")
    assert shape["size"] == [1.5, 1.5, 1.5]
    means = model.gaussians().means.numpy().astype(np.float64)
    inside = (np.abs((means - shape["center"]) @ np.array(shape["axes"]).T) <= 0.75).all(1)
    hand.press("do-crop")
    edited(hand, model, 2)
    assert 0 < len(model.gaussians()) == inside.sum() < whole
    assert hand.ask("ggslam.tools.name") == "look"
