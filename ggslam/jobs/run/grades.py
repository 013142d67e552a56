# SPDX-License-Identifier: Apache-2.0
"""What the figures of a run are worth: each aspect of `verdict.json` as good, doubtful or bad.

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
from ggslam.tracking.tracker import TrackingStatus

MOSTLY_LOST = 0.5
"""Of the frames lost: the run is no result, and `ggslam run` ends with exit code 1."""
BADLY_LOST = 0.3
"""Of the frames lost or doubted. Hand-held walks that move half a metre a frame lose 15 % and are sound; images turned
against their depth lose or doubt 60 to 75 %."""
MUCH_SEARCHED = 0.5
"""Of the frames located by another start than constant velocity: the motion is at the limit of what is followed."""
JUMP_MEDIAN, JUMP_P90, JUMP_M = 15.0, 7.5, 0.05
"""A change of step from frame to frame of so many usual ones, of so many 90th percentiles and of so many metres is a
jump of the path: true paths of whole walks reach 12 medians and 6.2 percentiles (Kinect), 8.1 and 4.0 (HoloLens)."""
BAD_STRUCTURE, DOUBTFUL_STRUCTURE = 0.9, 0.95
"""SSIM at 160 pixels of width over what image noise allows there: sound runs have 0.93 to 1, the lowest of them an
iPhone's with smoothed depth; depth one frame off has 0.87, of another kind or place 0.78 to 0.86, mirrored images 0.68.
PSNR and SSIM at full size do not tell these apart: the iPhone's are 20 dB and 0.71."""
OTHER_BRIGHTNESS, FAR_BRIGHTNESS = 1.5, 2.5
"""Factors between the brightness of the map and that of the keyframes. A map that took the exposure of a first, dark
frame looks right frame by frame and black as a whole: a factor of 6."""
OVERFIT_DB = 8.0
"""PSNR of keyframes over that of held-out frames, exposure forgiven: the map fits what it was trained on only. Whole
recordings have 0 to 3, 16 frames of a rig 6, every 12th frame of a walk 11."""
BAD_AGREEMENT, DOUBTFUL_AGREEMENT = 0.9, 0.95
"""Share of the pixels at the measured depth. Sound runs reach 0.95 to 1, a HoloLens with ragged depth 0.93; depth that
is not registered 0.90, with pixels at full scale 0.81. Depth of another kind bends the map as a whole and agrees with
it (0.95 to 0.98): sharpness and movers tell that."""
LOCATED_STRUCTURE, LOCATED_AGREEMENT = (0.87, 0.82), (0.85, 0.75)
"""The same of frames that were only located in a map, doubtful and bad: Kinect and HoloLens have 0.95 and 0.91 of the
structure and 0.94 and 0.91 of the depth, a generated room with five changes 0.97 and 0.99, one with exchanged colour
channels 0.77, with other textures 0.80."""
LARGEST_OBJECT, ONLY_OBJECT = 0.5, 0.9
"""Share of the Gaussians that one object holds: it joins several things, or everything."""
UNSURE_IDS, WRONG_IDS = 0.8, 0.5
"""Share of the pixels whose object is the masks'."""
MOVING_FRAMES = 0.5
"""Of the frames show something moving before movers are doubted at all: a person in view does that, too..."""
MANY_MOVERS, TOO_MANY_MOVERS = 0.25, 0.75
"""...but is one mover. So many new movers a moving frame are noise: real ones reach 0.05, warped depth 0.4 to 0.5,
full-scale pixels 1."""
MOVING_PICTURE = 0.5
"""Of the image moving on average where something moves: then the camera's pose or depth is wrong, not the world."""
FEWEST_FRAMES = 3
"""Frames of a run that show whether it is good: a first frame alone fits whatever comes."""
OF_RECORDING = {
    "color_noise": "the colour images show noise", "unrelated": "colour and depth do not belong together",
    "color_repeats": "colour repeats while depth moves on",
}  # fmt: skip
"""What is wrong with colour, by code of the verdict on the recording; whatever map is made of it fits it well."""


@dataclass(frozen=True)
class ScoredFigures:
    """What only scoring tells.

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
        _at_most((lost + doubted) / max(1, total), VerdictTuning.lost_share, BADLY_LOST),
        "doubtful" if searched > MUCH_SEARCHED * total or len(jumps) or codes & {"degenerate", "dropped"} else "good",
        "bad" if codes & {"textureless", "depth_noise"} else "good",
        "doubtful" if stopped or total < FEWEST_FRAMES or codes & {"no_motion", "both_repeat"} else "good",
    ]
    words = [f"{total - lost} of {total} frames located"]
    words += [f"{searched} of them by search"] if searched else []
    words += [f"{doubted} against what the image shows"] if doubted else []
    words += ["nothing in view tells the motion"] if "textureless" in codes else []
    words += ["most with an open direction"] if "degenerate" in codes else []
    words += [f"the path jumps {len(jumps)} times (the first: frame {jumps[0]})"] if jumps else []
    words += [f"{dropped} frames dropped"] if dropped else []
    words += ["the depth images show noise"] if "depth_noise" in codes else []
    words += ["both streams hang"] if "both_repeat" in codes else []
    one = ["too few to tell"] if total < FEWEST_FRAMES else ["one frame shows no motion"]
    words += one if total < FEWEST_FRAMES or "no_motion" in codes else []
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
    limit = max(JUMP_MEDIAN * np.nanmedian(changes), JUMP_P90 * np.nanpercentile(changes, 90), JUMP_M)
    return [int(i) for i in index[2:][np.nan_to_num(changes) > limit]]


def grade_sharp(
    fit: MapFit | None, scored: ScoredFigures, found: list[Verdict] | None = None, unrefined: bool = False
) -> AspectRecord:
    """Whether the map looks like the keyframes, and these like the place; `found`: what seems wrong with them;
    `unrefined`: the final refinement was cut short."""
    if fit is None:
        return AspectRecord(text="no keyframe of this run to compare with")
    limits = LOCATED_STRUCTURE if fit.located else (DOUBTFUL_STRUCTURE, BAD_STRUCTURE)
    off = max(fit.brightness, 1 / max(fit.brightness, 1e-6))
    overfit = scored.overfit_db is not None and scored.overfit_db > OVERFIT_DB
    grades: list[Grade] = [
        _at_least(fit.structure, *limits), _at_most(off, OTHER_BRIGHTNESS, FAR_BRIGHTNESS),
        "doubtful" if overfit or unrefined else "good",
    ]  # fmt: skip
    codes = {verdict.code for verdict in found or []} & OF_RECORDING.keys()
    grades += ["doubtful" if codes == {"color_repeats"} else "bad"] if codes else []
    words = [f"{fit.psnr:.1f} dB, {fit.structure:.1%} of the structure that image noise leaves"]
    if off > OTHER_BRIGHTNESS:
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
    limits = LOCATED_AGREEMENT if fit.located else (DOUBTFUL_AGREEMENT, BAD_AGREEMENT)
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
    grades = [_at_most(share, LARGEST_OBJECT, ONLY_OBJECT)]
    number = "1 object" if len(counts) == 1 else f"{len(counts)} objects"
    words = [f"{number}, the largest has {share:.0%} of the Gaussians"]
    if scored.id_accuracy is not None:
        grades.append(_at_least(scored.id_accuracy, UNSURE_IDS, WRONG_IDS))
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
    often = frames > MOVING_FRAMES * total
    grades: list[Grade] = [
        _at_most(rate, MANY_MOVERS, TOO_MANY_MOVERS) if often else "good",
        "bad" if often and picture > MOVING_PICTURE else "good",
    ]
    movers = "1 mover" if len(result.movers) == 1 else f"{len(result.movers)} movers"
    words = [f"{movers} in {frames} of {total} frames, {picture:.1%} of the image there"]
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
