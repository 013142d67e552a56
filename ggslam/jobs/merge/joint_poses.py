# SPDX-License-Identifier: Apache-2.0
"""Brings several runs into one world: the poses of their keyframes, and their maps."""

from __future__ import annotations

from collections.abc import Callable

from ggslam.errors import ConfigError
from ggslam.jobs.merge.sources import MergeSource
from ggslam.jobs.progress import Observer
from ggslam.merging.common_ground import CommonGround, find_common_ground
from ggslam.merging.coverage import PlacedRun
from ggslam.merging.joint_graph import JointPoses, Pair, attachment_order, solve_joint_graph
from ggslam.merging.joint_map import move_map, with_channels
from ggslam.merging.settings import MergeSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.identity import IDENTITY_CHANNELS


def find_joint_poses(
    sources: list[MergeSource], settings: MergeSettings, context: NativeContext, observer: Observer,
    lap: Callable[[str], None] = lambda part: None,
) -> JointPoses:  # fmt: skip
    """Common ground of all pairs of runs, and where their keyframes are by it.

    Args:
        sources: the runs; the first one's world is that of all.
        settings: see there.
        context: threads.
        observer: receives progress updates.
        lap: is told the parts that were done: "ground" and "graph".

    Raises:
        ConfigError: a run has too little in common with the others.
        MissingDependency: gtsam is not installed.
    """
    runs = [source.known for source in sources]
    needed = min(settings.confirmations, *(len(run) for run in runs))
    grounds: dict[Pair, CommonGround] = {}
    for b in range(1, len(runs)):
        for a in range(b):
            observer.begin(f"common ground of {a + 1} and {b + 1}", min(len(runs[b]), settings.queries))
            grounds[a, b] = find_common_ground(runs[a], runs[b], settings, context, observer.advance)
    lap("ground")
    order = attachment_order(len(runs), grounds, needed)
    joined = {0, *(new for _, new in order)}
    for alone in range(len(runs)):
        if alone not in joined:
            raise ConfigError(_refusal(sources, alone, joined, grounds, needed))
    poses = solve_joint_graph(runs, grounds, order, needed, settings)
    lap("graph")
    return poses


def _refusal(
    sources: list[MergeSource], alone: int, joined: set[int], grounds: dict[Pair, CommonGround], needed: int
) -> str:
    """Why a run cannot be placed, by the run that has most in common with it."""
    tried = {other: grounds[min(alone, other), max(alone, other)] for other in joined}
    other = max(tried, key=lambda k: (len(tried[k].agreeing), len(tried[k].links), tried[k].score))
    return f"{sources[alone].name}: no common ground with {sources[other].name}: {tried[other].verdict(needed)}"


def place_maps(sources: list[MergeSource], poses: JointPoses) -> list[PlacedRun]:
    """Reads the maps of the runs, and brings them into the common world, with the same channels."""
    for source in sources:
        source.read_map()
    degree = max(source.gaussians.sh_degree for source in sources)
    channels = IDENTITY_CHANNELS if any(source.objects is not None for source in sources) else 0
    placed = []
    for source, T_new_old in zip(sources, poses.T_new_old, strict=True):
        move_map(source.gaussians, T_new_old)
        source.gaussians = with_channels(source.gaussians, degree, channels)
        placed.append(PlacedRun(source.gaussians, source.known.cameras, T_new_old @ source.known.keyframe_poses))
    return placed
