# SPDX-License-Identifier: Apache-2.0
"""Grades each aspect of a run in `verdict.json` as good, doubtful or bad.

Every limit stands here, with what it was set by. They were set between what runs of sound recordings (walks with
Kinect, RealSense, HoloLens and an iPhone, rendered and generated rooms, at full and half size) and runs of faulty ones
(wrong depth scale, depth of another frame, of another kind or not registered, mirrored images, full-scale pixels)
measure; docs/evaluate.md has the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.jobs.run.map_fit import MapFit
from ggslam.objects.table import ObjectTable
from ggslam.runs.records.verdict import AspectRecord, Grade, worst
from ggslam.sequences.verdicts import Verdict
from ggslam.slam.result import SlamResult
from ggslam.slam.verdicts import VerdictTuning
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.tracking.tracker import TrackingStatus


class TrackingGradeTuning(Tuning):
    """When tracking is doubtful or bad."""

    max_lost = 0.5
    """Share of frames lost above which the run is no result and `ggslam run` exits with code 1."""
    bad_lost = 0.3
    """Share of frames lost or doubted that is bad. Hand-held walks lose up to 15 % and are sound; images rotated
    against their depth lose 60 to 75 %."""
    max_searched = 0.5
    """Share of frames located from another start than constant velocity, above which the motion is at the limit."""
    jump_medians = 15.0
    """The path jumps where its step changes by this many median changes..."""
    jump_p90s = 7.5
    """...by this many 90th percentiles of the changes..."""
    jump_m = 0.05
    """...and by this many metres. True paths reach 12 medians and 6.2 percentiles."""
    min_frames = 3
    """Fewest frames that show whether a run is good: a first frame alone fits anything."""


class MapGradeTuning(Tuning):
    """When a map is doubtful or bad."""

    bad_structure = 0.9
    """SSIM at 160 pixels of width, over what image noise allows, below which a map is bad. Depth that is one frame off
    has 0.87, mirrored images 0.68."""
    doubtful_structure = 0.95
    """The same, below which it is doubtful. Sound runs have 0.93 to 1."""
    doubtful_brightness = 1.5
    """Ratio of brightness between map and keyframes that is doubtful."""
    bad_brightness = 2.5
    """The ratio that is bad. A map with the exposure of a dark first frame is off by a factor of 6."""
    overfit_db = 8.0
    """PSNR of keyframes over that of held-out frames, in dB, that shows overfitting. Whole recordings have 0 to 3, 16
    frames of a rig 6."""
    bad_depth_agreement = 0.9
    """Share of pixels at the measured depth below which a map is bad. Unregistered depth has 0.90."""
    doubtful_depth_agreement = 0.95
    """The same, below which it is doubtful. Sound runs have 0.95 to 1."""
    located_structure = (0.87, 0.82)
    """Doubtful and bad structure of frames that were only located in a map. Kinect and HoloLens have 0.95 and 0.91,
    exchanged colour channels 0.77."""
    located_depth_agreement = (0.85, 0.75)
    """Doubtful and bad depth agreement of such frames. Kinect and HoloLens have 0.94 and 0.91."""


class ObjectGradeTuning(Tuning):
    """When objects and movers are doubtful or bad."""

    doubtful_object_share = 0.5
    """Share of the Gaussians in one object that is doubtful: it joins several things."""
    bad_object_share = 0.9
    """The share that is bad: it joins everything."""
    doubtful_id_accuracy = 0.8
    """Share of pixels with the object of the masks below which ids are doubtful."""
    bad_id_accuracy = 0.5
    """The share below which they are bad."""
    min_moving_frames = 0.5
    """Share of frames with movers above which movers are judged; a person in view reaches it."""
    doubtful_movers = 0.25
    """New movers for each moving frame that are doubtful: noise. Real ones reach 0.05."""
    bad_movers = 0.75
    """The number that is bad. Warped depth has 0.4 to 0.5, depth of a wrong scale 1."""
    bad_moving_share = 0.5
    """Mean share of the image that moves, above which the pose or depth is wrong, not the world."""


OF_RECORDING = {
    "color_noise": "the colour images show noise", "unrelated": "colour and depth do not belong together",
    "color_repeats": "colour repeats while depth moves on",
}  # fmt: skip
"""What is wrong with colour, by code of the verdict on the recording; whatever map is made of it fits it well."""


@dataclass(frozen=True)
class ScoredFigures:
    """Figures that only scoring provides.

    Attributes:
        overfit_db: PSNR of keyframes over that of held-out frames, exposure forgiven; None: no frame was held out.
        id_accuracy: share of the pixels whose object is the masks'; None: there are no masks.
    """

    overfit_db: float | None = None
    id_accuracy: float | None = None


def grade_tracked(result: SlamResult, found: list[Verdict], stopped: bool = False) -> AspectRecord:
    """Whether the camera was located, from the frames' states, the path, and what `judge` found; `stopped`: the run
    ended before the recording did."""
    total, states = len(result.frames), [frame.status for frame in result.frames]
    lost, doubted, searched = (
        states.count(s.value) for s in (TrackingStatus.LOST, TrackingStatus.DOUBTED, TrackingStatus.RECOVERED)
    )
    jumps, dropped = path_jumps(result), len(result.dropped_frames)
    codes = {verdict.code for verdict in found}
    grades: list[Grade] = [
        _at_most((lost + doubted) / max(1, total), VerdictTuning.lost_share, TrackingGradeTuning.bad_lost),
        "doubtful"
        if searched > TrackingGradeTuning.max_searched * total or len(jumps) or codes & {"degenerate", "dropped"}
        else "good",
        "bad" if codes & {"textureless", "depth_noise"} else "good",
        "doubtful"
        if stopped or total < TrackingGradeTuning.min_frames or codes & {"no_motion", "both_repeat"}
        else "good",
    ]
    words = [f"{total - lost} of {quantity(total, 'frame')} located"]
    words += [f"{searched} of them by search"] if searched else []
    words += [f"{doubted} against what the image shows"] if doubted else []
    words += ["nothing in view tells the motion"] if "textureless" in codes else []
    words += ["most with an open direction"] if "degenerate" in codes else []
    words += [f"the path jumps {len(jumps)} times (the first: frame {jumps[0]})"] if jumps else []
    words += [f"{quantity(dropped, 'frame')} dropped"] if dropped else []
    words += ["the depth images show noise"] if "depth_noise" in codes else []
    words += ["both streams hang"] if "both_repeat" in codes else []
    one = ["too few to tell"] if total < TrackingGradeTuning.min_frames else ["one frame shows no motion"]
    words += one if total < TrackingGradeTuning.min_frames or "no_motion" in codes else []
    words += ["stopped before the end of the recording"] if stopped else []
    return _aspect(grades, 100 * (total - lost) / max(1, total), "%", words)


def path_jumps(result: SlamResult) -> list[int]:
    """Frames at which the path leaves its own course, by index. None of a rig, whose frames are of several cameras."""
    if any(keyframe.camera_number for keyframe in result.keyframes):
        return []
    return jumps_of(result.trajectory()[:, :3, 3], np.array([frame.frame_index for frame in result.frames]))


def jumps_of(places: np.ndarray, index: np.ndarray) -> list[int]:
    """As `path_jumps`, of places [n, 3] in metres, NaN where unknown, and their frames' indices [n]."""
    if len(places) < 5:
        return []
    changes = np.linalg.norm(places[2:] - 2 * places[1:-1] + places[:-2], axis=1)
    changes[(index[2:] - index[:-2]) != 2] = np.nan
    if not np.isfinite(changes).any():
        return []
    limit = max(
        TrackingGradeTuning.jump_medians * np.nanmedian(changes),
        TrackingGradeTuning.jump_p90s * np.nanpercentile(changes, 90),
        TrackingGradeTuning.jump_m,
    )
    return [int(i) for i in index[2:][np.nan_to_num(changes) > limit]]


def grade_sharp(
    fit: MapFit | None, scored: ScoredFigures, found: list[Verdict] | None = None, unrefined: bool = False
) -> AspectRecord:
    """Whether the map looks like the keyframes, and these like the place; `found`: what seems wrong with them;
    `unrefined`: the final refinement was cut short."""
    if fit is None:
        return AspectRecord(text="no keyframe of this run to compare with")
    limits = (
        MapGradeTuning.located_structure
        if fit.located
        else (MapGradeTuning.doubtful_structure, MapGradeTuning.bad_structure)
    )
    off = max(fit.brightness, 1 / max(fit.brightness, 1e-6))
    overfit = scored.overfit_db is not None and scored.overfit_db > MapGradeTuning.overfit_db
    grades: list[Grade] = [
        _at_least(fit.structure, *limits),
        _at_most(off, MapGradeTuning.doubtful_brightness, MapGradeTuning.bad_brightness),
        "doubtful" if overfit or unrefined else "good",
    ]  # fmt: skip
    codes = {verdict.code for verdict in found or []} & OF_RECORDING.keys()
    grades += ["doubtful" if codes == {"color_repeats"} else "bad"] if codes else []
    words = [f"{fit.psnr:.1f} dB, {fit.structure:.1%} of the structure that image noise leaves"]
    if off > MapGradeTuning.doubtful_brightness:
        words.append(f"the map is {fit.brightness:.2f} times as bright as they are")
    words += [f"held-out frames are {scored.overfit_db:.1f} dB worse"] if overfit else []
    words += ["the map looks otherwise than the frames"] if fit.located and fit.structure < limits[0] else []
    words += ["the refinement was cut short"] if unrefined else []
    words += [text for code, text in OF_RECORDING.items() if code in codes]
    return _aspect(grades, fit.psnr, "dB", words)


def grade_geometry(fit: MapFit | None, found: list[Verdict]) -> AspectRecord:
    """Whether the map's depth is the measured one."""
    if fit is None:
        return AspectRecord(text="no keyframe of this run to compare with")
    wrong = [v for v in found if v.severity == "wrong" and v.code in ("depth_scale", "intrinsics", "mirrored")]
    odd = [v for v in found if v.severity == "doubtful" and v.code in ("intrinsics", "depth_repeats")]
    doubts: list[Grade] = ["bad" if wrong else "doubtful" if odd else "good"]
    limits = (
        MapGradeTuning.located_depth_agreement
        if fit.located
        else (MapGradeTuning.doubtful_depth_agreement, MapGradeTuning.bad_depth_agreement)
    )
    grades = [_at_least(fit.agreeing, *limits), *doubts]
    words = [f"{fit.agreeing:.1%} of the pixels at the measured depth, half within {fit.depth_error:.2%}"]
    words += ["the world comes out in another size or shape"] if wrong else []
    words += ["depth repeats while colour moves on"] if any(v.code == "depth_repeats" for v in odd) else []
    words += ["the intrinsics are doubtful"] if not wrong and any(v.code == "intrinsics" for v in odd) else []
    return _aspect(grades, 100 * fit.agreeing, "%", words)


def grade_objects(table: ObjectTable | None, scored: ScoredFigures) -> AspectRecord:
    """Whether there are objects that tell things apart; `table`: None: the run has none."""
    if table is None:
        return AspectRecord(text="none were learned")
    counts = [record.gaussians for record in table.objects]
    if not counts:
        return _aspect(["bad"], 0, "objects", ["none, though they were looked for"])
    share = max(counts) / (sum(counts) + table.unlabelled_gaussians)
    grades = [_at_most(share, ObjectGradeTuning.doubtful_object_share, ObjectGradeTuning.bad_object_share)]
    number = quantity(len(counts), "object")
    words = [f"{number}, the largest has {share:.0%} of the Gaussians"]
    if scored.id_accuracy is not None:
        grades.append(
            _at_least(scored.id_accuracy, ObjectGradeTuning.doubtful_id_accuracy, ObjectGradeTuning.bad_id_accuracy)
        )
        words.append(f"{scored.id_accuracy:.0%} of the pixels labelled as the masks are")
    return _aspect(grades, len(counts), "objects", words)


def grade_movers(result: SlamResult) -> AspectRecord:
    """Whether what was found to move can have moved."""
    if result.config is not None and not result.config.movers.enabled:
        return AspectRecord(text="not looked for")
    shares = moving_shares(result)
    frames, total = len(shares), len(result.frames)
    if not frames:
        return _aspect(["good"], 0, "%", ["nothing moves"])
    rate, picture = len(result.movers) / frames, float(np.mean(shares))
    often = frames > ObjectGradeTuning.min_moving_frames * total
    grades: list[Grade] = [
        _at_most(rate, ObjectGradeTuning.doubtful_movers, ObjectGradeTuning.bad_movers) if often else "good",
        "bad" if often and picture > ObjectGradeTuning.bad_moving_share else "good",
    ]
    movers = quantity(len(result.movers), "mover")
    words = [f"{movers} in {frames} of {quantity(total, 'frame')}, {picture:.1%} of the image there"]
    return _aspect(grades, 100 * frames / max(1, total), "%", words)


def moving_shares(result: SlamResult) -> list[float]:
    """Share of the image that shows movers, of each frame that does."""
    shares: dict[int, float] = {}
    for mover in result.movers:
        for sight in mover.sights:
            shares[sight.frame] = shares.get(sight.frame, 0.0) + sight.share
    return [shares[frame.frame_index] for frame in result.frames if frame.frame_index in shares]


def _aspect(grades: list[Grade], value: float, unit: str, words: list[str]) -> AspectRecord:
    return AspectRecord.of({"grade": worst(grades), "value": value, "unit": unit, "text": ", ".join(words)})


def _at_most(value: float, doubtful: float, bad: float) -> Grade:
    return "bad" if value > bad else "doubtful" if value > doubtful else "good"


def _at_least(value: float, doubtful: float, bad: float) -> Grade:
    return "bad" if value < bad else "doubtful" if value < doubtful else "good"
