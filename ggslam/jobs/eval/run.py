# SPDX-License-Identifier: Apache-2.0
"""Scores of a run: `metrics.json`, one line per frame in `frames.csv`, and a few pictures in `renders/`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import MissingDependency
from ggslam.evaluation.image_sets import RenderedView, score_images
from ggslam.evaluation.images import ImageScores
from ggslam.evaluation.lpips import Lpips
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.jobs.eval.objects import ObjectScorer
from ggslam.jobs.eval.rig import RigScores, shows_anything
from ggslam.jobs.eval.surface import SurfaceScorer
from ggslam.jobs.progress import Observer
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.exposure import identity_exposure, measure_exposure
from ggslam.rendering.types import RenderBuffers
from ggslam.reporting.pictures import color_to_uint8, compare_pictures, write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import Sequence
from ggslam.sequences.rig import RigSequence
from ggslam.slam.filters.camera_fixtures import CameraFixtures, find_fixtures
from ggslam.system.atomic import make_folder, write_text
from ggslam.system.csv_text import csv_text
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class ScoreTuning(Tuning):
    """What is written and noted beside the scores."""

    pictures = 6
    """Pictures in renders/, spread over the recording."""
    dark_level = 30
    """Mean colour, of 255, below which a note says that PSNR flatters dark images."""
    one_object_share = 0.85
    """Share of a map above which a note names the object that holds it."""
    fixture_frames = 48
    """Frames that are searched for what is fixed to the camera."""


def score_run(
    folder: RunFolder, sequence: Sequence, observer: Observer, lpips: bool = True, every: int = 1,
    masks: Path | None = None,
) -> MetricsRecord:  # fmt: skip
    """Scores a run against its recording and writes the results into the run folder.

    Args:
        folder: of the run.
        sequence: the recording, opened as the run opened it.
        observer: receives progress updates.
        lpips: score LPIPS too, if its weights are there.
        every: score the images of every n-th frame only.
        masks: where the masks of `sequence` come from, if they are not those that the run had; for the notes.

    Returns:
        What `metrics.json` holds.
    """
    with folder.change_files(MetricsRecord.FILE, "frames.csv", "renders"):
        return _score(folder, sequence, observer, lpips, every, masks)


def _score(
    folder: RunFolder, sequence: Sequence, observer: Observer, lpips: bool, every: int, masks: Path | None
) -> MetricsRecord:
    notes: list[str] = []
    metric = _lpips(notes) if lpips else None
    record = folder.keyframes()
    poses = record.poses()
    sets = _sets(folder, record, every)
    scorer = _object_scorer(folder, sequence, sets)
    rig = RigScores(sequence, sets) if isinstance(sequence, RigSequence) else None
    asked = sets if rig is None else {**sets, **rig.sets()}
    looked_at = _spread(poses, ScoreTuning.fixture_frames if rig is None else 0)
    fixtures = find_fixtures((sequence.frame(i) for i in looked_at), poses)
    surface = SurfaceScorer(folder)
    images = _images(folder, record, sequence, asked, scorer, metric, observer, fixtures, surface, notes)
    metrics = MetricsRecord.of({
        "trajectory": _trajectory(sequence, poses) if rig is None else rig.trajectory(poses),
        "images": {name: images[name] for name in sets},
        "segmentation": None if scorer is None else scorer.to_dict(),
        "surface": surface.scores(),
        "tracking": dict(Counter(f.status for f in record.frames)),
        **_performance(folder.timing()),
        "scored_every": every,
        "notes": [],
        **({} if rig is None else {"cameras": rig.of_cameras(poses, images)}),
    })  # fmt: skip
    if metrics.images.held_out is None or not metrics.images.held_out.frames:
        notes.append("no frame was held out; every score is over frames that the map was or could be trained on")
    notes.extend([surface.reason] if surface.reason else [])
    if len(poses) and max(poses) + 1 < len(sequence):
        notes.append(f"the run ends at frame {max(poses)} of {len(sequence)}; scores are of its part")
    if fixtures.mask is not None:
        share = fixtures.mask.mean()
        notes.append(f"{share:.0%} of every image is fixed to the camera; its pixels count as without depth")
    past = sum(part.frames for part in folder.sequence().parts or [] if part.past)
    if past:
        notes.append(f"images and objects of {quantity(past, 'frame')} of earlier visits are not scored: the map was "
                     "brought up to date since")  # fmt: skip
    lost = [f.frame for f in record.frames if f.is_lost]
    if lost:
        notes.append(f"no pose and no score for {quantity(len(lost), 'lost frame')}, the first: {lost[0]}")
    if metrics.trajectory is None:
        known = sequence.ground_truth is not None
        reason = "fewer than 3 frames have both poses" if known else "the recording has no ground-truth poses"
        reason = f"no true poses: {sequence.pose_problem}" if sequence.pose_problem else reason
        notes.append(f"{reason}; no trajectory scores")
    if edits := folder.mark().edits:
        notes.append(f"the map was edited ({'; '.join(edits)}); the recording was not, so edits count as errors")
    notes.extend(_one_object_notes(folder))
    notes.extend(_segmentation_notes(folder, metrics.segmentation is not None, masks))
    metrics = metrics.model_copy(update={"notes": notes})
    metrics.write(folder.path)
    return metrics


def _lpips(notes: list[str]) -> Lpips | None:
    try:
        return Lpips()
    except MissingDependency as missing:
        notes.append(f"LPIPS not scored: {missing}")
        return None


def _trajectory(sequence: Sequence, poses: dict[int, np.ndarray]) -> dict[str, Any] | None:
    if sequence.ground_truth is None:
        return None
    truth = sequence.ground_truth
    scores = score_trajectory([poses.get(i) for i in range(len(truth))], truth)
    return None if scores is None else asdict(scores)


def _sets(folder: RunFolder, record: KeyframesRecord, every: int) -> dict[str, set[int]]:
    """Frames that each kind of score is about."""
    keyframes = record.keyframe_numbers()
    evaluation = folder.config().evaluation
    recording = folder.sequence()
    every_nth = (i for i in range(max(record.poses(), default=-1) + 1) if i % every == 0)
    chosen = {i for i in every_nth if not recording.is_past(i)}
    held_out = {i for i in chosen if evaluation.is_held_out(recording.own_number(i)) and i not in keyframes}
    return {"keyframes": keyframes & chosen, "held_out": held_out, "all": chosen}


def _object_scorer(folder: RunFolder, sequence: Sequence, sets: dict[str, set[int]]) -> ObjectScorer | None:
    if not folder.has_objects():
        return None
    return ObjectScorer(ObjectsInParts.of(folder), sets, sequence.instance_names)


def _one_object_notes(folder: RunFolder) -> list[str]:
    """Whether objects by geometry did not tell things from the ground they lie on."""
    if not folder.has_objects():
        return []
    table = folder.object_table()
    counts = {record.id: record.gaussians for record in table.objects}
    largest = max(counts, key=counts.__getitem__, default=0)
    share = counts.get(largest, 0) / max(1, sum(counts.values()) + table.unlabelled_gaussians)
    if table.supervision != "geometry" or share <= ScoreTuning.one_object_share:
        return []
    return [f"object {largest} holds {share:.0%} of the map: geometry does not tell what lies flat from its ground; "
            "masks of a segmentation model do (masks.model)"]  # fmt: skip


def _segmentation_notes(folder: RunFolder, scored: bool, masks: Path | None) -> list[str]:
    """Which masks served as truth, or why there are no scores of objects."""
    if not folder.has_objects():
        return ["the run has no objects; the masks are not used"] if masks is not None else []
    if not scored and masks is not None:
        return [f"no scored frame has a mask in {masks}; objects are not scored"]
    if not scored:
        return ["the recording has no masks; objects are not scored (true masks from elsewhere: ggslam eval --masks)"]
    supervised = folder.object_table().supervision in ("masks", "associated masks")
    own = folder.sequence().open.masks
    same = masks is None or (own is not None and Path(own).resolve() == masks.resolve())
    if supervised and same:
        return ["objects are scored against the masks that supervised the map: this tells how well they were learned, "
                "not how true they are (true masks from elsewhere: ggslam eval --masks)"]  # fmt: skip
    return [f"objects are scored against the masks in {masks}" if masks else
            "objects are scored against the masks of the recording, which did not supervise the map"]  # fmt: skip


def _images(
    folder: RunFolder, record: KeyframesRecord, sequence: Sequence, sets: dict[str, set[int]],
    scorer: ObjectScorer | None, lpips: Lpips | None, observer: Observer, fixtures: CameraFixtures,
    surface: SurfaceScorer, notes: list[str],
) -> dict[str, Any]:  # fmt: skip
    poses = record.poses()
    keyframes, held_out = sets["keyframes"], sets["held_out"]
    pictured = set(_spread(poses, ScoreTuning.pictures))
    make_folder(folder.path / "renders")
    typical = record.typical_exposure() if any(k.is_exposed for k in record.keyframes) else None
    show = _shower(folder, sequence, poses, pictured, scorer, typical)
    rows: list[dict[str, Any]] = []
    brightness: list[float] = []
    observer.begin("score", len(sequence))

    def note(frame: Frame, scores: ImageScores | None) -> None:
        brightness.append(float(frame.color.mean()))
        observer.advance(frame.index + 1, len(sequence))
        if frame.index in poses:
            surface.add(frame, poses[frame.index])
        kind = "keyframe" if frame.index in keyframes else "held_out" if frame.index in held_out else "other"
        rows.append({"frame": frame.index, "kind": kind, **(scores or ImageScores()).to_dict()})

    frames = _up_to(max(poses, default=-1), sequence, masks=scorer is not None and sequence.has_masks)
    if isinstance(sequence, RigSequence):
        frames = (frame for frame in frames if shows_anything(frame))
    means = score_images(show, map(fixtures.clean, frames), sets, lpips, note)
    observer.advance(len(sequence), len(sequence))
    _write_rows(folder, rows)
    usual = float(np.median(brightness or [255]))
    if usual < ScoreTuning.dark_level:
        notes.append(f"the images are dark (mean colour {usual:.0f} of 255), and every error is small against white: "
                     "do not compare PSNR with that of other recordings")  # fmt: skip
    return {name: mean.to_dict() for name, mean in means.items()}


def _spread(poses: dict[int, np.ndarray], count: int) -> list[int]:
    """Frames with a pose, no more than `count`, spread evenly."""
    rows = np.linspace(0, len(poses) - 1, min(count, len(poses))).round().astype(int)
    return [int(frame) for frame in np.array(sorted(poses), int)[rows]]


def _up_to(last: int, sequence: Sequence, masks: bool) -> Iterator[Frame]:
    """Frames 0 to `last`: a run that stopped early is not asked about what it never saw, least of all about the damaged
    frame that stopped it."""
    if last < 0:
        return
    for frame in sequence.stream(masks="unshared" if masks else False):
        yield frame
        if frame.index >= last:
            return


def _shower(
    folder: RunFolder, sequence: Sequence, poses: dict[int, np.ndarray], pictured: set[int],
    scorer: ObjectScorer | None, typical: np.ndarray | None,
) -> Callable[[Frame], RenderedView | None]:  # fmt: skip
    """A function that renders the map as a frame's camera sees it, and keeps some of the pictures. If the exposure
    changed, which is on the whole `typical` against the map's [3], it measures that of each frame."""
    parts = folder.map_in_parts() if scorer is None else scorer.map
    rasterizer = CpuRasterizer()

    def show(frame: Frame) -> RenderedView | None:
        if frame.index not in poses:
            return None
        T_camera_world = inverse(poses[frame.index])
        gaussians = parts.in_view(frame.camera, T_camera_world)
        by_3dgs = _picture(rasterizer.forward(gaussians, frame.camera, T_camera_world, features=False, as_3dgs=True))
        view = rasterizer.forward(gaussians, frame.camera, T_camera_world, features=scorer is not None)
        depth = np.where(view.alpha.numpy() > 0.5, view.expected_depth.numpy(), 0)
        row = None
        if scorer is not None:
            drawn = sequence.frame(frame.index) if frame.index in pictured else None
            row = scorer.add(frame, rasterizer, view, T_camera_world, drawn)
        if frame.index in pictured:
            picture = compare_pictures(frame.color, color_to_uint8(view.image.numpy()), frame.depth, depth, row)
            write_picture(folder.path / "renders" / f"compare{frame.index:06d}.png", picture)
        exposure = None
        if typical is not None:
            measured = measure_exposure(frame.color, frame.depth, view.image.numpy(), view.alpha.numpy(), depth)
            exposure = identity_exposure() if measured is None else measured
        usual = np.ones(3) if typical is None else typical
        return RenderedView(_picture(view), depth, by_3dgs, exposure, usual)

    return show


def _picture(view: RenderBuffers) -> np.ndarray:
    return np.clip(view.image.numpy(), 0, 1).transpose(1, 2, 0)


def _write_rows(folder: RunFolder, rows: list[dict[str, Any]]) -> None:
    text = csv_text(list(rows[0]), (list(row.values()) for row in rows)) if rows else ""
    write_text(folder.path / "frames.csv", text)


def _performance(timing: TimingRecord) -> dict[str, Any]:
    iterations = timing.mapping.iterations - timing.refine_iterations
    return {
        "speed": {
            "frames_per_s": timing.frames_per_s, "tracking_ms": timing.tracking_ms_per_frame,
            "mapping_iteration_ms": timing.mapping_ms_per_iteration,
            "iterations_per_frame": iterations / max(1, timing.frames),
            "dropped_frames": len(timing.dropped_frames), "refinement_s": timing.refinement_s,
        },
        "map": {"gaussians": timing.gaussians, "keyframes": timing.mapping.keyframes},
        "memory": {"peak_rss_mb": timing.peak_rss_mb},
    }  # fmt: skip
