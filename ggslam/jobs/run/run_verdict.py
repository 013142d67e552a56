# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: the grades of its aspects combined, and advice on what to try next."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from ggslam.jobs.run.grades import (
    OF_RECORDING,
    MapGradeTuning,
    ScoredFigures,
    TrackingGradeTuning,
    grade_geometry,
    grade_movers,
    grade_objects,
    grade_sharp,
    grade_tracked,
)
from ggslam.jobs.run.map_fit import MapFit
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.objects.table import ObjectTable
from ggslam.rendering.exposure import change_of
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.verdict import AspectRecord, FitRecord, Grade, RunVerdict, worst
from ggslam.sequences.camera_doubts import doubt_centre
from ggslam.sequences.verdicts import Verdict
from ggslam.slam.result import SlamResult
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.tracking.tracker import TrackingStatus

_CAUSES = (
    "depth_noise", "color_noise", "unrelated", "no_motion", "orientation", "depth_side", "depth_kind", "depth_delay",
    "registration", "depth_codes", "depth_repeats", "color_repeats", "both_repeat", "depth_scale", "intrinsics",
    "poses", "mirrored", "alignment", "step", "time", "textureless", "degenerate",
)  # fmt: skip
"""Codes of verdicts on the recording that explain a bad run, what explains most first."""


class GainTuning(Tuning):
    """When a camera's gain changes."""

    same_gain = 1.3
    """Largest ratio of a gain to the median gain that is usual."""


_GO_ON = "mend what stopped the run, or `skip_bad_frames`, and run it again"
_REFINE, _WITH_MASKS = "`refine` 3000", "`masks` FOLDER, with masks of a segmenter"


def judge_result(
    result: SlamResult, found: list[Verdict], fit: MapFit | None, table: ObjectTable | None,
    metrics: MetricsRecord | None, recording: str, stopped: bool = False, unrefined: bool = False,
) -> RunVerdict:  # fmt: skip
    """The verdict on a run that has ended.

    Args:
        result: of the run.
        found: what seems wrong with it and its recording, see `health.judge`.
        fit: of its map.
        table: its objects; None: it has none.
        metrics: its scores; None: it was not scored.
        recording: its path, for commands; "": a live camera of which nothing was kept.
        stopped: whether it ended before the recording did, by an error or by the user.
        unrefined: whether it ended in the final refinement, after all frames.
    """
    scored = _figures_of_scores(metrics)
    aspects = {
        "tracked": grade_tracked(result, found, stopped), "sharp": grade_sharp(fit, scored, found, unrefined),
        "geometry": grade_geometry(fit, found), "objects": grade_objects(table, scored),
        "movers": grade_movers(result),
    }  # fmt: skip
    failure = _failure(result)
    if failure:  # the map shows what the few other frames do, and fits them well
        rest = AspectRecord(text="not judged: most frames were lost")
        aspects = {name: aspect if name == "tracked" else rest for name, aspect in aspects.items()}
    grade = overall(aspects)
    advice = "" if grade == "good" else _advice(aspects, result, found, fit, recording)
    if stopped and grade == "doubtful":
        advice = _GO_ON
    kept = None if fit is None else FitRecord(**asdict(fit))
    return RunVerdict.of({"grade": grade, **aspects, "failure": failure, "next": advice, "fit": kept})


def judge_scores(verdict: RunVerdict, table: ObjectTable | None, metrics: MetricsRecord) -> RunVerdict:
    """A verdict with the grades that scores decide upon, made anew from others. That of a run that is no result, or
    whose fit is not known, stays as it is.

    Args:
        verdict: on the run.
        table: its objects; None: it has none.
        metrics: its new scores.
    """
    if verdict.failure or verdict.fit is None:
        return verdict
    scored, fit = _figures_of_scores(metrics), MapFit(**vars(verdict.fit))
    sharp = grade_sharp(fit, scored)
    if verdict.sharp.text.endswith(tuple(OF_RECORDING.values())):  # scores tell nothing of that
        sharp = verdict.sharp
    aspects = {**verdict.aspects(), "sharp": sharp, "objects": grade_objects(table, scored)}
    grade = overall(aspects)
    weak = [name for name, aspect in aspects.items() if aspect.grade == grade]
    before = [name for name, aspect in verdict.aspects().items() if aspect.grade == verdict.grade]
    advice = "" if grade == "good" else verdict.next if weak == before else _usual_advice(weak, verdict.next)
    return RunVerdict.of({**vars(verdict), "grade": grade, **aspects, "next": advice})


def _usual_advice(weak: list[str], former: str) -> str:
    """What helps where scores alone tell what is weak; else what was said before."""
    if set(weak) <= {"objects"}:
        return _WITH_MASKS
    return _REFINE if set(weak) <= {"sharp", "objects"} else former


def overall(aspects: dict[str, AspectRecord]) -> Grade:
    """The worst grade; objects, which nothing else depends on, count one grade less."""
    grades: list[Grade] = [aspect.grade for name, aspect in aspects.items() if aspect.grade and name != "objects"]
    return worst([*grades, "doubtful" if aspects["objects"].is_grade("bad") else "good"])


def _figures_of_scores(metrics: MetricsRecord | None) -> ScoredFigures:
    if metrics is None:
        return ScoredFigures()
    keyframes, held_out = (metrics.number("images", name, "psnr_affine") for name in ("keyframes", "held_out"))
    overfit = None if keyframes is None or held_out is None else keyframes - held_out
    return ScoredFigures(overfit, metrics.number("segmentation", "all", "accuracy"))


def _failure(result: SlamResult) -> str:
    """That most of the frames have no pose; the scores are of the few others."""
    total, lost = len(result.frames), [f for f in result.frames if f.status == TrackingStatus.LOST.value]
    if len(lost) <= TrackingGradeTuning.max_lost * total:
        return ""
    return f"the camera was lost in {len(lost)} of {quantity(total, 'frame')} (the first: {lost[0].frame_index})"


def _advice(
    aspects: dict[str, AspectRecord], result: SlamResult, found: list[Verdict], fit: MapFit | None, recording: str
) -> str:
    """One thing to try: what the verdicts on the recording say, else what helps the worst aspect."""
    for severity in ("wrong", "doubtful"):
        for code in _CAUSES:
            for verdict in found:
                if (verdict.code, verdict.severity) == (code, severity) and "; " in verdict.text:
                    return verdict.text.rpartition("; ")[2].removeprefix("try ")
    look = f"ggslam inspect {recording or 'FOLDER, of frames that ggslam run CAMERA --record FOLDER kept'}"
    if (
        fit is not None
        and not 1 / MapGradeTuning.doubtful_brightness <= fit.brightness <= MapGradeTuning.doubtful_brightness
    ):
        return _start_later(result) or "fix the camera's exposure"
    for grade in ("bad", "doubtful"):
        weak = [name for name, aspect in aspects.items() if aspect.grade == grade]
        if "geometry" in weak or "movers" in weak:
            return f"{look} (does the depth fit the images: its kind, scale, camera, frame?)"
        if "tracked" in weak:
            return _slower(result, look)
        if "sharp" in weak and fit is not None and fit.located:
            return "ggslam update, which brings the map up to date, or a map made in the same light"
        if "sharp" in weak and (centre := _doubt_centre(result)):
            return centre
        if "sharp" in weak and grade == "bad":
            return f"{look} (do depth and colour belong to one frame and one camera?)"
        if "sharp" in weak:
            return _REFINE
    return _WITH_MASKS  # only the objects are left


def _doubt_centre(result: SlamResult) -> str:
    """To check the principal point where it lies as that of a crop does; "": it does not."""
    return doubt_centre(result.keyframes[0].camera) if result.keyframes else ""


def _slower(result: SlamResult, look: str) -> str:
    steps = np.diff([frame.source_index for frame in result.frames])
    if result.dropped_frames:
        return "`scale` 0.5"
    if len(steps) and np.median(steps) > 1:
        return "`stride` 1"
    return f"{look}; record slower, or more frames a second"


def _start_later(result: SlamResult) -> str:
    """To begin where the exposure is that of most keyframes; "" if that does not help."""
    ours = [k for k in result.keyframes if k.frame_index != FROM_EARLIER_RUN]
    gains = np.array([change_of(k.exposure) for k in ours])
    if not len(gains):
        return ""
    usual = np.abs(np.log(gains / np.median(gains))) < np.log(GainTuning.same_gain)
    first = ours[int(usual.argmax())]
    source = {frame.frame_index: frame.source_index for frame in result.frames}.get(first.frame_index)
    return f"`start` {source}: the frames before have another exposure" if usual.any() and source else ""
