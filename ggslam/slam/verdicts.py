# SPDX-License-Identifier: Apache-2.0
"""Judges a run by the records of its frames and keyframes. Takes a fraction of a second at the end of the run."""

from __future__ import annotations

import numpy as np

from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.rendering.exposure import change_of
from ggslam.scene.poses import fit_similarity
from ggslam.sequences.verdicts import Severity, Verdict, judge_scale_by
from ggslam.slam.map_parts import NOT_JOINED
from ggslam.slam.result import SlamResult
from ggslam.system.plurals import word_for
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp_tracker import GicpTrackerTuning
from ggslam.tracking.photometric import GreyDepth, textured_points
from ggslam.tracking.settings import PhotometricSettings
from ggslam.tracking.tracker import TrackingStatus


class VerdictTuning(Tuning):
    """When a run gets a verdict."""

    degenerate_share = 0.5
    """Share of degenerate frames from which they are reported."""
    blind_share = 0.1
    """Share of frames that show one bare surface without texture from which they are reported."""
    lost_share = 0.05
    """Share of lost frames from which they are reported."""
    dropped_share = 0.02
    """Share of dropped frames from which they are reported."""
    min_frames = 5
    """Fewest frames of a kind that are reported."""
    exposure_change = 0.1
    """Change of a keyframe's exposure that is reported, as the natural logarithm of its gain."""
    length_factor = 1.4
    """Factor between the lengths of the estimated and the true path from which a wrong scale is reported..."""
    max_error_share = 0.35
    """...if the scaled path fits the true one with at most this error, as a share of its size."""
    min_poses = 10
    """Fewest poses from which a wrong scale is reported."""


def judge_run(result: SlamResult) -> list[Verdict]:
    """Verdicts on what was measured during the run."""
    checks = (_judge_motion, _judge_exposure, _judge_doubted, _judge_lost, _judge_parts, _judge_dropped)
    return [verdict for check in checks for verdict in check(result)]


def _judge_motion(result: SlamResult) -> list[Verdict]:
    """Whether geometry, or at least grey values, determined the motion of the camera."""
    open_ = [f for f in result.frames if f.status == TrackingStatus.DEGENERATE.value]
    if len(open_) < VerdictTuning.min_frames:
        return []
    bare = {k: _is_bare(result.keyframes[k]) for k in {f.keyframe for f in open_ if f.keyframe < len(result.keyframes)}}
    blind = [f for f in open_ if bare.get(f.keyframe, False)]
    total = len(result.frames)
    if len(blind) >= max(VerdictTuning.min_frames, VerdictTuning.blind_share * total):
        text = (
            f"{len(blind)} of {total} frames (the first: {blind[0].frame_index}) show one bare surface and no "
            "texture, so that motion along it cannot be estimated; keep edges or texture in view"
        )
        return [Verdict("textureless", "wrong", text)]
    if len(open_) > VerdictTuning.degenerate_share * total:
        text = (
            f"in {len(open_)} of {total} frames ({len(open_) / total:.0%}) the surfaces in view do not "
            "constrain one direction of motion, which is estimated from grey values alone; keep a second wall or the "
            "floor in view"
        )
        return [Verdict("degenerate", "doubtful", text)]
    return []


def _is_bare(keyframe: Keyframe) -> bool:
    """Whether it has too little texture to be tracked by."""
    if keyframe.frame_index == FROM_EARLIER_RUN:
        return False
    shrink = PhotometricSettings().shrink * max(1, round(keyframe.camera.width / 320))
    view = GreyDepth.from_images(keyframe.color, keyframe.depth_m(), keyframe.camera, shrink)
    return len(textured_points(view, PhotometricSettings())) < GicpTrackerTuning.min_textured


def _judge_exposure(result: SlamResult) -> list[Verdict]:
    """Whether the camera's exposure changed against that of the map, which is the first keyframe's."""
    ours = [k for k in result.keyframes if k.frame_index != FROM_EARLIER_RUN]
    changes = {k.frame_index: change_of(k.exposure) for k in ours}
    changed = {frame: gain for frame, gain in changes.items() if abs(np.log(gain)) > VerdictTuning.exposure_change}
    if not changed:
        return []
    frame, gain = max(changed.items(), key=lambda item: abs(np.log(item[1])))
    text = (
        f"the exposure changed: from frame {min(changed)} on {len(changed)} of {len(ours)} keyframes "
        f"{word_for(len(changed), 'is', 'are')} darker or brighter than the map, frame {frame} {gain:.2f} times as "
        "bright; training compensates for it; fix exposure and white balance if the camera can"
    )
    return [Verdict("exposure", "doubtful", text)]


def _judge_doubted(result: SlamResult) -> list[Verdict]:
    """Whether the images of some frames contradict their poses."""
    doubted = [f.frame_index for f in result.frames if f.status == TrackingStatus.DOUBTED.value]
    if not doubted:
        return []
    text = (
        f"the camera may have jumped: in {len(doubted)} of {len(result.frames)} frames (the first: {doubted[0]}) most "
        "of the features shared with the previous frame contradict the estimated pose; move slower there"
    )
    return [Verdict("jump", "doubtful", text)]


def _judge_lost(result: SlamResult) -> list[Verdict]:
    lost = [f.frame_index for f in result.frames if f.status == TrackingStatus.LOST.value]
    if len(lost) < max(VerdictTuning.min_frames, VerdictTuning.lost_share * len(result.frames)):
        return []
    text = f"the camera was lost in {len(lost)} of {len(result.frames)} frames (the first: {lost[0]})"
    return [Verdict("lost", "wrong", f"{text}; move slower and return to where it was located last")]


def _judge_parts(result: SlamResult) -> list[Verdict]:
    """Whether the recording consists of parts that could not be joined."""
    left = [event.reason for event in result.loop_events if event.kind == "left out"]
    if not left:
        return []
    gone = sum(frame.reason == NOT_JOINED for frame in result.frames)
    level: Severity = (
        "wrong" if gone >= max(VerdictTuning.min_frames, VerdictTuning.lost_share * len(result.frames)) else "doubtful"
    )
    hint = "record again and return to places that the camera has seen, or run each part on its own"
    return [Verdict("parts", level, f"{'; '.join(left)}; {hint}")]


def _judge_dropped(result: SlamResult) -> list[Verdict]:
    dropped, total = result.dropped_frames, len(result.frames) + len(result.dropped_frames)
    if len(dropped) < max(VerdictTuning.min_frames, VerdictTuning.dropped_share * total):
        return []
    text = f"{len(dropped)} of {total} frames were dropped (the first: {dropped[0]}): tracking was too slow"
    return [Verdict("dropped", "doubtful", f"{text}; choose a lower rate, a smaller `scale` or a faster machine")]


def judge_path(result: SlamResult, truth: np.ndarray | None, depth_scale: float) -> list[Verdict]:
    """Whether the path is as long as the true one. If it is not, depth has another unit.

    Args:
        result: of the run.
        truth: T_world_camera of the recording's frames [n, 4, 4], NaN where unknown; None: nothing is known.
        depth_scale: units of depth images per metre.
    """
    if truth is None:
        return []
    inside = np.array([f.frame_index < len(truth) for f in result.frames], bool)
    ours = result.trajectory()[inside, :3, 3]
    true = truth[[f.frame_index for f in result.frames if f.frame_index < len(truth)], :3, 3]
    known = np.isfinite(ours).all(1) & np.isfinite(true).all(1)
    if known.sum() < VerdictTuning.min_poses:
        return []
    ours, true = ours[known], true[known]
    size = np.sqrt(((true - true.mean(0)) ** 2).sum(1).mean())
    T, scale = fit_similarity(true, ours, with_scale=True)
    ratio = float(scale)
    if not (size > 0.02 and ratio > 0 and abs(np.log(ratio)) > np.log(VerdictTuning.length_factor)):
        return []
    error = np.sqrt(((ratio * true @ T[:3, :3].T + T[:3, 3] - ours) ** 2).sum(1).mean())
    if error > VerdictTuning.max_error_share * ratio * size:
        return []
    return judge_scale_by(depth_scale, ratio, f"the estimated path is {ratio:.3g} times as long as the true one")
