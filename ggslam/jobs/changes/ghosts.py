# SPDX-License-Identifier: Apache-2.0
"""What a visit that began in an earlier map still shows of it, although its own depth looked through it.

A visit trains the earlier map further, and things that were carried away fade, but slowly: behind their last haze
nothing would be seen to have changed.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from ggslam.jobs.merge.sources import MergeSource
from ggslam.mapping.keyframe import ELSEWHERE
from ggslam.merging.coverage import PlacedRun
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, transform_points

_SIGMAS, _LEAST_M, _RELATIVE = 3.0, 0.02, 0.01
"""A Gaussian is looked through that lies nearer than what was measured by so many standard deviations of depth, and by
so many metres and so much of the distance."""
_TIMES = 2
"""Keyframes that look through it at least, and so many times as many as see something there."""
_AROUND = np.ones((3, 3), np.uint8)


def own_keyframes(record: KeyframesRecord) -> Sequence[int]:
    """Numbers of the keyframes of a run's own recording. A run that began in another's map has that one's, too: they
    saw what was there before. All of them if none is its own."""
    own = [number for number, keyframe in enumerate(record.keyframes) if keyframe.frame != ELSEWHERE]
    return own or range(len(record.keyframes))


def without_ghosts(source: MergeSource, placed: PlacedRun) -> GaussianMap:
    """The map of a run without Gaussians of the map it began with that its own keyframes look through. The map as it is
    if the run began with none, or its recording is not there.

    Args:
        source: the run.
        placed: its map, and where its keyframes are.
    """
    gaussians, sequence, noise = placed.gaussians, source.sequence, source.known.noise
    own = own_keyframes(source.record)
    if sequence is None or len(own) == len(source.record.keyframes):
        return gaussians
    rows = np.flatnonzero(~np.isin(gaussians.birth_keyframe.numpy(), own))
    means = gaussians.means.numpy()[rows].astype(np.float64)
    through, there = np.zeros(len(rows), int), np.zeros(len(rows), int)
    for k in own:
        frame = sequence.frame(source.record.keyframes[k].frame, masks=False)
        seen = transform_points(means, inverse(placed.T_world_camera[k]))
        row, column, inside = frame.camera.project(seen)
        # Where a pixel's surroundings have no depth, or show an edge, it looks through what is nearer than all of them.
        nearest = cv2.erode(np.where(frame.depth > 0, frame.depth, np.float32(0)), _AROUND)[row, column]
        measured = frame.depth[row, column]
        away = seen[:, 2]
        margin = np.maximum(_SIGMAS * (noise.constant + noise.square * away**2), _LEAST_M + _RELATIVE * away)
        through += inside & (nearest > 0) & (away < nearest - margin)
        there += inside & (measured > 0) & (np.abs(away - measured) <= margin)
    ghosts = rows[(through >= _TIMES) & (through >= _TIMES * there)]
    if not len(ghosts):
        return gaussians
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[torch.from_numpy(ghosts)] = False
    cleared = gaussians.copy(gaussians.device)
    cleared.keep(kept)
    return cleared
