# SPDX-License-Identifier: Apache-2.0
"""Joins the parts of a run at its end. Parts with places in common become one; the result is the largest.

Parts that nothing joins lie at arbitrary places. They must not be in one map, nor in one trajectory: the largest stays,
in a world that begins with its first keyframe; the frames of the others count as lost.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import torch

from ggslam.loops.agreement import GroundLink
from ggslam.loops.parts import KeyframeParts
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.mapper import Mapper
from ggslam.movers.mover_table import FoundMover
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.loop_results import LoopEvent
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.result import TrackedFrame
from ggslam.system.savable import savable
from ggslam.tracking.tracker import TrackingStatus

NOT_JOINED = "of a part of the recording that could not be joined"
PART_EVENTS = ("new part", "left out")


@savable(not_saved="_mapper _poses _corrections _loops")
class MapParts:
    """Joins the parts of a run.

    Args:
        mapper: whose map they are in.
        poses: of the frames.
        corrections: of the map.
        loops: knows the parts, and finds what joins them; None: there is one part.
    """

    def __init__(
        self, mapper: Mapper, poses: FramePoses, corrections: MapCorrections, loops: LoopCloser | None
    ) -> None:
        self._mapper, self._poses, self._corrections, self._loops = mapper, poses, corrections, loops

    def join_parts(self) -> None:
        """Joins the parts of the map after the last frame, where they have places in common."""
        loops = self._loops
        if loops is None or self._mapper.left_out or len(loops.parts.all()) < 2:
            return
        links, refused = loops.common_places(), set[tuple[int, int]]()
        while (pair := _next_pair(loops.parts, links, refused)) is not None:
            correction = loops.join(*pair, links)
            if correction is None:
                refused.add(pair)
            else:
                self._corrections.apply(correction, loops)
        if len(loops.parts.all()) > 1:
            self._keep_largest(loops)

    def _keep_largest(self, loops: LoopCloser) -> None:
        kept, frames = loops.parts.members(self._largest(loops)), self._poses.frames
        gone = [k for k, frame in enumerate(frames) if _is_located(frame) and frame.keyframe not in kept]
        for begin, end in _stretches(gone):
            first, last = frames[begin].frame_index, frames[end].frame_index
            name = loops.parts.name(loops.parts.members(frames[begin].keyframe))
            which = f"frames {first}-{last} are {name}, which" if last > first else f"frame {first} is {name}, which"
            reason = f"{which} could not be joined to the rest: no place of it was seen again"
            loops.events.append(LoopEvent("left out", first, frames[begin].keyframe, -1, reason))
        left = set(gone)
        self._poses.frames = [
            replace(frame, status=TrackingStatus.LOST.value, reason=NOT_JOINED) if k in left else frame
            for k, frame in enumerate(frames)
        ]
        self._mapper.leave_out(set(range(len(loops))) - kept)
        first_kept = min(kept)
        if first_kept > 0:  # the world is its first keyframe's camera
            self._corrections.move_world(inverse(self._mapper.keyframes[first_kept].T_world_camera), loops)

    def _largest(self, loops: LoopCloser) -> int:
        """The part with the most frames, the oldest of several; but a map that the run began with is never left."""
        if any(keyframe.frame_index == FROM_EARLIER_RUN for keyframe in self._mapper.keyframes):
            return 0
        located = [frame.keyframe for frame in self._poses.frames if _is_located(frame)]
        counts = Counter(loops.parts.of[keyframe] for keyframe in located if keyframe < len(loops))
        return min(counts, key=lambda part: (-counts[part], part), default=0)

    def kept_numbers(self) -> list[int]:
        """Numbers of the keyframes that are the result."""
        return [k for k in range(len(self._mapper.keyframes)) if k not in self._mapper.left_out]

    def keyframes(self) -> list[Keyframe]:
        """Those that are the result, numbered as there are no others."""
        keyframes, kept = self._mapper.keyframes, self.kept_numbers()
        if len(kept) == len(keyframes):
            return keyframes
        return [_with_number(keyframes[k], number) for number, k in enumerate(kept)]

    def frames(self) -> list[TrackedFrame]:
        """The frames, which hang on these keyframes."""
        frames, numbers = self._poses.frames, self._numbers()
        return frames if numbers is None else [replace(f, keyframe=int(numbers[f.keyframe])) for f in frames]

    def events(self) -> list[LoopEvent]:
        """What happened to these keyframes, and which were left out."""
        events = [] if self._loops is None else self._loops.events
        numbers = self._numbers()
        if numbers is None:
            return events
        left_out, told = self._mapper.left_out, []
        for event in events:
            ends = (event.keyframe, event.old_keyframe)
            if event.kind in PART_EVENTS:
                told.append(replace(event, keyframe=-1, old_keyframe=-1))
            elif left_out.isdisjoint(ends):
                told.append(replace(event, keyframe=int(numbers[ends[0]]), old_keyframe=int(numbers[ends[1]])))
        return told

    def gaussians(self) -> GaussianMap:
        """The map in the host's memory, whose Gaussians know the number of the keyframe that inserted them."""
        gaussians, numbers = self._mapper.map.to(torch.device("cpu")), self._numbers()
        if numbers is None:
            return gaussians
        gaussians = copy.deepcopy(gaussians)
        birth = gaussians.birth_keyframe.long()
        found = torch.from_numpy(numbers)[birth.clamp(min=0)]
        gaussians.birth_keyframe[:] = torch.where(birth < 0, birth, found).to(gaussians.birth_keyframe.dtype)
        return gaussians

    def movers(self, found: list[FoundMover]) -> list[FoundMover]:
        """Of the movers that were found those that a frame of the result shows."""
        lost = {f.frame_index for f in self._poses.frames if f.reason == NOT_JOINED}
        return [mover for mover in found if lost.isdisjoint(sight.frame for sight in mover.sights)]

    def _numbers(self) -> np.ndarray | None:
        """By the number of a keyframe in the run that of the last one of the result up to it; None: they are the
        same."""
        left_out = self._mapper.left_out
        if not left_out:
            return None
        stays = np.array([k not in left_out for k in range(len(self._mapper.keyframes) + 1)])
        return np.maximum(np.cumsum(stays) - 1, 0)


def _next_pair(
    parts: KeyframeParts, links: Sequence[GroundLink], refused: set[tuple[int, int]]
) -> tuple[int, int] | None:
    """The two parts with the most places in common, the older one first, that were not refused."""
    ends = (sorted((parts.of[link.old], parts.of[link.new])) for link in links)
    counts = Counter((older, younger) for older, younger in ends if older != younger)
    return next((pair for pair, _ in counts.most_common() if pair not in refused), None)


def _is_located(frame: TrackedFrame) -> bool:
    return frame.status != TrackingStatus.LOST.value


def _stretches(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """First and last of each run of successive numbers, which rise."""
    if not numbers:
        return []
    edges = np.flatnonzero(np.diff(numbers) > 1)
    firsts, lasts = [0, *(edges + 1)], [*edges, len(numbers) - 1]
    return [(numbers[a], numbers[b]) for a, b in zip(firsts, lasts, strict=True)]


def _with_number(keyframe: Keyframe, number: int) -> Keyframe:
    """A keyframe with another number, in the host's memory."""
    values = {of.name: getattr(keyframe, of.name) for of in fields(Keyframe)}
    return Keyframe(**{**values, "index": number, "archive": None})
