# SPDX-License-Identifier: Apache-2.0
"""Encounters: a robot drives along a lane, an obstacle appears, frames reach the map, the plan and the brake.

Time runs from the moment the obstacle appears. Frames are taken at a fixed rate; each reaches the mapper after the
sensor's latency; the mapper, when it is free, takes the newest that has come and works on it as long as frames were
measured to take; the plan and the network take their time; the controller takes its turns at a fixed rate and brakes
when the newest plan has something within the protective distance ahead. Braking is never taken back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from safety_map import LiveMap, LiveMapTuning
from safety_robot import Robot
from safety_world import Lane, LaneCaster, Solid

from ggslam.system.tuning import Tuning
from ggslam.volumes.safety import Latencies

KINDS = ("box", "disc", "pole", "panel", "end")
"""Obstacles that appear; "end": none does, the robot comes to what the lane ends at."""


class TrialTuning(Tuning):
    """What is drawn."""

    beyond = 0.6
    """Metres beyond the protective distance that obstacles appear within; they crowd towards it."""
    end_share = 0.1
    """Share of the trials without an obstacle."""
    before_end = 0.7
    """Metres before the protective distance that a trial without obstacle begins."""
    frames_before = 12
    """Frames, or maps where these take longer, that keep the mapper busy before an obstacle appears."""


@dataclass(frozen=True)
class Trial:
    """What is random about an encounter.

    Attributes:
        number: of the trial, seeds what is drawn during it.
        lane: number of the lane.
        kind: one of `KINDS`.
        obstacle: in the lane's frame; None: the lane's end.
        start: x of the robot when it appears.
        contact: x of the robot's centre when it would touch it.
        frame_phase, control_phase, mapper_phase: shares of a period.
    """

    number: int
    lane: int
    kind: str
    obstacle: Solid | None
    start: float
    contact: float
    frame_phase: float
    control_phase: float
    mapper_phase: float


@dataclass(frozen=True)
class Outcome:
    """How an encounter ended.

    Attributes:
        collided: whether the robot touched the obstacle.
        left: metres left along the way, negative if it went too far.
        blind: seconds until the brake worked; infinite if it did not before the robot ran into the obstacle.
        frames: taken by the map since the obstacle appeared.
    """

    collided: bool
    left: float
    blind: float
    frames: int


def draw_trials(lanes: list[Lane], robot: Robot, distance: float, count: int, seed: int) -> list[Trial]:
    """Random encounters; the phases are spread evenly over the trials."""
    rng = np.random.default_rng([seed, 54])
    phases = np.stack([(rng.permutation(count) + rng.random(count)) / count for _ in range(3)], 1)
    trials = []
    for number in range(count):
        lane = int(rng.integers(len(lanes)))
        kind = "end" if rng.random() < TrialTuning.end_share else KINDS[int(rng.integers(4))]
        start, obstacle, contact = LiveMapTuning.approach, None, lanes[lane].end
        if kind == "end":
            start = contact - distance - TrialTuning.before_end
        else:
            contact = start + distance + TrialTuning.beyond * rng.random() ** 3
            obstacle = _placed(_draw_solid(kind, rng), robot, contact, rng)
        trials.append(Trial(number, lane, kind, obstacle, start, contact, *phases[number]))
    return trials


def _draw_solid(kind: str, rng: np.random.Generator) -> Solid:
    high, angle = float(rng.uniform(0.3, 1.6)), float(rng.uniform(-np.pi, np.pi))
    if kind == "box":
        width, depth = rng.uniform(0.1, 0.4, 2)
        return Solid(0, 0, (float(width), float(depth)), 0, high, angle)
    if kind == "panel":
        return Solid(0, 0, (0.025, float(rng.uniform(0.3, 0.6))), 0, max(high, 0.8), float(rng.uniform(-0.6, 0.6)))
    radius = float(rng.uniform(0.1, 0.3) if kind == "disc" else rng.uniform(0.015, 0.05))
    return Solid(0, 0, (radius, radius), 0, high, 0.0, round=True)


def _placed(solid: Solid, robot: Robot, contact: float, rng: np.random.Generator) -> Solid:
    """The solid beside the middle of the way, so that the robot touches it at `contact`."""
    reach = robot.radius + float(np.hypot(*solid.half))
    while True:
        moved = replace(solid, y=float(rng.uniform(-reach, reach)))
        found = moved.contact(robot.radius)
        if np.isfinite(found):
            return replace(moved, x=contact - found)


@dataclass(frozen=True)
class Chain:
    """What stands between an obstacle and the brake.

    Attributes:
        latencies: of sensor, plan and network, and the periods; that of the map is drawn from the next two.
        calm, news: measured times of frames in the map, [n], [m], of those that show nothing new, and of those that
            are the first to show an obstacle.
        distance: protective distance, metres.
    """

    latencies: Latencies
    calm: np.ndarray
    news: np.ndarray
    distance: float


class Encounters:
    """Runs trials on the maps of their lanes, which `make_map` makes when they are needed, and which are kept.

    Args:
        lanes: where trials are.
        robot: its body.
        make_map: the live map of a lane after the approach.
        noise: whether depth is that of a structured-light camera.
    """

    def __init__(self, lanes: list[Lane], robot: Robot, make_map: Callable[[Lane], LiveMap], noise: bool) -> None:
        self.lanes, self.robot, self.make_map, self.noise = lanes, robot, make_map, noise
        self._maps: dict[int, LiveMap] = {}

    def map_of(self, lane: int) -> LiveMap:
        """The live map of a lane."""
        if lane not in self._maps:
            self._maps[lane] = self.make_map(self.lanes[lane])
        return self._maps[lane]

    def seconds(self) -> np.ndarray:
        """Measured times of all frames so far."""
        return np.array([s for one in self._maps.values() for s in one.seconds])

    def run(self, trial: Trial, speed: float, chain: Chain) -> Outcome:
        """One encounter at a speed in m/s."""
        live, noise = self.map_of(trial.lane), trial.number if self.noise else None
        caster = LaneCaster(live.lane, live.camera, self.robot.camera_height, trial.obstacle, noise)
        try:
            return _drive(trial, speed, chain, live, caster, self.robot)
        finally:
            live.restore()


def _drive(trial: Trial, speed: float, chain: Chain, live: LiveMap, caster: LaneCaster, robot: Robot) -> Outcome:
    def at(t: float) -> float:
        return trial.start + speed * t

    lat = chain.latencies
    rest = lat.plan + lat.network
    last = (trial.contact - trial.start) / speed  # when the robot runs into it
    braked, found, frames = np.inf, np.inf, 0
    for taken, ready in mapped_frames(trial, chain):
        available = ready + rest
        if braked <= available or available > last:
            break  # nothing that this frame tells can come in time
        if taken < 0:
            continue
        frames += 1
        found = live.add(caster.depth(at(taken)), caster.pose(at(taken)))
        near = (found - chain.distance - trial.start) / speed
        braked = _next_turn(max(available, near), trial.control_phase, lat.control_period)
    if braked >= last:
        return Outcome(True, -np.inf, np.inf, frames)
    left = trial.contact - robot.brake(at(braked), speed)
    return Outcome(left < 0, left, braked, frames)


def mapped_frames(trial: Trial, chain: Chain) -> Iterator[tuple[float, float]]:
    """When the frames that the mapper takes were taken by the sensor, and when they are in the map: pairs of seconds
    since the obstacle appeared, without end. A frame that was taken before has a negative time."""
    lat, period = chain.latencies, chain.latencies.frame_period
    rng = np.random.default_rng([trial.number, 55])
    free = -(TrialTuning.frames_before + trial.mapper_phase) * max(period, float(chain.calm.max()))
    number = int(np.floor(free / period)) - 1
    while True:
        newest = int(np.floor((free - lat.sensor) / period - trial.frame_phase))
        number = max(newest, number + 1)
        taken = (trial.frame_phase + number) * period
        free = max(free, taken + lat.sensor) + float(rng.choice(chain.calm if taken < 0 else chain.news))
        yield taken, free


def _next_turn(t: float, phase: float, period: float) -> float:
    """The controller's first turn at or after a time."""
    if not np.isfinite(t) or period == 0:
        return t
    return float((np.ceil(t / period - phase) + phase) * period)
