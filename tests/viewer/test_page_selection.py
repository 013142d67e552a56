# SPDX-License-Identifier: Apache-2.0
"""What a page selects and what the program selects: the same Gaussians, for shapes drawn by hand and at random."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import pytest

from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.objects.selection import ScreenShape, read_selection
from ggslam.scene.poses import quaternion_to_matrix

from . import browser as b
from .page_hand import Hand

pytestmark = pytest.mark.browser


def random_shape(draw: np.random.Generator) -> dict[str, Any]:
    """Near the origin, where the Gaussians of the test are; some objects are hidden."""
    return {**_visible_shape(draw), "hidden": draw.integers(0, 8, draw.integers(3)).tolist()}


def _visible_shape(draw: np.random.Generator) -> dict[str, Any]:
    kind = draw.choice(["all", "objects", "sphere", "box", "screen"], p=[0.1, 0.2, 0.2, 0.2, 0.3])
    if kind == "all":
        return {"kind": "all"}
    if kind == "objects":
        return {"kind": "objects", "ids": draw.integers(0, 8, 3).tolist()}
    R = quaternion_to_matrix(draw.normal(size=4) / 1.0)
    if kind == "sphere":
        return {"kind": "sphere", "center": draw.normal(size=3).tolist(), "radius": float(draw.uniform(0.3, 2))}
    if kind == "box":
        size = draw.uniform(0.5, 3, 3).tolist()
        return {"kind": "box", "center": draw.normal(size=3).tolist(), "axes": R.tolist(), "size": size}
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, [*draw.normal(size=2), 2.0]
    w, h = draw.integers(5, 60, 2).tolist()
    runs, left = [], w * h
    while left:
        runs.append(int(min(left, draw.integers(0, 40))))
        left -= runs[-1]
    return {
        "kind": "screen", "T_camera_world": T.ravel().tolist(), "width": 640, "height": 480, "focal": 300.0,
        "near": 0.05, "mask": {"width": w, "height": h, "runs": runs}, "seen_only": bool(draw.integers(2)),
    }  # fmt: skip


def test_page_and_program_select_the_same(served: tuple[Hand, ViewedRun]) -> None:
    hand, _ = served
    draw = np.random.default_rng(5)
    n = 400
    centers, owners = draw.normal(size=(n, 3)).astype(np.float32), draw.integers(0, 8, n)
    surface = draw.uniform(0, 4, 60 * 60).astype(np.float32)
    splats = {"count": n, "centers": centers.ravel().tolist(), "ids": owners.tolist()}
    modes = ["set", "add", "remove", "intersect", "invert"]
    cases = [
        [{"mode": str(draw.choice(modes)), "shape": random_shape(draw)} for _ in range(draw.integers(1, 5))]
        for _ in range(300)
    ]
    # The page computes in float64 from the float32 centres that it has, as the program does.
    code = """arguments[0].map((steps) => Array.from(selectedSplats(steps, arguments[1],
        (shape) => (shape.seen_only ? Float32Array.from(arguments[2]) : null))))"""
    found = np.array(hand.ask(code, cases, splats, surface.tolist()), bool)

    def depth_of(shape: ScreenShape) -> np.ndarray:
        return surface[: shape.mask.size].reshape(shape.mask.shape)

    expected = np.stack([read_selection(steps).rows(centers, owners, depth_of) for steps in cases])
    assert np.array_equal(found, expected)
    assert 0.1 < expected.mean() < 0.9  # neither all nor nothing


def chosen_of(hand: Hand) -> np.ndarray:
    """Marks of the splats that the page shows, bool [n]."""
    return np.array(hand.ask("Array.from(ggslam.chosen.get('map') || [])"), bool)


def splats_of(hand: Hand) -> tuple[np.ndarray, np.ndarray]:
    """Centres float32 [n, 3] and owners [n] of what the page shows."""
    code = """(() => { const { centers, ids } = ggslam.map.chunks.get("map");
        const text = (array) => { let found = ""; for (const byte of new Uint8Array(array.buffer, array.byteOffset,
          array.byteLength)) found += String.fromCharCode(byte); return btoa(found); };
        return [text(centers), text(ids)]; })()"""
    centers, ids = hand.ask(code)
    flat = np.frombuffer(base64.b64decode(centers), np.float32)
    return flat.reshape(-1, 3), np.frombuffer(base64.b64decode(ids), np.uint16).astype(int)


def drawn(hand: Hand, points: list[Any]) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Draws over the map: the steps of the selection that comes of it, and which splats the page itself selects."""
    hand.ask("ggslam.select([])")
    hand.drag(points)
    hand.wait("ggslam.steps.length > 0")
    steps = hand.ask("ggslam.steps")
    return steps, np.array(hand.ask("Array.from(ggslam.selected(ggslam.steps, ggslam.map.chunks.get('map')))"), bool)


def test_what_is_drawn_is_selected(served: tuple[Hand, ViewedRun]) -> None:
    """With box, lasso, brush and sphere; once through everything, once on the surface only."""
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    hand.press_words("splats")
    centers, owners = splats_of(hand)
    view = np.array(hand.ask("Array.from(ggslam.camera.view())")).reshape(4, 4).T
    size = np.array(hand.ask("[ggslam.canvas.clientWidth, ggslam.canvas.clientHeight]"))
    local = centers @ view[:3, :3].T + view[:3, 3]
    z = np.where(local[:, 2] > 0.05, local[:, 2], np.nan)
    pixels = size / 2 + hand.ask("ggslam.focal()") * local[:, :2] / z[:, None]
    middle = size // 2
    low, high = middle - [90, 60], middle + [80, 90]
    counts = dict[tuple[str, bool], int]()
    for seen_only in (False, True):
        if hand.ask("ggslam.seenOnly") != seen_only:
            hand.press("seen")
        hand.keys("2")
        steps, found = drawn(hand, [low, middle, high])
        counts["box", seen_only] = int(found.sum())
        if not seen_only:
            margin = 2.5  # pixels of the mask are larger than those of the screen
            assert found[((pixels > low + margin) & (pixels < high - margin)).all(1)].all()
            assert not found[~((pixels > low - margin) & (pixels < high + margin)).all(1)].any()
        assert len(steps) == 1 and steps[0]["shape"]["seen_only"] is seen_only
        # The program, which renders the surface itself, agrees, but for splats at the edge of being seen.
        b.wait_for(lambda: hand.text("chosen").startswith(f"{hand.ask('ggslam.total'):,}"))
        decided = chosen_of(hand)
        assert (decided != found).mean() < (0.03 if seen_only else 1e-6), seen_only
        hand.keys("3")
        _, lasso = drawn(hand, [low, [high[0], low[1]], high, [low[0], high[1]]])
        assert (lasso != found).sum() <= 0.03 * found.sum()  # the same rectangle, drawn as a lasso
        hand.keys("4")
        _, brushed = drawn(hand, [middle, middle + [60, 0]])
        radius = hand.ask("ggslam.brush")
        if not seen_only:
            along = np.clip(pixels[:, 0], middle[0], middle[0] + 60)
            away = np.hypot(pixels[:, 0] - along, pixels[:, 1] - middle[1])
            assert brushed[away < radius - 3].all() and not brushed[~(away < radius + 3)].any()
        counts["brush", seen_only] = int(brushed.sum())
    assert all(counts[tool, True] <= counts[tool, False] for tool in ("box", "brush")) and min(counts.values()) > 0
    assert counts["box", True] < counts["box", False]
    hand.keys("5")
    steps, found = drawn(hand, [middle, middle + [40, 0]])
    ball = steps[0]["shape"]
    hit = hand.ask("ggslam.map.pick(...arguments[0])", middle.tolist())
    assert np.allclose(ball["center"], hit["point"], atol=1e-5)
    assert ball["radius"] == pytest.approx(40 * hit["depth"] / hand.ask("ggslam.focal()"), rel=0.03)
    assert np.array_equal(found, np.linalg.norm(centers - ball["center"], axis=1) <= ball["radius"])
    hand.keys(Keys.CONTROL, "i")
    code = "Array.from(ggslam.selected(ggslam.steps, ggslam.map.chunks.get('map')))"
    assert np.array_equal(np.array(hand.ask(code), bool), ~found)
    hand.keys(Keys.CONTROL, "a")
    hand.wait(f"ggslam.total === {len(model.gaussians())}")
    hand.keys(Keys.ESCAPE)
    hand.wait("ggslam.steps.length === 0")


def test_what_is_hidden_is_neither_selected_nor_in_the_way(served: tuple[Hand, ViewedRun]) -> None:
    from selenium.webdriver.common.keys import Keys

    hand, model = served
    ((number, place),) = list(hand.object_places().items())[:1]
    owners = model.gaussians().object_id.numpy()
    hand.ask("ggslam.hide([arguments[0]], true)", number)
    hand.press_words("splats")
    hand.keys("4")
    steps, found = drawn(hand, [place, place + [40, 0]])
    assert steps[0]["shape"]["hidden"] == [number]
    _, ids = splats_of(hand)
    assert found.any() and not found[ids == number].any()
    b.wait_for(lambda: hand.text("chosen").startswith(f"{hand.ask('ggslam.total'):,}"))
    decided = chosen_of(hand)  # by the program, of what lies behind
    assert (decided != found).sum() <= 0.2 * found.sum() and not decided[ids == number].any()
    before = int((owners == number).sum())
    hand.keys(Keys.DELETE)
    b.wait_for(lambda: len(model.edits()) == 1)
    assert int((model.gaussians().object_id.numpy() == number).sum()) == before


def test_whole_objects_are_drawn_round(served: tuple[Hand, ViewedRun]) -> None:
    hand, _ = served
    hand.keys("2")
    size = np.array(hand.ask("[ggslam.canvas.clientWidth, ggslam.canvas.clientHeight]"))
    hand.drag([[70, 5], size / 2, size - 5])
    b.wait_for(lambda: len(hand.selected()) > 3)
    seen = set(hand.object_places())
    assert set(hand.selected()) <= seen | {0}
