# SPDX-License-Identifier: Apache-2.0
"""Training where the maps of several runs meet, on keyframes of all of them."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np

from ggslam.jobs.merge.sources import MergeSource, joint_config
from ggslam.jobs.merge.unseen_gaussians import UnseenGaussians
from ggslam.jobs.progress import Observer
from ggslam.mapping.finished import load_finished, train_by_turns
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, make_keyframe
from ggslam.merging.coverage import PlacedRun
from ggslam.merging.objects import UnitedObjects
from ggslam.native.loader import NativeContext
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.slam.parts import make_mapper


@dataclass(frozen=True)
class TrainedSeams:
    """Result of training at the seams.

    Attributes:
        keyframes: of all runs, as training left their poses and exposures.
        count: of those that were trained on.
        steps: that were made.
        notes: what the user should know.
    """

    keyframes: list[Keyframe]
    count: int
    steps: int
    notes: list[str]


def train_seams(
    sources: ListOf[MergeSource], placed: ListOf[PlacedRun], seams: ListOf[np.ndarray], gaussians: GaussianMap,
    objects: UnitedObjects, steps: int, context: NativeContext, observer: Observer,
) -> TrainedSeams:  # fmt: skip
    """Trains the map of several runs where they meet, on the keyframes whose recordings are there.

    Args:
        sources, placed: the runs, and where they are in the common world.
        seams: whether each run's keyframes are to be trained on, bool [K] each.
        gaussians: the map; changed.
        objects: of the map; changed where masks teach them.
        steps: optimisation steps.
        context: threads.
        observer: receives progress updates.
    """
    with_masks = objects.supervision == "masks"
    keyframes, seam = keyframes_of(sources, [run.T_world_camera for run in placed], seams, with_masks, objects)
    missing = [source for source in sources if source.sequence is None]
    notes = [f"{s.name}: not trained on, its recording is not there: {s.reason}" for s in missing]
    if not seam or not steps:
        return TrainedSeams(keyframes, 0, 0, notes)
    depth = float(np.median(np.concatenate([p[:, 2] for source in sources for p in source.known.points])))
    sigma = max(source.known.noise.sigma(depth) for source in sources)
    config = joint_config(sources, gaussians)
    mapper = make_mapper(replace(config, device="cpu"), with_masks, context, None)
    load_finished(mapper, gaussians, keyframes)
    mapper.depth_sigma = sigma
    if mapper.identity is not None:
        mapper.identity.resume(objects.classifier)
    unseen = UnseenGaussians(gaussians, [keyframes[k] for k in seam], sigma)
    observer.begin("train at the seams", steps)
    train_by_turns(mapper, seam, steps, config.seed, lambda _: unseen.restore(), observer.advance)
    if mapper.identity is not None:
        mapper.finish_identity()
        objects.classifier = mapper.identity.classifier
    return TrainedSeams(keyframes, len(seam), steps, notes)


def keyframes_of(
    sources: ListOf[MergeSource], poses: ListOf[np.ndarray], seam: ListOf[np.ndarray], with_masks: bool,
    objects: UnitedObjects,
) -> tuple[list[Keyframe], list[int]]:  # fmt: skip
    """The keyframes of all runs, and the numbers of those at the seams whose recording is there; they have images.

    Args:
        sources: the runs.
        poses: T_world_camera of each run's keyframes in the common world, float64 [K, 4, 4].
        seam: whether each of them is at a seam, bool [K].
        with_masks: whether objects are learned from the recordings' masks.
        objects: what the runs' object ids are called.
    """
    keyframes, trained = list[Keyframe](), list[int]()
    for number, source in enumerate(sources):
        table = _mask_table(objects.ids[number]) if with_masks else None
        for k, record in enumerate(source.record.keyframes):
            index, T, camera = source.first_keyframe + k, poses[number][k], source.known.cameras[k]
            no_color, no_depth = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.uint16)
            keyframe = Keyframe(index, FROM_EARLIER_RUN, float("nan"), camera, no_color, no_depth, inverse(T))
            if seam[number][k] and source.sequence is not None and record.frame != FROM_EARLIER_RUN:
                frame = source.sequence.frame(record.frame, masks=with_masks)
                mask = frame.mask if table is None or frame.mask is None else table[frame.mask]
                frame = replace(frame, index=source.first_frame + record.frame, mask=mask, instant=None)
                keyframe = make_keyframe(index, frame, T)
                trained.append(index)
            keyframe.exposure = record.known_exposure
            keyframes.append(keyframe)
    return keyframes, trained


def _mask_table(ids: dict[int, int]) -> np.ndarray:
    table = np.zeros(1 << 16, np.uint16)
    table[list(ids)] = list(ids.values())
    return table
