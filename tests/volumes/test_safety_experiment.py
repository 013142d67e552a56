# SPDX-License-Identifier: Apache-2.0
"""The experiment behind safe speeds (scripts/benchmarks/bench_safety.py): its physics, its collisions, its depth, its
clock, and that it can fail."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from worlds.plan import make_world

from ggslam.volumes.safety import FRAMES_UNTIL_OCCUPIED, GRAVITY, Braking, Latencies

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "benchmarks"))

from safety_cells import (
    Experiment,
    MapTimes,
    count_collisions,
    encounters,
    largest_safe_speed,
    latencies_of,
    place_trials,
)
from safety_robot import Robot
from safety_trials import Chain, Trial, mapped_frames
from safety_world import LaneCaster, Solid, find_lanes

SMALL = Experiment(trials=24, lanes=2)
TIMES = MapTimes(np.array([0.002, 0.003]), np.array([0.003, 0.004]), 0)
VOXEL = 0.1


@pytest.mark.parametrize("load", [0.0, 25.0])
@pytest.mark.parametrize("speed", [0.3, 1.7, 4.123])
def test_a_robot_stops_where_the_closed_form_says(speed: float, load: float) -> None:
    robot = Robot(mass=40.0, load=load, friction=0.4)
    share = 40.0 / (40.0 + load)
    assert robot.brake(1.0, speed) - 1.0 == pytest.approx(speed**2 / (2 * 0.4 * share * GRAVITY), abs=1e-3)
    braking = Braking(Latencies(0, 0, 0), friction=0.4, braked_share=robot.braked_share)
    assert robot.brake(0.0, speed) == pytest.approx(braking.stopping_distance(speed), abs=1e-3)


def _gap(solid: Solid, x: float, radius: float) -> float:
    """Metres between a disc at (x, 0) and a solid, by the distance of densely sampled points of its outline."""
    if solid.round:
        angle = np.linspace(0, 2 * np.pi, 4001)
        outline = solid.half[0] * np.stack([np.cos(angle), np.sin(angle)], 1)
    else:
        ends, (hx, hy) = np.linspace(-1, 1, 1001), solid.half
        sides = [np.stack([hx * ends, np.full(1001, s * hy)], 1) for s in (-1, 1)]
        sides += [np.stack([np.full(1001, s * hx), hy * ends], 1) for s in (-1, 1)]
        outline = np.concatenate(sides)
    c, s = np.cos(solid.angle), np.sin(solid.angle)
    placed = outline @ np.array([[c, s], [-s, c]]) + (solid.x, solid.y)
    return float(np.linalg.norm(placed - (x, 0.0), axis=1).min()) - radius


def test_contact_is_where_the_disc_touches_first() -> None:
    rng = np.random.default_rng(3)
    met = 0
    for _ in range(40):
        half = tuple(rng.uniform(0.02, 0.5, 2))
        round_ = bool(rng.random() < 0.3)
        solid = Solid(3.0, float(rng.uniform(-1.2, 1.2)), (half[0], half[0] if round_ else half[1]), 0, 1,
                      float(rng.uniform(-4, 4)), round_)  # fmt: skip
        contact = solid.contact(0.3)
        if np.isfinite(contact):
            met += 1
            assert _gap(solid, contact, 0.3) == pytest.approx(0, abs=1e-5)
            assert min(_gap(solid, x, 0.3) for x in np.linspace(0, contact - 1e-3, 20)) > 0
        else:
            assert min(_gap(solid, x, 0.3) for x in np.linspace(1, 5, 100)) > -1e-4
    assert 12 < met < 40


def test_depth_is_that_of_the_world() -> None:
    """The lane's images against the world's own ray caster, which walks a grid."""
    lane = find_lanes(make_world(30.0, 0), 1, 0.3, (0.05, 0.6), (4.0, 9.0), 1)[0]
    camera = SMALL.camera
    depth = LaneCaster(lane, camera, 0.4).depth(1.0)
    for v, u in ((60, 80), (100, 20), (10, 150), (59, 5), (119, 80)):
        ray = np.array([1.0, -(u - camera.cx) / camera.fx, -(v - camera.cy) / camera.fy])
        along = np.linspace(0, 12, 120001)
        points = np.array([1.0, 0.0, 0.4]) + along[:, None] * ray
        inside = (points[:, 2] < 0) | (points[:, 2] > lane.height)
        for solid in lane.solids:
            c, s = np.cos(solid.angle), np.sin(solid.angle)
            x, y = points[:, 0] - solid.x, points[:, 1] - solid.y
            inside |= (
                (np.abs(c * x + s * y) < solid.half[0]) & (np.abs(c * y - s * x) < solid.half[1])
                & (points[:, 2] > solid.low) & (points[:, 2] < solid.high)
            )  # fmt: skip
        assert depth[v, u] == pytest.approx(along[np.argmax(inside)] if inside.any() else np.inf, abs=3e-4)


@pytest.mark.parametrize(("calm", "news"), [(3, 3), (20, 30), (40, 45), (75, 80), (220, 240), (20, 130), (45, 130)])
def test_an_obstacle_waits_no_longer_than_predicted(calm: float, news: float) -> None:
    """The frames that a busy mapper takes: the second that shows an obstacle is in the map in the predicted time."""
    rng = np.random.default_rng(5)
    seconds = rng.uniform(0.85, 1, (2, 40)) * [[calm / 1e3], [news / 1e3]]
    latencies = Latencies(
        0.011, float(seconds[1].max()), 0.0, 0.0, 1 / 30, FRAMES_UNTIL_OCCUPIED, map_calm=float(seconds[0].max())
    )
    chain, longest = Chain(latencies, *seconds, 2.0), 0.0
    for number in range(3000):
        trial = Trial(number, 0, "box", None, 0.0, 1.0, *rng.random(3))
        seen = (ready for taken, ready in mapped_frames(trial, chain) if taken >= 0)
        longest = max(longest, next(islice(seen, FRAMES_UNTIL_OCCUPIED - 1, None)))
    assert longest <= latencies.total
    assert longest > 0.85 * latencies.total


@pytest.fixture(scope="module")
def chain() -> Chain:
    return Chain(latencies_of(SMALL, 0.3, TIMES), TIMES.calm, TIMES.news, SMALL.distance)


def _predict(latencies: Latencies) -> float:
    return Braking(latencies, SMALL.robot.friction).largest_speed(SMALL.distance)


def test_below_the_predicted_speed_nothing_is_hit_and_little_above_it_something_is(chain: Chain) -> None:
    runner, (_, trials) = encounters(SMALL, VOXEL), place_trials(SMALL)
    predicted = _predict(chain.latencies)
    assert count_collisions(runner, trials, predicted, chain) == 0
    found = largest_safe_speed(runner, trials, chain, (predicted, 1.5 * predicted), 0.01 * predicted)
    assert predicted <= found < 1.1 * predicted


def test_a_wrong_latency_is_found_out(chain: Chain) -> None:
    """A robot that takes 200 ms longer than it was said to hits things."""
    runner, (_, trials) = encounters(SMALL, VOXEL), place_trials(SMALL)
    assert count_collisions(runner, trials, _predict(replace(chain.latencies, plan=0.0)), chain) > 4


def test_an_obstacle_is_in_the_map_after_two_frames() -> None:
    """Where the map has seen the place free; that is what `FRAMES_UNTIL_OCCUPIED` says."""
    runner, (lanes, trials) = encounters(SMALL, VOXEL), place_trials(SMALL)
    head_on = [t for t in trials if t.obstacle is not None and abs(t.obstacle.y) < 0.3][:6]
    for trial in head_on:
        live = runner.map_of(trial.lane)
        caster = LaneCaster(lanes[trial.lane], live.camera, SMALL.robot.camera_height, trial.obstacle)
        found = [live.add(caster.depth(x), caster.pose(x)) for x in (trial.start, trial.start + 0.05)]
        live.restore()
        live.refresh()
        assert np.isinf(found[0])
        assert found[1] + live.clearance == pytest.approx(trial.contact, abs=VOXEL)
        assert np.isinf(live.contact())  # the map is again as it was
