# SPDX-License-Identifier: Apache-2.0
"""A run in an earlier map looks through what was carried away since, and the map forgets it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from box_room import CAMERA, QUICK, RED, picture, red_share

from ggslam.errors import FormatError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.slam.config import load_config
from ggslam.slam.filters.earlier_views import EarlierViews
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam

EARLIER, HALF, ALL = 10, 22, 34
"""Frames of the earlier visit, of a part of the later one, and of both."""
BOX, AWAY = 0.1, 50.0
"""Where the box is, metres to the right, and where nobody sees it."""
STEP = 0.015
"""Metres to the right from frame to frame."""


def new_slam() -> Slam:
    return Slam(CAMERA, load_config(None, ["movers.enabled=false", *QUICK]))


def go_on(slam: Slam, frames: range, box_x: float) -> Slam:
    for n in frames:
        slam.step(picture(n, STEP * n, box_x))
    return slam


def two_visits(box_x: float, told: bool = True, frames: int = ALL) -> Slam:
    """The box is at `box_x` in the later one. The run knows which keyframes are of the earlier one if it is `told`."""
    slam = go_on(new_slam(), range(EARLIER), BOX)
    if told:
        for keyframe in slam.mapper.keyframes:
            keyframe.frame_index = FROM_EARLIER_RUN
    return go_on(slam, range(EARLIER, frames), box_x)


@pytest.fixture(scope="module")
def carried_away() -> Slam:
    return two_visits(AWAY)


@pytest.mark.long("four short runs")
def test_what_was_carried_away_leaves_map_and_keyframes(carried_away: Slam) -> None:
    untold = two_visits(AWAY, told=False)
    assert untold.filters.get(EarlierViews).gaussians == 0 and red_share(untold, 0) > 0.02
    assert carried_away.filters.get(EarlierViews).gaussians > 300
    assert red_share(carried_away, 0) < red_share(untold, 0) / 10
    first = carried_away.mapper.keyframes[0]
    assert first.moving is not None and not first.depth[first.moving].any()
    assert (first.color[first.moving] == RED).all(1).mean() > 0.5
    gone = carried_away.filters.get(EarlierViews).gaussians
    assert any(f"{gone} Gaussians" in note for note in carried_away.result().notes)


def test_where_nothing_changed_all_stays() -> None:
    slam = two_visits(BOX)
    assert slam.filters.get(EarlierViews).counted
    assert slam.filters.get(EarlierViews).gaussians == 0 and not slam.filters.get(EarlierViews).notes(1)
    assert all(keyframe.moving is None for keyframe in slam.mapper.keyframes)


def test_what_stands_before_an_earlier_view_is_left_out_of_it() -> None:
    """The wall behind it is there as before: its Gaussians stay."""
    slam = go_on(new_slam(), range(EARLIER), AWAY)
    for keyframe in slam.mapper.keyframes:
        keyframe.frame_index = FROM_EARLIER_RUN
    go_on(slam, range(EARLIER, ALL), BOX)
    first = slam.mapper.keyframes[0]
    box = (picture(0, 0, BOX).color == RED).all(2)
    assert first.moving is not None and first.moving[box].mean() > 0.7 and first.moving[~box].mean() < 0.05
    assert slam.filters.get(EarlierViews).gaussians == 0


def test_another_run_goes_on_bit_for_bit() -> None:
    first, again = two_visits(AWAY, frames=HALF), new_slam()
    assert first.filters.get(EarlierViews).counted
    tree, arrays = describe_state(first)
    restore_state(again, json.loads(json.dumps(tree)), [array.copy() for array in arrays])
    for slam in (first, again):
        go_on(slam, range(HALF, ALL), AWAY)
    assert first.filters.get(EarlierViews).gaussians == again.filters.get(EarlierViews).gaussians > 0
    assert np.array_equal(first.map.means.numpy(), again.map.means.numpy())


def test_counts_of_another_size_are_refused() -> None:
    first, again = two_visits(AWAY, frames=HALF), new_slam()
    view = next(iter(first.filters.get(EarlierViews).views.values()))
    view.through = view.through[:-1]
    tree, arrays = describe_state(first)
    with pytest.raises(FormatError, match="EarlierView.through.*int16"):
        restore_state(again, tree, [array.copy() for array in arrays])


def test_after_a_closed_loop_what_is_gone_stays_gone_and_counting_begins_anew(carried_away: Slam) -> None:
    views = carried_away.filters.get(EarlierViews)
    gone = {number: view.gone.copy() for number, view in views.views.items()}
    assert any(places.any() for places in gone.values()) and views.counted
    views.loop_closed()
    assert not views.counted
    for number, view in views.views.items():
        assert np.array_equal(view.gone, gone[number])
        assert not view.through.any() and not view.same.any() and not view.before.any()
