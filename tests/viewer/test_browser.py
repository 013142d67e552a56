# SPDX-License-Identifier: Apache-2.0
"""The pages in a real browser: chromium without a screen, drawing in software. Skips where it is not installed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.jobs.view.serve import serve_run, show_run, write_page
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.folder import RunFolder
from ggslam.viewer.model import ListedObject
from ggslam.viewer.server import address, close_server

from . import browser as b

pytestmark = pytest.mark.browser
MAX_SPLATS = 4000
"""Drawn in software, a frame of more would take seconds."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    page = b.open_browser(900, 600)
    yield page
    page.quit()


@pytest.fixture
def page(browser: Any, run: RunFolder) -> Iterator[tuple[Any, ViewedRun]]:
    """Server and model of a page that is open and shows splats."""
    server, model = serve_run(run, port=0, max_splats=MAX_SPLATS)
    try:
        browser.get(address(server) + "&fixedDpr=0.4")
        b.wait_for(lambda: "Gaussians" in b.said(browser) and server.get_clients())
        # The part of the window that shows space: what is drawn there has many colours.
        b.wait_for(lambda: b.screenshot(browser)[240:460, 40:460].std() > 8)
        b.press(browser, "button[class*=Notification]", "")  # software drawing, says viser, where something is clicked
        yield server, model
        assert b.errors(browser) == []
    finally:
        close_server(server)
        browser.get("about:blank")
        browser.get_log("browser")  # a page whose server has ended says so


def text_of(browser: Any) -> str:
    """All text of the page, whether it is drawn by now or not."""
    return str(browser.execute_script("return document.body.textContent"))


def camera_of(server: Any) -> Any:
    """Of the page."""
    return next(iter(server.get_clients().values())).camera


def something_to_click(browser: Any, camera: Any, model: ViewedRun) -> tuple[ListedObject, np.ndarray]:
    """An object, and the pixel where its middle is seen."""
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    position = np.array(camera.position)
    for record in sorted(model.objects(), key=lambda found: -found.gaussians):
        pixel = b.pixel_of(browser, camera, record.centroid)
        seen = model.object_at(position, record.centroid - position, focal, set())
        if seen == record.id and 150 < pixel[1] < 450 and 100 < pixel[0] < 420 and record.size.max() < 1.5:
            return record, pixel
    raise AssertionError("no object can be clicked")


def test_an_object_is_edited_with_the_mouse(browser: Any, page: tuple[Any, ViewedRun], tmp_path: Path) -> None:
    server, model = page
    b.download_to(browser, tmp_path / "files")
    camera = camera_of(server)
    record, pixel = something_to_click(browser, camera, model)
    b.press(browser, "[role=tab]", "Objects")
    b.drag(browser, pixel, np.zeros(2))
    b.wait_for(lambda: record.label in b.values(browser))
    group = server.scene.get_handle_by_name(f"/map/{record.id}")
    b.press(browser, "button", "Hide")
    b.wait_for(lambda: not group.visible)
    b.press(browser, "button", "All")
    b.wait_for(lambda: group.visible)
    b.write_over(browser, record.name or "", "thing")
    b.press(browser, "button", "Rename")
    b.wait_for(lambda: len(model.edits()) == 1)
    b.press(browser, "button", "Export")
    found = read_gaussian_ply(b.downloaded(tmp_path / "files", ".ply"), with_moments=False)
    assert len(found) == record.gaussians and "thing" in b.said(browser)
    # The arrow of the gizmo that points up, dragged upward.
    b.check(browser, "Move with gizmo")
    gizmo = b.wait_for(lambda: server.scene.get_handle_by_name("/selected/gizmo"))
    b.wait_for(lambda: "Keep" in b.said(browser))
    up = b.pixel_of(browser, camera, record.centroid + 0.05 * model.up) - pixel
    up /= np.linalg.norm(up)

    def dragged() -> bool:  # the gizmo comes with the next picture that is drawn
        b.drag(browser, pixel + 75 * up, 40 * up)
        return not np.allclose(gizmo.position, record.centroid, atol=1e-4)

    b.wait_for(dragged)
    b.press(browser, "button", "Keep")
    b.wait_for(lambda: len(model.edits()) == 2)
    moved = next(left for left in model.objects() if left.id == record.id).centroid - record.centroid
    assert moved @ model.up > 0.02 and np.linalg.norm(moved - (moved @ model.up) * model.up) < 0.02
    b.press(browser, "button", "Delete")
    b.wait_for(lambda: len(model.edits()) == 3)
    assert record.id not in [left.id for left in model.objects()]
    b.press(browser, "button", "Undo")
    b.wait_for(lambda: len(model.edits()) == 2)
    b.write_over(browser, model.default_target(), "saved-by-mouse")
    b.press(browser, "button", "Save edited run")
    b.wait_for(lambda: "saved to" in b.said(browser))
    assert RunFolder.open(model.save_folder() / "saved-by-mouse").object_table().record(record.id).name == "thing"


@pytest.mark.long("a browser plays a whole recording")
def test_the_recording_is_gone_through(browser: Any, page: tuple[Any, ViewedRun], tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    server, model = page
    b.download_to(browser, tmp_path)
    camera = camera_of(server)
    first = np.array(camera.position)
    b.press(browser, "[role=tab]", "Time")
    b.check(browser, "Camera follows")
    slider = b.wait_for(lambda: [s for s in browser.find_elements("css selector", "[role=slider]") if s.is_displayed()])
    slider[0].send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    b.wait_for(lambda: "Frame 3" in b.said(browser))
    b.wait_for(lambda: np.allclose(camera.position, model.frame_poses[3][:3, 3], atol=1e-3))
    assert not np.allclose(camera.position, first, atol=1e-3)
    b.check(browser, "Play")
    b.wait_for(lambda: "Frame 1" in b.said(browser))  # after the last frame comes the first
    b.check(browser, "Play")
    b.check(browser, "Camera follows")
    b.press(browser, "[role=tab]", "View")
    b.press(browser, "button", "Top")
    b.wait_for(lambda: (np.array(camera.position) - first) @ model.up > 1)
    before = b.screenshot(browser)
    b.press(browser, "input", "colour")
    b.press(browser, "[role=option]", "objects")
    b.wait_for(lambda: np.abs(b.screenshot(browser)[:, :500].astype(float) - before[:, :500]).mean() > 1)
    b.press(browser, "button", "Save picture")
    picture = cv2.imread(str(b.downloaded(tmp_path, ".png")))
    assert picture is not None and max(picture.shape) == 1920 and picture.std() > 5


def test_the_static_page_shows_splats_and_objects_from_disk(browser: Any, run: RunFolder, tmp_path: Path) -> None:
    model, size = write_page(run, tmp_path / "room.html", max_splats=MAX_SPLATS)
    assert size == (tmp_path / "room.html").stat().st_size < 2_000_000
    browser.get((tmp_path / "room.html").as_uri())
    b.wait_for(lambda: browser.execute_script("return !!window.ggslam && !!ggslam.drawn"))
    before = b.screenshot(browser)
    assert before[20:400, 20:540].std() > 8
    rows = browser.find_elements("css selector", "#objects li")
    assert len(rows) == len(model.objects()) + 1
    # What is clicked in space is what the CPU renderer shows there.
    pose = model.frame_poses[0]
    expected = model.object_at(pose[:3, 3], pose[:3, 2], model.camera.fx, set())
    size_of = "const c = document.querySelector('canvas'); return [c.clientWidth, c.clientHeight]"
    b.drag(browser, np.array(browser.execute_script(size_of)) / 2, np.zeros(2))
    chosen = b.wait_for(lambda: browser.execute_script("return document.querySelector('li.selected')?.dataset.id"))
    assert int(chosen) == expected
    b.press(browser, "button", "None")
    b.wait_for(lambda: b.screenshot(browser)[20:400, 20:540].mean() < before[20:400, 20:540].mean() / 2)
    loaded = browser.execute_script("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert all(name.startswith(("data:", "blob:")) for name in loaded), loaded
    assert b.errors(browser) == []


def test_names_of_objects_are_no_markup_on_the_page(browser: Any, run: RunFolder, tmp_path: Path) -> None:
    named = RunFolder(Path(shutil.copytree(run.path, tmp_path / "r<i>x")))
    table = named.object_table()
    name = "<iframe srcdoc='<script>parent.taken=1</script>'></iframe>![a](http://127.0.0.1:9/leak)"
    replace(table, objects=[replace(table.objects[0], name=name), *table.objects[1:]]).save(named.path / "objects.json")
    server, model = serve_run(named, port=0, max_splats=1000)
    try:
        model.move(table.objects[0].id, np.eye(4))
        show_run(server, model)
        browser.get(address(server) + "&fixedDpr=0.4")
        b.wait_for(lambda: "r<i>x" in b.said(browser))
        b.press(browser, "[role=tab]", "Objects")
        b.wait_for(lambda: f"moved {name}" in text_of(browser))
        assert not browser.execute_script("return window.taken || document.querySelectorAll('iframe').length")
        assert b.errors(browser) == []
    finally:
        close_server(server)
        browser.get("about:blank")
        browser.get_log("browser")


def test_the_static_page_of_a_run_without_objects_opens(browser: Any, run: RunFolder, tmp_path: Path) -> None:
    plain = RunFolder(Path(shutil.copytree(run.path, tmp_path / "plain")))
    (plain.path / "objects.json").unlink()
    write_page(plain, tmp_path / "plain.html", max_splats=1000)
    browser.get((tmp_path / "plain.html").as_uri())
    b.wait_for(lambda: browser.execute_script("return !!window.ggslam && !!ggslam.drawn"))
    assert not browser.find_element("id", "choose").is_displayed()
    assert b.errors(browser) == []
