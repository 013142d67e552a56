# SPDX-License-Identifier: Apache-2.0
"""Which chunks of a large map the page holds, in chromium. Skips where it is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from . import browser as b
from . import map_page as m

pytestmark = pytest.mark.browser
_GRID = """
const chunks = [];
for (let x = 0; x < 10; x++) for (let z = 0; z < 10; z++)
  chunks.push({ id: `${x} ${z}`, low: [4 * x - 20, 0, 4 * z], high: [4 * x - 16, 2, 4 * z + 4],
    levels: [40000, 10000, 2500] });
const chooser = new ChunkLevels(chunks, values[0]), eye = { near: 0.05, at: [0, 1, -1],
  view() { return Float32Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -this.at[0], -this.at[1], -this.at[2], 1]); },
  focal(width) { return width; } };
const count = ([id, level]) => chunks.find((c) => c.id === id).levels[level];
const splats = () => [...chooser.chosen].map(count).reduce((sum, value) => sum + value, 0);
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    page = b.open_browser(700, 600)
    page.set_script_timeout(b.PATIENCE_S)
    path = m.write_map_page(tmp_path_factory.mktemp("empty") / "map.html", {}, (480, 360), 400.0, np.eye(4))
    page.get(Path(path).as_uri())
    yield page
    page.quit()


def test_levels_may_be_counted_or_listed(browser: Any) -> None:
    code = "return [ChunkLevels.counts({ count: 1001, levels: 3 }), ChunkLevels.counts({ count: 9, levels: [9, 2] })]"
    assert m.ask(browser, code) == [[1001, 251, 63], [9, 2]]


@pytest.mark.parametrize("budget", [100_000, 400_000, 1_000_000, 10_000_000])
def test_the_budget_goes_to_what_is_near_and_in_sight(browser: Any, budget: int) -> None:
    levels, splats = m.ask(
        browser, f"{_GRID} chooser.choose(eye, 800, 600); return [Object.fromEntries(chooser.chosen), splats()]", budget
    )
    assert splats <= budget
    if budget >= 250_000:
        assert len(levels) == 100  # all, at their coarsest at least
        assert splats > 0.85 * budget or budget == 10_000_000
    ahead = [levels.get(f"{x} 0", 3) for x in (4, 5)]
    if budget >= 400_000:
        assert ahead == [0, 0]
    behind_others = [levels.get(f"{x} {z}", 3) for x in (0, 9) for z in (0, 1)]  # aside of the camera
    assert min(behind_others) >= max(ahead)
    far = [levels.get(f"4 {z}", 3) for z in range(10)]
    assert far == sorted(far)


def test_levels_stay_while_the_camera_trembles(browser: Any) -> None:
    changes = m.ask(browser, f"""{_GRID}
        let before = new Map(chooser.choose(eye, 800, 600)), changes = [0, 0];
        for (const [k, step] of [[0, 0.02], [1, 6]])
          for (let i = 1; i < 8; i++) {{
            eye.at = [0, 1, -1 + step * (i % 2)];
            const now = chooser.choose(eye, 800, 600);
            for (const [id, level] of now) changes[k] += before.get(id) !== level;
            before = new Map(now);
          }}
        return changes;""", 600_000)  # fmt: skip
    assert changes[0] <= 2 and changes[1] > 10


def test_chunks_are_loaded_dropped_and_renewed(browser: Any) -> None:
    calls, most, held, dropped, renewed = m.ask(browser, f"""{_GRID}
        const calls = [], drawn = new Map(); let now = 0, most = 0, dropped = 0;
        const shown = {{ canvas: {{ clientWidth: 800, clientHeight: 600 }}, camera: eye,
          setChunk: (id, level) => drawn.set(id, level), dropChunk: (id) => {{ drawn.delete(id); dropped++; }} }};
        const loader = new ChunkLoader(shown, chooser, async (id, level) => {{
          calls.push(id); most = Math.max(most, ++now); await new Promise((r) => setTimeout(r, 1)); now--;
          if (id === "9 9") throw new Error("damaged");
          return level; }});
        const idle = async () => {{ while (loader.busy.size) await new Promise((r) => setTimeout(r, 5)); }};
        let errors = 0; loader.onerror = () => errors++;
        loader.update(); await idle();
        const first = calls.length;
        const same = [...chooser.chosen].every(([id, level]) => drawn.get(id) === level || id === "9 9");
        loader.update(); await idle();
        if (calls.length !== first || errors > 1 || !same) return [calls.length, -1, first, errors, same];
        chunks[44].version = 2; loader.update(); await idle();
        const renewed = calls.slice(first);
        chunks.splice(0, 50); loader.update(); await idle();
        return [first, most, drawn.size, dropped, renewed.join()];""", 600_000)  # fmt: skip
    assert calls == 100 and most == 3 and renewed == "4 4"
    assert dropped == 50 and held == 49


def test_the_map_says_when_it_rests(browser: Any) -> None:
    rests = m.ask(browser, """let rests = 0; map.onrest = () => rests++;
        const rest = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
        for (let i = 0; i < 8; i++) { camera.pose[12] += 0.01; map.redraw(); await rest(30); }
        const moving = rests; await rest(600); const once = rests; map.redraw(); return [moving, once];""")  # fmt: skip
    assert rests == [0, 1]
