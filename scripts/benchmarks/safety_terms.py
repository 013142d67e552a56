# SPDX-License-Identifier: Apache-2.0
"""What each term of the prediction is worth: collisions at the speed that is predicted without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from safety_cells import Experiment, MapTimes, count_collisions, encounters, latencies_of, place_trials
from safety_trials import Chain

from ggslam.volumes.safety import Braking

ASKED = 0.05
"""Latency that terms are tried at, seconds."""
LOAD = 20.0
"""Unbraked load of the term "load", kilograms."""


@dataclass(frozen=True)
class Term:
    """One row: what was left out, the speed predicted so, and the collisions in all trials."""

    name: str
    speed: float
    collisions: int


def try_terms(experiment: Experiment, voxel: float, times: MapTimes) -> list[Term]:
    """Leaves out one term at a time."""
    lat = latencies_of(experiment, ASKED, times)
    whole = Braking(lat, experiment.robot.friction, experiment.robot.braked_share)

    def late(**changes: float) -> Braking:
        return replace(whole, latencies=replace(lat, **changes))  # type: ignore[arg-type]

    loaded = replace(experiment, robot=replace(experiment.robot, load=LOAD))
    tries = [
        ("all terms, a voxel of clearance", experiment, whole),
        ("no wait for a frame, for the map or the controller", experiment,
         late(frame_period=0.0, control_period=0.0)),
        ("one frame is enough", experiment, late(frames=1)),
        ("no wait for the controller", experiment, late(control_period=0.0)),
        ("latency half as long", experiment, late(sensor=lat.sensor / 2, plan=lat.plan / 2, map=lat.map / 2)),
        (f"{LOAD:g} kg that roll along, known", loaded, replace(whole, braked_share=loaded.robot.braked_share)),
        (f"{LOAD:g} kg that roll along, not known", loaded, whole),
        ("all terms, noise of a structured-light camera", replace(experiment, noise=True), whole),
        ("no voxel of clearance", replace(experiment, clearance=0.0), whole),
    ]  # fmt: skip
    chain = Chain(lat, times.calm, times.news, experiment.distance)
    found = []
    for name, which, braking in tries:
        speed = braking.largest_speed(experiment.distance)
        found.append(
            Term(name, speed, count_collisions(encounters(which, voxel), place_trials(which)[1], speed, chain))
        )
    return found
