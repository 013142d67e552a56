# SPDX-License-Identifier: Apache-2.0
"""Both renderers of the page against the CPU rasterizer, in chromium. Skips where it is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.labels import vote_label_image
from ggslam.rendering.types import LOW_PASS, GaussianTensors, RenderBuffers, low_pass_at
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.viewer.viewed_sides import viewed_sides

from . import browser as b
from . import map_page as m

pytestmark = pytest.mark.browser
SIZE, FOCAL = (320, 240), 270.0
CAMERA = Camera(*SIZE, FOCAL, FOCAL, SIZE[0] / 2 - 0.5, SIZE[1] / 2 - 0.5)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    page = b.open_browser(700, 600)
    page.set_script_timeout(b.PATIENCE_S)
    yield page
    page.quit()


@pytest.fixture(scope="module")
def gaussians(run: RunFolder) -> GaussianMap:
    return run.segmented_map().gaussians


@pytest.fixture(scope="module")
def poses(run: RunFolder) -> list[np.ndarray]:
    """From two frames, and from aside, where no frame looked from."""
    found = list(run.keyframes().poses().values())
    aside = found[0].copy()
    aside[:3, 3] += 0.3 * aside[:3, 0] - 0.2 * aside[:3, 2]
    return [found[0], found[-1], aside]


@pytest.fixture(scope="module")
def page(gaussians: GaussianMap, poses: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In two chunks."""
    owners, rows = gaussians.object_id.numpy().astype(np.uint16), np.arange(len(gaussians))
    halves = {"even": rows[::2], "odd": rows[1::2]}
    chunks = {name: (gaussians, part, owners[part]) for name, part in halves.items()}
    path = tmp_path_factory.mktemp("map") / "map.html"
    return m.write_map_page(path, chunks, SIZE, FOCAL, poses[0])


def expected(
    gaussians: GaussianMap, pose: np.ndarray, rows: np.ndarray | None = None, low_pass: float = LOW_PASS
) -> RenderBuffers:
    """By our renderer, with the part of the colours that is the same from all sides."""
    g, index = gaussians, slice(None) if rows is None else rows
    part = GaussianTensors(
        g.means[index], g.quaternions[index], g.log_scales[index], g.opacity_logits[index],
        g.sh[index, :1].contiguous(), g.features[index],
    )  # fmt: skip
    return CpuRasterizer(low_pass=low_pass).forward(part, CAMERA, inverse(pose), features=False)


def decibels(picture: np.ndarray, buffers: RenderBuffers) -> float:
    wanted = np.clip(buffers.image.numpy().transpose(1, 2, 0), 0, 1)
    return float(-10 * np.log10(np.mean((picture / 255.0 - wanted) ** 2)))


@pytest.mark.parametrize("renderer", ["processor", "webgl"])
def test_the_page_draws_what_the_rasterizer_draws(
    browser: Any, page: Path, gaussians: GaussianMap, poses: list[np.ndarray], renderer: str
) -> None:
    m.open_map(browser, page, renderer)
    for pose in poses:
        m.look_from(browser, pose)
        found = decibels(m.picture(browser), expected(gaussians, pose))
        assert found > 45
    # Without one object, which is most of what is seen from there otherwise.
    owner = gaussians.object_id.numpy()
    gone = int(np.argmax(np.bincount(owner)[1:])) + 1
    m.ask(browser, "map.setObject(values[0], { visible: false })", gone)
    rest = m.picture(browser)
    assert decibels(rest, expected(gaussians, poses[-1], np.flatnonzero(owner != gone))) > 45
    assert decibels(rest, expected(gaussians, poses[-1])) < 30
    assert b.errors(browser) == []


@pytest.mark.parametrize("renderer", ["processor", "webgl"])
@pytest.mark.parametrize("zoom", [0.5, 2.0])
def test_pictures_of_other_sizes_than_the_training_s_have_their_filter(
    browser: Any, page: Path, gaussians: GaussianMap, poses: list[np.ndarray], zoom: float, renderer: str
) -> None:
    m.open_map(browser, page, renderer)
    m.ask(browser, "map.trained = values[0]; map.redraw()", [FOCAL / zoom, 5 * FOCAL / zoom])
    m.look_from(browser, poses[0])
    picture = m.picture(browser)
    assert decibels(picture, expected(gaussians, poses[0], low_pass=low_pass_at(zoom))) > 45
    assert decibels(picture, expected(gaussians, poses[0])) < 40


def test_what_is_picked_is_there(
    browser: Any, page: Path, run: RunFolder, gaussians: GaussianMap, poses: list[np.ndarray]
) -> None:
    """Points against the recorded depth, ids against the CPU renderer's."""
    m.open_map(browser, page, "processor")
    frame = next(iter(run.keyframes().poses()))
    recorded, camera = open_recording_of(run).frame(frame).depth, run.sequence().camera_of(frame)
    places = [[x, y] for x in range(15, SIZE[0], 30) for y in range(15, SIZE[1], 30)]
    found = m.ask(browser, "return values[0].map(([x, y]) => map.pick(x, y))", places)
    rasterizer = CpuRasterizer()
    view = rasterizer.forward(gaussians, CAMERA, inverse(poses[0]), features=False)
    labels = vote_label_image(rasterizer, view, gaussians.object_id.numpy().astype(np.uint16))
    errors, same, rows = [], [], {"even": 0, "odd": 1}
    for (x, y), hit in zip(places, found, strict=True):
        if hit is None:
            continue
        same.append(hit["id"] == labels[y, x])
        assert gaussians.object_id[2 * hit["row"] + rows[hit["chunk"]]] == hit["id"]
        ray = np.array([(x - SIZE[0] / 2) / FOCAL, (y - SIZE[1] / 2) / FOCAL, 1.0])
        assert np.allclose(poses[0][:3, :3] @ (hit["depth"] * ray) + poses[0][:3, 3], hit["point"], atol=1e-4)
        column, row = round(camera.fx * ray[0] + camera.cx), round(camera.fy * ray[1] + camera.cy)
        if 0 <= column < camera.width and 0 <= row < camera.height and recorded[row, column] > 0:
            errors.append(abs(hit["depth"] - recorded[row, column]))
    assert len(errors) > 60 and np.median(errors) < 0.02
    assert np.mean(same) > 0.95
    hide = "const { id } = map.pick(160, 120); map.setObject(id, { visible: false }); return [id, map.pick(160, 120)]"
    hidden, behind = m.ask(browser, hide)
    assert hidden > 0 and (behind is None or behind["id"] != hidden)


def test_depth_images_are_those_of_the_rasterizer(
    browser: Any, page: Path, gaussians: GaussianMap, poses: list[np.ndarray]
) -> None:
    view = expected(gaussians, poses[0])
    wanted = np.where(view.alpha.numpy() > 0.5, view.expected_depth.numpy(), 0)
    for renderer in ("processor", "webgl"):
        m.open_map(browser, page, renderer)
        found = m.depth_image(browser, *SIZE)
        both = (found > 0) & (wanted > 0)
        assert np.mean((found > 0) == (wanted > 0)) > 0.999 and both.mean() > 0.9
        assert np.quantile(np.abs(found - wanted)[both], 0.999) < 0.01


@pytest.mark.parametrize("renderer", ["processor", "webgl"])
def test_chunks_marks_and_moves_change_what_is_drawn(
    browser: Any, page: Path, gaussians: GaussianMap, poses: list[np.ndarray], renderer: str
) -> None:
    m.open_map(browser, page, renderer)
    count, pose = len(gaussians), poses[0]
    left = gaussians.means.numpy()[:, 0] < np.median(gaussians.means.numpy()[:, 0])
    marks = "const marks = { even: 0, odd: 1 }; for (const name in marks) map.setMarks(name, values[0] && Uint8Array"
    bits = [int(2 * bit) for bit in left]
    m.ask(browser, f"{marks}.from(values[0].filter((_, i) => i % 2 === marks[name])))", bits)
    assert decibels(m.picture(browser), expected(gaussians, pose, np.flatnonzero(~left))) > 45
    # What is marked goes a step to the right, and the tint is the only difference from a camera that went left.
    m.ask(browser, f"{marks}.from(values[0].map(() => 1)))", bits[: (count + 1) // 2])
    unmoved = m.picture(browser)
    step = np.eye(4)
    step[:3, 3] = 0.1 * pose[:3, 0]
    m.ask(browser, "map.displace(values[0], { marks: true })", step.T.ravel().tolist())
    moved = m.picture(browser)
    assert np.abs(moved.astype(float) - unmoved).mean() > 2
    m.ask(browser, "map.displace(null)")
    m.look_from(browser, inverse(step) @ pose)
    assert np.abs(m.picture(browser).astype(float) - moved).mean() < 0.2
    m.look_from(browser, pose)
    m.ask(browser, "map.setMarks('even', null); map.setMarks('odd', null); map.dropChunk('even')")
    assert decibels(m.picture(browser), expected(gaussians, pose, np.arange(1, count, 2))) > 45
    m.ask(browser, "map.setChunk('more', map.chunks.get('odd')); map.dropChunk('odd'); map.setColors('more', null)")
    assert decibels(m.picture(browser), expected(gaussians, pose, np.arange(1, count, 2))) > 45
    assert b.errors(browser) == []


@pytest.mark.parametrize("renderer", ["processor", "webgl"])
def test_nothing_is_drawn_before_the_order_or_while_nothing_changes(browser: Any, page: Path, renderer: str) -> None:
    m.open_map(browser, page, renderer)
    shots = """const shown = map.renderer.onframe; let frames = 0;
      map.renderer.onframe = (...values) => { frames++; shown(...values); };"""
    idle = f"""{shots} const rest = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
      for (let k = 0, quiet = 0, before = -1; k < 60 && quiet < 3; k++) {{
        quiet = before === frames ? quiet + 1 : 0; before = frames; await rest(500); }}
      frames = 0; await rest(500); return frames"""
    assert m.ask(browser, idle) == 0
    early = """const canvas = document.createElement("canvas"); map.canvas.before(canvas);
      const other = new MapView(canvas, camera, { background: [0, 0, 0], renderer: values[0] }), seen = [];
      const shown = other.renderer.onframe;
      other.renderer.onframe = (shot, complete) => { shown(shot, complete);
        const copy = document.createElement("canvas"), context = copy.getContext("2d"); copy.width = copy.height = 50;
        context.drawImage(other.renderer.canvas, 0, 0, 50, 50);
        seen.push([complete,
          context.getImageData(0, 0, 50, 50).data.reduce((sum, value) => sum + value, 0) > 2500 * 255]); };
      for (const [name, splats] of map.chunks) other.setChunk(name, splats);
      await other.ready; return seen;"""
    seen = m.ask(browser, early, renderer)
    assert seen[-1] == [True, True] and all(complete == bright for complete, bright in seen)


def test_the_processor_goes_on_where_the_gpu_is_lost(
    browser: Any, page: Path, gaussians: GaussianMap, poses: list[np.ndarray]
) -> None:
    m.open_map(browser, page, "webgl")
    lost = """const count = map.chunks.get("even").count;
      map.setMarks("even", new Uint8Array(count).fill(2));
      map.renderer.gl.getExtension("WEBGL_lose_context").loseContext();
      while (map.mode === "webgl") await new Promise((resolve) => setTimeout(resolve, 20));
      return document.querySelectorAll("canvas").length"""
    assert m.ask(browser, lost) == 2
    assert decibels(m.picture(browser), expected(gaussians, poses[0], np.arange(1, len(gaussians), 2))) > 45
    browser.get_log("browser")  # a lost context is told there


def test_what_nobody_saw_fades(
    browser: Any, run: RunFolder, gaussians: GaussianMap, poses: list[np.ndarray], tmp_path: Path
) -> None:
    """From recorded poses the map is as it was trained; from behind hardly anything is left. Both renderers
    agree, and what is not drawn is not picked."""
    rows, owners = np.arange(len(gaussians)), gaussians.object_id.numpy().astype(np.uint16)
    seen = viewed_sides(gaussians, rows, run.sequence().camera, list(run.keyframes().poses().values()))
    page = m.write_map_page(tmp_path / "seen.html", {"all": (gaussians, rows, owners)}, SIZE, FOCAL, poses[0], seen)
    behind = poses[0].copy()
    behind[:3, 3] += 7 * behind[:3, 2]
    behind[:3, [0, 2]] *= -1
    aside = poses[0].copy()
    aside[:3, 3] += 1.5 * aside[:3, 0] - 0.5 * aside[:3, 1]
    pictures: dict[str, list[np.ndarray]] = {"processor": [], "webgl": []}
    for renderer, found in pictures.items():
        m.open_map(browser, page, renderer)
        for pose in (poses[0], behind, aside):
            m.look_from(browser, pose)
            found.append(m.picture(browser))
            if pose is behind:
                places = [[x, y] for x in range(30, SIZE[0], 60) for y in range(30, SIZE[1], 60)]
                picked = m.ask(browser, "return values[0].map(([x, y]) => map.pick(x, y) !== null)", places)
        assert decibels(found[0], expected(gaussians, poses[0])) > 45
        whole = expected(gaussians, behind).image.numpy()
        assert found[1].mean() / 255 < 0.2 * whole.mean() and np.mean(picked) < 0.3
    for one, other in zip(*pictures.values(), strict=True):
        assert -10 * np.log10(np.mean((one / 255 - other / 255.0) ** 2)) > 45


def test_pictures_become_sharp_whatever_comes_between(
    browser: Any, page: Path, gaussians: GaussianMap, poses: list[np.ndarray]
) -> None:
    m.open_map(browser, page, "processor")
    code = """const rest = (ms) => new Promise((resolve) => setTimeout(resolve, ms)), waiting = [];
      for (let k = 0; k < 12; k++) {
        camera.pose = k < 11 ? camera.pose.map((value, i) => value + (i === 12) * 0.01) : values[0]; map.redraw();
        waiting.push(map.depthImage(320, 240), map.screenshot()); await rest(k < 11 ? 30 : 160);
      }
      for (let k = 0; k < 4; k++) { waiting.push(map.depthImage(320, 240)); await rest(15); }
      await Promise.all(waiting); await rest(600);
      const { canvas } = map.renderer, { width, height } = canvas;
      const image = canvas.getContext("2d").getImageData(0, 0, width, height);
      return [width, height, [...image.data.filter((_, i) => i % 4 < 3)]]"""
    width, height, values = m.ask(browser, code, inverse(poses[1]).T.ravel().tolist())
    assert (width, height) == SIZE
    assert decibels(np.array(values).reshape(height, width, 3), expected(gaussians, poses[1])) > 45


def test_lines_run_where_the_world_is(browser: Any, page: Path, poses: list[np.ndarray]) -> None:
    """Two segments, one of which begins behind the camera, against their projections."""
    m.open_map(browser, page, "processor")
    here = np.array([[-0.5, -0.3, 2.0], [0.6, 0.2, 3.0]])
    behind = np.array([[0.4, -0.2, -1.0], [-0.4, 0.3, 2.0]])
    world = [(poses[0][:3, :3] @ line.T).T + poses[0][:3, 3] for line in (here, behind)]
    draw = """map.setLines("test", Float32Array.from(values[0]), [255, 0, 0], 3);
      await new Promise((resolve) => setTimeout(resolve, 600));
      const { width, height } = map.canvas, image = map.canvas.getContext("2d").getImageData(0, 0, width, height);
      const rows = []; for (let k = 0; k < image.data.length; k += 4) if (image.data[k + 3] > 127) rows.push(k / 4);
      return [width, rows, image.data[4 * rows[0]]]"""
    width, drawn, red = m.ask(browser, draw, np.concatenate([line.ravel() for line in world]).tolist())
    assert width == SIZE[0] and red == 255
    share = (0.05 + 1) / 3  # of the second segment, where it comes out of the near plane
    start = behind[0] + share * (behind[1] - behind[0])
    thin, thick = (np.zeros(SIZE[::-1], np.uint8) for _ in range(2))
    for ends in (here, np.stack([start, behind[1]])):
        pixels = 16 * (FOCAL * ends[:, :2] / ends[:, 2:] + np.array(SIZE) / 2 - 0.5)
        first, last = (tuple(int(value) for value in pixel) for pixel in np.rint(pixels))
        cv2.line(thin, first, last, 255, 1, cv2.LINE_8, 4)
        cv2.line(thick, first, last, 255, 4, cv2.LINE_AA, 4)
    found = np.zeros(SIZE[::-1], bool)
    found.ravel()[drawn] = True
    assert np.mean(thick[found] > 0) > 0.99 and np.mean(found[thin > 0]) > 0.99
    assert m.ask(browser, draw.replace("map.setLines", "map.dropLines"), [])[1] == []


def test_the_resolution_follows_the_time_a_picture_takes(browser: Any, page: Path) -> None:
    m.open_map(browser, page, "processor")
    scales = m.ask(browser, """const found = [], cost = [20, 900, 5];
      const resolution = new Resolution(0.2, 1.5, 45);
      for (const pixels of cost) {  // milliseconds of a picture: fixed, and by its pixels
        for (let i = 0; i < 40; i++) resolution.took(5 + pixels * resolution.scale ** 2);
        found.push(resolution.scale);
      }
      return found;""")  # fmt: skip
    for pixels, scale in zip([20, 900, 5], scales, strict=True):
        wanted = np.clip(np.sqrt(40 / pixels), 0.2, 1.5)
        assert 0.75 * wanted < scale < 1.25 * wanted
