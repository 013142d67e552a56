# SPDX-License-Identifier: Apache-2.0
"""The cells of the experiment's table: what is predicted, and what is found, at one voxel size and one latency."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from safety_map import LiveMap, LiveMapTuning
from safety_robot import Robot
from safety_trials import Chain, Encounters, Trial, TrialTuning, draw_trials
from safety_world import Lane, LaneCaster, find_lanes
from worlds.plan import make_world

from ggslam.scene.camera import Camera
from ggslam.volumes.safety import FRAMES_UNTIL_OCCUPIED, Braking, Latencies

FINE = 0.015
"""Voxels, in metres, below which things are fine: with them all takes long."""
FALSE_STOP = 0.1
"""Metres before the first thing along a lane from which on the map may not have anything."""


@dataclass(frozen=True)
class Experiment:
    """What is the same for all cells.

    Attributes:
        trials: encounters with one speed.
        lanes: places where they happen.
        distance: protective distance, metres: nothing appears nearer, and the robot brakes for what is nearer.
        frame_period, control_period: of camera and controller, seconds.
        robot: its body.
        camera: a window of its image.
        clearance: voxels that the robot keeps away from what the map has.
        noise: whether depth is that of a structured-light camera, else exact.
        seed: of everything random.
    """

    trials: int = 200
    lanes: int = 8
    distance: float = 2.0
    frame_period: float = 1 / 30
    control_period: float = 0.01
    robot: Robot = field(default_factory=Robot)
    camera: Camera = field(default_factory=lambda: Camera(160, 120, 200.0, 200.0, 79.5, 59.5))
    clearance: float = 1.0
    noise: bool = False
    seed: int = 0

    @property
    def max_depth(self) -> float:
        """How far the map reaches: all that appears is within."""
        return self.distance + TrialTuning.beyond + self.robot.radius + 0.1

    def make_map(self, lane: Lane, voxel: float) -> LiveMap:
        """The live map of a lane after the approach. With fine voxels the camera is a smaller window, as wide and high
        as the robot where obstacles appear: what is beside its way only takes time."""
        c = self.camera
        width, height = c.width * 3 // 5, c.height * 2 // 5
        small = Camera(width, height, c.fx, c.fy, (width - 1) / 2, (height - 1) / 2)
        camera = small if voxel < FINE else c
        return LiveMap(lane, self.robot, camera, voxel, self.max_depth, self.clearance, self.noise)


@dataclass(frozen=True)
class Cell:
    """One result; speeds in m/s, times in seconds.

    Attributes:
        voxel: metres.
        asked, latency: of sensor, map, plan and network together: as asked for, and as it was (a map that takes longer
            than that takes what it takes).
        map_latency: what 95 % of the measured times in the map stay below, of frames that show an obstacle first.
        total: latency and waiting, at worst.
        predicted: largest speed by `Braking`.
        plain: the same without waiting.
        found: largest speed without a collision.
        collisions, plain_collisions: in all trials at the two predicted speeds; -1: not tried.
        trials: their number.
        map_in_trials: time of a frame in the map during the trials: what 95 % of them stay below.
        friction, braked_share: of the robot.
    """

    voxel: float
    asked: float
    latency: float
    map_latency: float
    total: float
    predicted: float
    plain: float
    found: float
    collisions: int
    plain_collisions: int
    trials: int
    map_in_trials: float
    friction: float
    braked_share: float


@dataclass(frozen=True)
class MapTimes:
    """How a map of a voxel size does while the robot drives.

    Attributes:
        calm, news: processor time of frames, one thread: fusion, field, and the band of heights along the way, [n] of
            frames that show nothing new, [m] of the first two that show an obstacle.
        false_stops: frames of lanes without an obstacle in which the map has something in the way.
    """

    calm: np.ndarray
    news: np.ndarray
    false_stops: int

    @property
    def latency(self) -> float:
        """What 95 % of the frames with an obstacle stay below, seconds."""
        return float(np.percentile(self.news, 95))


@lru_cache(maxsize=4)
def place_trials(experiment: Experiment) -> tuple[list[Lane], list[Trial]]:
    """Where and what the encounters are."""
    shortest = LiveMapTuning.approach + experiment.distance + TrialTuning.beyond + 0.3
    lanes = find_lanes(
        make_world(30.0, experiment.seed), experiment.lanes, experiment.robot.radius, experiment.robot.heights,
        (shortest, shortest + 4), experiment.seed,
    )  # fmt: skip
    return lanes, draw_trials(lanes, experiment.robot, experiment.distance, experiment.trials, experiment.seed)


@lru_cache(maxsize=1)
def encounters(experiment: Experiment, voxel: float) -> Encounters:
    """Runs trials at a voxel size; those of the last size are kept."""
    lanes, _ = place_trials(experiment)
    return Encounters(lanes, experiment.robot, lambda lane: experiment.make_map(lane, voxel), experiment.noise)


def measure_map(experiment: Experiment, voxel: float, frames: int = 12, speed: float = 2.0) -> MapTimes:
    """Drives along each lane without an obstacle, then shows the map some obstacles, one at a time."""
    lanes, trials = place_trials(experiment)
    calm, news, stops, ahead = [], [], 0, speed * experiment.frame_period
    for number, lane in enumerate(lanes):
        live, noise = experiment.make_map(lane, voxel), number if experiment.noise else None
        # The map may be a voxel off, and things beside the way count within the clearance.
        least = lane.contact(experiment.robot.radius + live.clearance + voxel, experiment.robot.heights) - FALSE_STOP
        mine = [t.obstacle for t in trials if t.obstacle is not None and t.lane == number][:4]
        for obstacle in (None, *mine):
            caster = LaneCaster(lane, live.camera, experiment.robot.camera_height, obstacle, noise)
            live.restore()
            live.refresh()
            begin, count = len(live.seconds), frames if obstacle is None else FRAMES_UNTIL_OCCUPIED
            for x in LiveMapTuning.approach + ahead * np.arange(count):
                stops += int(live.add(caster.depth(x), caster.pose(x)) < least and obstacle is None)
            (calm if obstacle is None else news).extend(live.seconds[begin:])
    return MapTimes(np.array(calm), np.array(news), stops)


def latencies_of(experiment: Experiment, asked: float, times: MapTimes) -> Latencies:
    """Sensor and planner share what the map leaves of a latency, one to two."""
    rest = max(0.0, asked - times.latency)
    return Latencies(
        sensor=rest / 3, map=times.latency, plan=2 * rest / 3, frame_period=experiment.frame_period,
        frames=FRAMES_UNTIL_OCCUPIED, control_period=experiment.control_period,
        map_calm=float(np.percentile(times.calm, 95)),
    )  # fmt: skip


def run_cell(experiment: Experiment, voxel: float, asked: float, times: MapTimes, plain: bool = True) -> Cell:
    """Predicts the largest speed, tries it, and searches it.

    Args:
        experiment: what is common.
        voxel: metres.
        asked: latency in seconds.
        times: as `measure_map` found them.
        plain: whether the speed that leaves waiting out is tried, too.
    """
    latencies = latencies_of(experiment, asked, times)
    robot = experiment.robot
    braking = Braking(latencies, robot.friction, robot.braked_share)
    without = replace(braking, latencies=replace(latencies, frame_period=0.0, frames=1, control_period=0.0))
    predicted, ignorant = (b.largest_speed(experiment.distance) for b in (braking, without))
    chain, runner = Chain(latencies, times.calm, times.news, experiment.distance), encounters(experiment, voxel)
    _, trials = place_trials(experiment)
    collisions = count_collisions(runner, trials, predicted, chain)
    low = predicted if collisions == 0 else predicted / 2
    found = largest_safe_speed(runner, trials, chain, (low, 1.5 * predicted), 0.004 * predicted)
    more = count_collisions(runner, trials, ignorant, chain) if plain else -1
    return Cell(
        voxel, asked, without.latencies.total, latencies.map, latencies.total, predicted, ignorant, found, collisions,
        more, len(trials), float(np.percentile(runner.seconds(), 95)), robot.friction, robot.braked_share,
    )  # fmt: skip


def count_collisions(runner: Encounters, trials: list[Trial], speed: float, chain: Chain) -> int:
    """How many trials end in a collision at a speed."""
    return sum(int(runner.run(trial, speed, chain).collided) for trial in trials)


def largest_safe_speed(
    runner: Encounters, trials: list[Trial], chain: Chain, bounds: tuple[float, float], precision: float
) -> float:
    """The largest speed at which no trial ends in a collision, to a precision.

    Each trial is run at the largest speed that those before it survived, and where it does not survive, that speed is
    lowered until it does: a few trials are searched, the others run once.

    Args:
        runner: of the trials.
        trials: in random order.
        chain: from sensor to brake.
        bounds: speeds at which no trial and at which some trial ends in a collision.
        precision: in m/s.
    """
    low, speed = bounds
    for trial in trials:
        if not runner.run(trial, speed, chain).collided:
            continue
        safe, unsafe = low, speed
        while unsafe - safe > precision:
            middle = (safe + unsafe) / 2
            safe, unsafe = (safe, middle) if runner.run(trial, middle, chain).collided else (middle, unsafe)
        speed = safe
    return speed
