# SPDX-License-Identifier: Apache-2.0
"""One cell of a store trained further: its own Gaussians on the pixels that show it, those around it standing still.

What comes out depends on what goes in and nothing else, so cells can be trained anywhere and in any order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ggslam.jobs.refine.cell_mapper import CellBox, CellMapper, CellView
from ggslam.jobs.refine.settings import RefineSettings
from ggslam.jobs.submaps.cell_gaussians import arrays_of_map, gaussians_from_bytes, gaussians_to_bytes, map_of_arrays
from ggslam.jobs.submaps.visit_records import recording_of
from ggslam.jobs.tasks.processors import own_threads
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.native.loader import NativeContext
from ggslam.runs.records.visit import VisitRecord
from ggslam.sequences import Sequence
from ggslam.submaps.cell_keys import CellKey


@dataclass(frozen=True)
class CellTask:
    """A cell to train, with all that this needs but the images.

    Attributes:
        key: of the cell.
        name: of the cell, for messages.
        box: what its Gaussians may not leave.
        own: its part with Gaussians.
        halo: the same of the Gaussians around it, with as many channels; empty: none.
        record: JSON of the `VisitRecord` that the cell is from.
        views: which of its keyframes may see the cell.
        settings: how.
    """

    key: CellKey
    name: str
    box: CellBox
    own: bytes
    halo: bytes
    record: str
    views: tuple[int, ...]
    settings: RefineSettings


@dataclass(frozen=True)
class TrainedCell:
    """A cell that was trained.

    Attributes:
        key: of the cell.
        data: its part with Gaussians.
        count: of them.
        views: keyframes that it was trained on; none: the cell is as it was.
        before, after: PSNR of the pixels that show it, before the first step and after the last one, mean in dB over
            the keyframes or some of them; NaN without steps.
    """

    key: CellKey
    data: bytes
    count: int
    views: int
    before: float = float("nan")
    after: float = float("nan")


def train_cell(task: CellTask) -> TrainedCell:
    """Trains a cell.

    Raises:
        GgslamError: its recording cannot be read, or its Gaussians are damaged.
    """
    rows, visit = gaussians_from_bytes(task.own, task.name)
    gaussians, own = map_of_arrays(rows, with_moments=True), len(rows["means"])
    if task.halo:
        halo = map_of_arrays(gaussians_from_bytes(task.halo, task.name)[0], with_moments=True)
        gaussians.append(halo.take(torch.arange(len(halo))))
    record = VisitRecord.parse(task.record, task.name)
    keyframes, views = _views(task, record, recording_of(task.record))
    if not keyframes or not task.settings.steps:
        return TrainedCell(task.key, task.own, own, 0)
    config, context = record.settings(), NativeContext(own_threads())
    mapper = CellMapper(
        gaussians, own, task.box, config.mapping, context, keyframes, views, config.fits_view_colors
    )  # fmt: skip
    seed = [task.settings.seed, *(place + 2**32 for place in task.key)]
    before, after = mapper.train(task.settings.steps, seed)
    trained = {name: values[:own] for name, values in arrays_of_map(mapper.map).items()}
    return TrainedCell(task.key, gaussians_to_bytes(trained, visit), own, len(keyframes), before, after)


def _views(task: CellTask, record: VisitRecord, sequence: Sequence) -> tuple[list[Keyframe], list[CellView]]:
    """Keyframes that show enough of the cell, and where they do."""
    keyframes, views = list[Keyframe](), list[CellView]()
    near = task.box.grow(task.settings.border)
    for number in task.views:
        known = record.keyframes[number]
        frame = sequence.frame(known.frame, masks=False)
        view = near.view(frame.depth, frame.camera, known.T_world_camera)
        if frame.valid is not None:
            view = CellView(view.shown & frame.valid, view.hidden | ~frame.valid)
        if view.shown.mean() < task.settings.share or not view.shown.any():
            continue
        keyframe = make_keyframe(len(keyframes), frame, known.T_world_camera)
        keyframe.exposure = known.known_exposure
        keyframes.append(keyframe)
        views.append(view)
    return keyframes, views
