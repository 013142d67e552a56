# SPDX-License-Identifier: Apache-2.0
"""The end of a run: the final refinement, and the result."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.parts import device_name
from ggslam.slam.result import SlamResult
from ggslam.slam.run_state import RunState
from ggslam.slam.saved_places import saved_places_to_bytes
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.system.spent import part
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.still_camera import still_notes


@part("final refinement")
def refine(slam: RunState, progress: Callable[[int, int], None] | None = None) -> None:
    """The last optimisation steps of a run that has seen all frames.

    Args:
        slam: the run; one that was cut off in its refinement goes on with it.
        progress: is called now and then with the steps done and their number; it may raise, which ends the refinement.
    """
    slam.join_parts()
    mapper, start = slam.mapper, time.perf_counter() - slam.times.refinement
    before, begin, steps = mapper.times.iterations, slam.refine_iterations, slam.refinement_steps

    def count() -> None:
        slam.refine_iterations = begin + mapper.times.iterations - before
        slam.times.refinement = time.perf_counter() - start

    def note(done: int, total: int) -> None:
        count()
        if progress is not None:
            progress(done, total)

    try:
        if steps:
            if not begin:
                mapper.use_typical_exposure(at_end=True)
                slam.color_poses.align_keyframes()
                mapper.drop_hidden()
                mapper.judge_between()
            mapper.refine(steps, note, begin)
        slam.color_poses.align_last(lambda: note(steps, steps))
    finally:  # an interrupted refinement counts for what it did
        count()


def result_of(slam: RunState) -> SlamResult:
    """What there is so far. The first call settles the objects: it is for the end."""
    pager, parts = slam.pager, slam.parts
    slam.times.loops = slam.loops.seconds if slam.loops is not None else 0.0
    slam.mapper.end_refinement()
    slam.join_parts()
    with part("objects"):
        objects = slam.objects.finalize(slam.mapper, pager) if slam.growing else slam.objects.learned
    cells = None if pager is None else pager.move_all_out()
    gaussians = parts.gaussians()
    return SlamResult(
        gaussians, parts.keyframes(), parts.frames(), slam.times, slam.mapper.times, slam.dropped_frames,
        slam.refine_iterations, objects, parts.events(), _places(slam, gaussians, cells), cells,
        None if pager is None else pager.report(), _notes(slam), None if pager is None else pager.close,
        slam.steps.to_csv(), device_name(slam.map.device), slam.config, slam.movers.pixels,
        parts.movers(slam.movers.tracks.describe()),
    )  # fmt: skip


def _notes(slam: RunState) -> list[str]:
    """What the user should know of the run."""
    frames = len(slam.frames)
    still = still_notes(slam.tracker.state.still.frames, frames)
    budget = [] if slam.pager is None else slam.pager.budget.notes
    return [*slam.start_notes, *still, *slam.filters.notes(frames), *budget, *slam.end_notes]


def _places(slam: RunState, gaussians: GaussianMap, cells: GaussianCells | None) -> bytes | None:
    """Content of `places.npz`; None if the run looked for no loops and so remembers no places."""
    if slam.loops is None or not len(slam.surface):
        return None
    parts = [gaussians] if cells is None else (part for _, part in cells.parts())
    kept = slam.parts.kept_numbers()
    keyframes = [slam.mapper.keyframes[k] for k in kept]
    poses = np.stack([k.T_world_camera for k in keyframes])
    noise = slam.tracker.noise or DepthNoise()
    cameras = [k.camera for k in keyframes] if len(slam.cameras) > 1 else None
    return saved_places_to_bytes(
        slam.camera, slam.surface, slam.loops, noise, slam.scale, poses, parts, cameras, kept
    )  # fmt: skip
