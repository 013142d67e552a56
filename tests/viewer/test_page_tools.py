# SPDX-License-Identifier: Apache-2.0
"""The page's tools beside editing: measuring, notes, films, links, search, the camera. Skips without chromium."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ggslam.jobs.render.key_path import read_camera_keys, view_at
from ggslam.jobs.render.shots import look_at_pose
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.annotations import CameraKeysRecord

from . import browser as b
from .page_hand import Hand

pytestmark = pytest.mark.browser


def test_distances_and_heights_are_measured(served: tuple[Hand, ViewedRun]) -> None:
    """On the surfaces that the recording's first depth image has where the page looks from its camera."""
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    T = next(iter(model.frame_poses.values()))
    eye, target = hand.eye()
    assert np.allclose(eye, T[:3, 3], atol=1e-3)  # the page begins with the first frame's view
    frame = next(iter(model.frame_poses))
    depth, camera = open_recording_of(model.folder).frame(frame).depth, model.camera
    places, points = list[np.ndarray](), list[np.ndarray]()
    for u, v in ((0.35, 0.6), (0.6, 0.7), (0.65, 0.35)):
        x, y = int(u * camera.width), int(v * camera.height)
        z = float(np.median(depth[y - 2 : y + 3, x - 2 : x + 3]))
        local = np.array([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z])
        points.append(T[:3, :3] @ local + T[:3, 3])
        places.append(hand.place_of(points[-1]))
    hand.keys("8")
    for place in places:
        hand.drag([place])
    hand.wait("document.querySelectorAll('#measured li').length === 4")
    measured = np.array(hand.ask("ggslam.tools.current.points"))
    assert np.abs(measured - points).max() < 0.08
    parts = np.linalg.norm(np.diff(measured, axis=0), axis=1)
    words = hand.text("measured")
    assert f"distance {parts.sum():.3f} m" in words or f"distance {100 * parts.sum():.1f} cm" in words
    assert f"1: {measured[0][0]:.3f}, {measured[0][1]:.3f}, {measured[0][2]:.3f} m" in words
    if model.floor is not None:
        height = measured[2] @ model.up - model.floor
        assert (f"{height:.3f} m above" if abs(height) >= 1 else f"{100 * height:.1f} cm above") in words
    hand.keys(Keys.BACKSPACE)
    hand.wait("document.querySelectorAll('#measured li').length === 3")
    hand.keys(Keys.ESCAPE)
    hand.wait("document.querySelectorAll('#measured li').length === 0")
    hand.keys(Keys.ENTER)  # in the middle of the view, without a pointer
    hand.wait("document.querySelectorAll('#measured li').length === 1")


def test_notes_are_kept_beside_the_run(served: tuple[Hand, ViewedRun]) -> None:
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    path = model.folder.path / "annotations.json"
    (_, place), *_ = hand.object_places().items()
    hit = hand.ask("ggslam.map.pick(...arguments[0])", place.tolist())
    hand.keys("9")
    hand.drag([place])
    hand.wait("document.activeElement.getAttribute('aria-label') === 'Text of the note'")
    text = "<img src=x onerror='window.taken=1'> a crack"
    hand.browser.switch_to.active_element.send_keys(text, Keys.ENTER)
    kept = b.wait_for(lambda: path.exists() and json.loads(path.read_text())["annotations"])
    assert kept[0]["text"] == text and np.allclose(kept[0]["point"], hit["point"], atol=1e-3)
    hand.wait(f"document.querySelector('#labels .pin')?.textContent === {json.dumps(text)}")
    assert not hand.ask("window.taken || document.querySelectorAll('#labels img, #notes img').length")
    hand.browser.refresh()
    hand.wait("window.ggslam && ggslam.loaded && document.querySelectorAll('#notes li').length === 1")
    hand.ask("(document.querySelector('#notes').closest('details').open = true)")
    search = hand.browser.find_element("css selector", "[aria-label='Search objects']")
    search.send_keys("crack")
    hand.wait("document.querySelectorAll('#notes li:not([hidden])').length === 1")
    search.send_keys("nowhere")
    hand.wait("document.querySelectorAll('#notes li:not([hidden])').length === 0")
    search.send_keys(Keys.CONTROL, "a")
    search.send_keys(Keys.BACKSPACE)
    remove = hand.browser.find_element("css selector", "[aria-label='Delete note']")
    hand.ask("arguments[0].scrollIntoView({ block: 'center' })", remove)
    remove.click()
    b.wait_for(lambda: json.loads(path.read_text())["annotations"] == [])


def test_a_film_is_made_of_keys(served: tuple[Hand, ViewedRun], tmp_path: Path) -> None:
    hand, model = served
    b.download_to(hand.browser, tmp_path / "files")
    eyes = list[np.ndarray]()
    for by in ((0, 0), (60, 20), (60, -30)):
        hand.drag([(400, 300), np.add((400, 300), by)])
        eyes.append(hand.eye())
        hand.keys("k")
    kept = model.folder.path / "camera_keys.json"
    b.wait_for(lambda: kept.exists() and len(json.loads(kept.read_text())["keys"]) == 3)
    time = hand.browser.find_element("css selector", "[aria-label='Time of key 3']")
    hand.ask("(arguments[0].closest('details').open = true)", time)
    hand.ask("ggslam.film.setTime(2, 3)")
    hand.press("film-save")
    keys = read_camera_keys(b.downloaded(tmp_path / "files", ".json"))
    assert [key.time for key in keys.keys] == [0, 2, 3] and keys.fps == 30
    assert np.allclose([key.position for key in keys.keys], [eye[0] for eye in eyes])
    hand.press("film-play")
    hand.wait("!ggslam.film.running")
    assert np.allclose(hand.eye(), eyes[-1], atol=1e-6)
    label = hand.browser.find_element("css selector", "[aria-label='Key 3 earlier']")
    hand.ask("arguments[0].scrollIntoView({ block: 'center' })", label)
    label.click()
    b.wait_for(lambda: np.allclose(json.loads(kept.read_text())["keys"][1]["position"], eyes[2][0]))


def test_the_preview_goes_the_way_of_the_film(served: tuple[Hand, ViewedRun]) -> None:
    hand, _ = served
    draw = np.random.default_rng(2)
    times = np.cumsum(draw.uniform(0.2, 2, 6))
    keys = [
        {"time": float(t), "position": draw.normal(size=3).tolist(), "look_at": (draw.normal(size=3) + 5).tolist(),
         "up": draw.normal(size=3).tolist(), "fov": float(draw.uniform(0.5, 1.5))} for t in times
    ]  # fmt: skip
    asked = np.linspace(times[0] - 0.5, times[-1] + 0.5, 60).tolist()
    code = """arguments[1].map((time) => { const at = cameraAt(arguments[0], time);
        return [at.position, at.look_at, at.up, at.fov]; })"""
    way = CameraKeysRecord.model_validate({"keys": keys})
    for time, (position, look_at, up, fov) in zip(asked, hand.ask(code, keys, asked), strict=True):
        T, camera = view_at(way, time, (1280, 720))
        assert np.allclose(look_at_pose(np.array(position), np.array(look_at), np.array(up)), T, atol=1e-9)
        assert 360 / np.tan(fov / 2) == pytest.approx(camera.fx)


def test_a_link_leads_to_the_view(served: tuple[Hand, ViewedRun]) -> None:
    hand, _ = served
    places = list(hand.object_places().items())
    hand.drag([places[0][1]])
    b.wait_for(lambda: hand.selected() == [places[0][0]])
    hand.keys("h")
    hand.drag([places[1][1]])
    b.wait_for(lambda: hand.selected() == [places[1][0]])
    hand.keys("c")
    hand.drag([(400, 300), (450, 320)])
    hand.keys("8")
    eye = hand.eye()
    hand.wait("location.hash.includes('m=measure') && location.hash.includes('c=objects')")
    link = hand.ask("location.hash")
    address = hand.browser.current_url.split("?")[0].split("#")[0]
    hand.open(f"{address}{link}")  # the cookie lets the page in
    assert np.allclose(hand.eye(), eye, atol=2e-4)
    assert hand.selected() == [places[1][0]] and hand.ask("[...ggslam.hidden]") == [places[0][0]]
    assert hand.ask("[ggslam.coloring, ggslam.tools.name]") == ["objects", "measure"]
    hand.open(f"{address}#p=1,nan,2&t=x&u=0,0,0&h=99999999-1&s=7000&f=-3&m=nothing")  # somebody's: ignored
    assert hand.ask("ggslam.tools.name") == "look" and np.isfinite(hand.eye()).all()


def test_objects_are_found_by_words(served: tuple[Hand, ViewedRun]) -> None:
    hand, model = served
    objects = model.objects()
    search = hand.browser.find_element("css selector", "[aria-label='Search objects']")

    def found(words: str) -> set[int]:
        from selenium.webdriver.common.keys import Keys

        search.send_keys(Keys.CONTROL, "a")
        search.send_keys(words)
        code = "[...document.querySelectorAll('#objects li:not([hidden])')].map((item) => Number(item.dataset.id))"
        return set(hand.ask(code))

    number = objects[3].id
    assert found(f"#{number}") == {number}
    name = (objects[3].name or "object").split()[0]
    assert found(name) == {o.id for o in objects if name in f"{o.id} {o.name or 'object'}"}
    assert found("no such thing") == set()
    red = found("red")
    gaussians = model.gaussians()
    owners = gaussians.object_id.numpy()
    for number in red - {o.id for o in objects if "red" in (o.name or "")}:
        mean = 0.5 + 0.2820948 * gaussians.sh.numpy()[owners == number, 0].mean(0)
        assert mean[0] == mean.max(), (number, mean)
    hand.press_words("Select found")
    assert set(hand.selected()) == red


def test_the_camera_obeys_mouse_keys_and_fingers(served: tuple[Hand, ViewedRun]) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    eye, target = hand.eye()
    reach = np.linalg.norm(target - eye)
    hand.drag([(400, 300), (460, 300)])  # turns about the target
    turned = hand.eye()
    assert np.allclose(turned[1], target) and np.linalg.norm(turned[0] - target) == pytest.approx(reach)
    assert abs((turned[0] - eye) @ model.up) < 1e-6 < np.linalg.norm(turned[0] - eye)
    hand.drag([(400, 300), (460, 330)], Keys.SHIFT)  # shifts
    shifted = hand.eye()
    assert np.allclose(shifted[0] - turned[0], shifted[1] - turned[1]) and not np.allclose(shifted, turned)
    ActionChains(hand.browser).scroll_from_origin(ScrollOrigin.from_element(hand.canvas), 0, -300).perform()
    near = hand.at_rest()
    assert np.linalg.norm(near[0] - near[1]) < 0.8 * reach and np.allclose(near[1], shifted[1])
    forward = (near[1] - near[0]) / np.linalg.norm(near[1] - near[0])
    hand.ask("document.getElementById('map').focus()")
    ActionChains(hand.browser).key_down("w").pause(0.3).key_up("w").perform()
    flown = hand.at_rest()
    way = (flown - near)[0]
    assert way @ forward > 0.05 and np.allclose((flown - near)[0], (flown - near)[1])
    assert np.linalg.norm(way - (way @ forward) * forward) < 1e-3
    hand.keys(Keys.ARROW_LEFT)  # turns on the spot
    assert np.allclose(hand.eye()[0], flown[0]) and not np.allclose(hand.eye()[1], flown[1])
    hand.press_words("Start")
    b.wait_for(lambda: np.allclose(hand.eye()[0], hand.ask("ggslam.scene.views.Start.position")))
    (_, place), *_ = hand.object_places().items()
    point = hand.ask("ggslam.map.pick(...arguments[0]).point", place.tolist())
    canvas = hand.canvas
    middle = np.array([canvas.rect["width"], canvas.rect["height"]]) / 2
    ActionChains(hand.browser).move_to_element_with_offset(
        canvas, *np.rint(place - middle).astype(int).tolist()
    ).double_click().perform()  # fmt: skip
    assert np.allclose(hand.at_rest()[1], point, atol=0.05)
    before = hand.at_rest()
    hand.touch([(400, 300)], [(430, 300)], [(460, 300)])  # one finger turns
    one = hand.eye()
    assert np.allclose(one[1], before[1]) and not np.allclose(one[0], before[0])
    hand.touch([(380, 300), (420, 300)], [(350, 300), (450, 300)], [(300, 300), (500, 300)])  # two come nearer
    pinched = hand.eye()
    assert np.linalg.norm(pinched[0] - pinched[1]) < 0.5 * np.linalg.norm(one[0] - one[1])
    hand.ask("ggslam.select([])")
    hand.keys("2")  # also while a tool is chosen, and nothing is selected
    hand.touch([(380, 300)], [(380, 300), (420, 300)], [(380, 300), (440, 300)])
    assert np.linalg.norm(hand.eye()[0] - hand.eye()[1]) < np.linalg.norm(pinched[0] - pinched[1])
    assert hand.ask("ggslam.steps.length") == 0
