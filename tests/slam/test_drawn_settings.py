# SPDX-License-Identifier: Apache-2.0
"""Whatever the ranges allow, a run ends, or says in one line why it cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drawn_settings import configure, draw, run

from ggslam.errors import GgslamError
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    """Four frames of 64x48."""
    return list(open_sequence(room, scale=0.4, stop=4).stream())


def check(frames: list[Frame], seed: int, count: int) -> None:
    chosen = draw(seed, count)
    try:
        run(frames, configure(chosen))
    except GgslamError as error:
        assert "\n" not in str(error)
    except Exception as error:
        raise AssertionError(f"settings drawn with seed {seed}: {chosen}") from error


def test_a_draw_repeats_and_reaches_the_ends_of_ranges() -> None:
    assert draw(1, 6) == draw(1, 6) != draw(2, 6)
    drawn = [draw(seed, 12) for seed in range(40)]
    assert len(set().union(*drawn)) > 150
    values = [chosen["mapping.insertion.opacity"] for chosen in drawn if "mapping.insertion.opacity" in chosen]
    assert all(0.001 <= value <= 0.999 for value in values)


@pytest.mark.parametrize("seed", range(4))
def test_a_short_run_stays_in_order(frames: list[Frame], seed: int) -> None:
    check(frames, seed, 10)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 400))
def test_many_short_runs_stay_in_order(frames: list[Frame], seed: int) -> None:
    check(frames, seed, int(np.random.default_rng(seed).integers(3, 15)))
