# SPDX-License-Identifier: Apache-2.0
"""A short piece of scripts/benchmarks/bench_soak.py: rounds through a room leave nothing behind but the map."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmarks" / "bench_soak.py"
MOST = 16
pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="not in a checkout")


@pytest.mark.long("four rounds through a room")
def test_rounds_leave_nothing_but_the_map() -> None:
    script: dict[str, Any] = runpy.run_path(str(SCRIPT))
    rounds = script["Rounds"]("room", 36, 80, 60)
    settings = ["mapping.iterations_per_frame=1", "identity.enabled=false", f"loops.activity.most={MOST}"]
    soak = script["Soak"](rounds, settings, every=36)
    first, *_, last = soak.run(144, say=False)[1:]
    assert last.keyframes > MOST + 4 and last.active <= MOST + MOST // 8
    assert last.lost == 0 and last.off_cm < 10
    assert last.threads <= first.threads and last.files <= first.files
    beside = [row.resident_mb - row.map_mb for row in (first, last)]
    assert beside[1] - beside[0] < 30
    assert last.gaussians < 1.5 * first.gaussians
    assert not [event for event in soak.slam.loops.events if event.kind == "closed"]  # nothing to close in one room
