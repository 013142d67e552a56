# SPDX-License-Identifier: Apache-2.0
"""Settings drawn from their declared ranges, and a short run with them."""

from __future__ import annotations

import math
import typing
from collections.abc import Sequence
from typing import Any

import numpy as np

from ggslam.errors import GgslamError
from ggslam.scene.frame import Frame
from ggslam.slam.config import Config
from ggslam.slam.slam import Slam
from ggslam.system.settings import Known, walk
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.tsdf import TsdfMap

UNTOUCHED = (
    "masks.onnx.", "paging.", "memory_limit_mb", "realtime_fps", "device", "edges_planes.device", "masks.model"
)  # fmt: skip
"""Without effect in a short run on the CPU, or with effect on its time only."""
MOST = {
    "threads": 4, "refine_iterations": 3, "mapping.iterations_per_frame": 3, "mapping.first_frame_iterations": 3,
    "loops.repair_iterations": 5, "loops.neighbourhood": 10, "loops.candidates": 10,
    "loops.places.tables": 12, "loops.places.entries": 10**5, "loops.places.ferns": 1000,
    "loops.places.features.count": 2000, "loops.verification.registration.hypotheses": 1000,
    "tracking.recovery.features.count": 2000, "tracking.align.coarse_iterations": 20,
    "tracking.align.fine_iterations": 20,
    "edges_planes.align.outer_iterations": 5, "edges_planes.align.inner_iterations": 5,
    "edges_planes.map.slots": 1 << 18, "identity.final_passes": 2, "identity.pixels": 10**4,
    "identity.neighbours.samples": 2000, "identity.neighbours.neighbours": 20,
}  # fmt: skip
"""Upper bounds of what costs time or memory."""
LEAST = {"volumes.tsdf.voxel": 0.02}
"""Lower bounds, likewise."""


def draw_value(one: Known, rng: np.random.Generator) -> Any:
    """A value of a setting: an end of its range, something in between, or something near the default."""
    if one.kind is bool:
        return bool(rng.integers(2))
    if one.choices:
        return one.choices[rng.integers(len(one.choices))]
    low, high = one.declaration.low, one.declaration.high
    assert low is not None and high is not None
    low, high = max(low, LEAST.get(one.path, low)), min(high, MOST.get(one.path, high))
    kind, share = rng.integers(4), float(rng.random())
    if kind == 0:
        value = low if share < 0.5 else high
    elif kind == 1 or low < 0:
        value = low + share * (high - low)
    elif kind == 2:
        least = math.log(max(low, high * 1e-9))
        value = math.exp(least + share * (math.log(high) - least))
    else:
        value = min(max((one.default or low) * 10 ** (2 * share - 1), low), high)
    if int in (one.kind, *typing.get_args(one.kind)):
        value = min(max(round(value), low), high)
    return 1 << (int(value).bit_length() - 1) if one.path == "edges_planes.map.slots" else value


def draw(seed: int, count: int) -> dict[str, Any]:
    """Names and values of some settings that do not contradict one another."""
    rng = np.random.default_rng(seed)
    able = (one for one in walk(Config) if one.is_number or one.choices or one.kind is bool)
    known = [one for one in able if not one.path.startswith(UNTOUCHED)]
    while True:
        chosen = {known[i].path: draw_value(known[i], rng) for i in rng.choice(len(known), count, replace=False)}
        own = any(path.startswith("edges_planes.") for path in chosen)
        chosen.setdefault("tracker", "edges_planes" if own else "gicp")
        try:
            configure(chosen)
        except GgslamError:
            continue  # two of them contradict each other
        return chosen


def configure(chosen: dict[str, Any]) -> Config:
    """The settings with these values."""
    values: dict[str, Any] = {}
    for path, value in chosen.items():
        *groups, name = path.split(".")
        inner = values
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[name] = value
    few = {"mapping": {"iterations_per_frame": 1, "first_frame_iterations": 2}, "identity": {"final_passes": 1}}
    return Config(**{**values, **{group: {**least, **values.get(group, {})} for group, least in few.items()}})  # type: ignore[arg-type]


def run(frames: Sequence[Frame], config: Config) -> None:
    """A short run and its volumes; raises whatever the settings lead to."""
    slam = Slam(frames[0].camera, config)
    for frame in frames:
        slam.step(frame)
    result = slam.finish()
    assert len(result.frames) == len(frames)
    tsdf = TsdfMap(config.volumes.tsdf)
    for frame in frames[:3]:
        assert frame.T_world_camera is not None
        tsdf.integrate(frame.depth, frame.camera, frame.T_world_camera)
    tsdf.decay()
    DistanceField(tsdf, config.volumes.esdf).update()
