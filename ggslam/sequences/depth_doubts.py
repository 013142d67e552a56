# SPDX-License-Identifier: Apache-2.0
"""Checks what depth images hold: whether they belong to this camera, this moment and this orientation, and whether
depth is measured along the optical axis. Each verdict names its remedy. A run refuses to start on "wrong", which
needs certain evidence."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.alignment import measure_alignment
from ggslam.sequences.depth_kind import DepthKind
from ggslam.sequences.edge_evidence import (
    BetterFit,
    BetterPlacement,
    EdgeImages,
    find_place,
    find_step,
    find_turn,
    find_unrelated,
    look_at_edges,
    stretches,
)
from ggslam.sequences.hung_pairs import judge_hung_pairs
from ggslam.sequences.hung_streams import judge_hung, spans_of
from ggslam.sequences.invalid_depth_codes import find_invalid_depth_code
from ggslam.sequences.inverted_depth import Inversion, find_inversion
from ggslam.sequences.noise_doubts import judge_noise, judge_views
from ggslam.sequences.orientation import WORDS as ORIENTATIONS
from ggslam.sequences.orientation import orientation_of
from ggslam.sequences.plane_evidence import PlaneEvidence, look_at_planes
from ggslam.sequences.pose_doubts import pairs_apart
from ggslam.sequences.repeats import find_repeats
from ggslam.sequences.sequence import Sequence
from ggslam.sequences.thumbnails import Thumbnail, thumbnails_of
from ggslam.sequences.triangulation import TruePoints, triangulate
from ggslam.sequences.verdicts import Verdict, VerdictTuning, judge_inverse_scale
from ggslam.system.tuning import Tuning

CODES = frozenset({
    "orientation", "depth_side", "depth_kind", "depth_delay", "registration", "depth_repeats", "color_repeats",
    "depth_codes", "depth_noise", "unrelated",
})  # fmt: skip
"""Of the verdicts that doubt depth itself."""


class DepthDoubtTuning(Tuning):
    """How frames are chosen, and when another reading of depth is reported."""

    frames = 8
    """Frames spread over the recording in which planes are looked for."""
    posed_frames = 5
    """Frames whose points are triangulated from true poses."""
    max_spread_share = 0.6
    """Largest spread that another reading may leave, as a share of the spread as z, with true poses."""
    max_spread = 0.15
    """Largest spread that another reading may leave (natural logarithm)."""


UNDONE_BY_TAG = {2: "mirrored", 3: "mirrored,flipped", 4: "flipped"}
"""Of orientation tags that keep the size of the image: how depth lies on colour as stored then."""
SIDES = {
    "mirrored": "mirrored (left and right exchanged)", "flipped": "upside down",
    "mirrored,flipped": "turned by 180 degrees",
}  # fmt: skip
COLOR_AT_FAULT = {
    "mirrored": "if text in the colour images reads backwards, mirror them back",
    "flipped": "if the colour images are upside down, flip them back",
    "mirrored,flipped": "if the colour images are upside down, turn them back",
}
"""Outlines tell only that one of the two is not as it should be; these tell which."""


@dataclass
class DepthDoubts:
    """Checks the depth of a recording; frames that were read are kept for other checks.

    Attributes:
        sequence: the recording.
        frames: of it, spread, that were read already; empty: they are read here.
    """

    sequence: Sequence
    frames: list[Frame] = field(default_factory=list)

    def judge(self) -> list[Verdict]:
        """All doubts. One about units, place or kind of depth hides those that it may be the cause of."""
        found = judge_noise(self._thumbnails, self.sequence.selection)
        spans = spans_of(self.sequence)
        hung = judge_hung(self.sequence, self._thumbnails, spans)
        found += self._judge_units() if not found else []
        found += self._judge_edges(bool(hung)) if not found else []
        found += self._judge_measure() if not found else []
        still = judge_views(self.sequence, self._thumbnails)
        pairs = judge_hung_pairs(self.sequence, spans)
        return [*found, *self._judge_repeats(hung), *pairs, *self._judge_codes(), *still]

    @cached_property
    def _thumbnails(self) -> list[Thumbnail]:
        return thumbnails_of(self.sequence)

    @cached_property
    def spread(self) -> list[Frame]:
        """Frames spread over the recording."""
        count = len(self.sequence)
        chosen = np.unique(np.linspace(0, count - 1, min(DepthDoubtTuning.frames, count)).round().astype(int))
        return self.frames or [frame for k in chosen.tolist() if (frame := _read(self.sequence, k)) is not None]

    @cached_property
    def points(self) -> TruePoints:
        """Points whose distance true poses tell; none without poses."""
        posed = [frame for frame in self.spread if frame.T_world_camera is not None]
        return triangulate(pairs_apart(self.sequence, posed[:: -(-len(posed) // DepthDoubtTuning.posed_frames) or 1]))

    @cached_property
    def planes(self) -> PlaneEvidence:
        """What planes say."""
        return look_at_planes(self.spread)

    @property
    def _kind(self) -> DepthKind:
        return self.sequence.depth_kind

    def _judge_units(self) -> list[Verdict]:
        known = [frame.depth[frame.depth > 0] for frame in self.spread]
        depths = np.concatenate(known) if known else np.zeros(0)
        return judge_inverse_scale(self.sequence.depth_scale, float(np.median(depths))) if len(depths) else []

    @cached_property
    def _edges(self) -> EdgeImages:
        return look_at_edges(stretches(self.sequence))

    def _judge_edges(self, hung: bool) -> list[Verdict]:
        """Whether depth is mirrored or turned, a frame off, or of another camera: what fits best; or, unless a stream
        hangs, of another scene."""
        turn, step, place = find_turn(self._edges), find_step(self._edges), find_place(self._edges)
        found = [(place.best, self._place_verdict(place))] if place else []
        found += [(step[1].best, self._step_verdict(*step))] if step else []
        found += [(turn[1].best, self._side_verdict(*turn))] if turn else []
        if not found and not hung and (strength := find_unrelated(self._edges)) is not None:
            moved = measure_alignment(self.spread)  # a few pixels off, the right colour fits as badly
            return [] if moved is not None and moved.doubtful else [self._unrelated_verdict(strength)]
        return [max(found, key=lambda one: one[0])[1]] if found else []

    def _unrelated_verdict(self, strength: float) -> Verdict:
        text = (
            f"colour and depth do not belong together: outlines of depth lie on edges of colour no more often than by "
            f"chance (strength {strength:.2f}, of sound recordings 0.5 and more); check whether both folders are of "
            "one recording, whether one of the two is cropped or has another field of view, whether depth comes "
            "several frames later (`depth_delay`), and whether it was compressed with losses (JPEG)"
        )
        return Verdict("unrelated", "doubtful", text)

    def _side_verdict(self, name: str, better: BetterFit) -> Verdict:
        strength = f"(strength {better.best:.2f}, as it is {better.strength:.2f})"
        how = f"outlines of depth fit the edges of colour then {strength}"
        tag = 1 if self.sequence.upright else orientation_of(self.sequence.files(0).color)
        if UNDONE_BY_TAG.get(tag) == name:
            text = (
                f"colour is stored {ORIENTATIONS[tag]} (orientation tag {tag} of {self.sequence.files(0).color.name}) "
                f"and depth is upright: {how}; try `upright`"
            )
            return Verdict("orientation", "wrong", text)
        remedy = self._kind.with_words(name)
        text = f"depth or colour is {SIDES[name]} against the other: {how}"
        text += f"; {COLOR_AT_FAULT[name]}, else try `depth_kind` {remedy}"
        return Verdict("depth_side", "wrong", text)

    def _judge_measure(self) -> list[Verdict]:
        """Whether depth is z, or measured along the ray, or inverse."""
        if self._kind.told:
            return []
        by_planes = self.planes.measure
        by_poses, tell = self._measure_by_poses(), self.points.tell
        measure = by_planes if by_planes in ("ray", "inverse") else by_poses if by_planes is None else None
        if measure is None:
            return []
        words = []
        if by_planes == measure:
            flat = [self.planes.residuals[k] for k in (0, 1 if measure == "ray" else 2)]
            words.append(f"walls and floors are flat to {flat[1]:.2%} then, as z only to {flat[0]:.2%}")
        if tell:
            spreads = [self.points.spread(name) for name in (measure, "z")]  # type: ignore[arg-type]
            words.append(f"points agree with the true poses to {spreads[0] / 2:.1%} then, as z only to "
                         f"{spreads[1] / 2:.1%}")  # fmt: skip
        contradicted = tell and by_poses != measure
        severity = "wrong" if by_planes == measure and not contradicted else "doubtful"
        if measure == "inverse" and by_planes == measure and (inversion := find_inversion(self.spread)):
            return [Verdict("depth_kind", severity, self._inversion_text(inversion))]  # type: ignore[arg-type]
        what = "measured along the ray of each pixel, not along the optical axis" if measure == "ray" else (
            "inverse (disparity): the larger the number, the nearer"
        )  # fmt: skip
        remedy = self._kind.with_words(measure if measure == "ray" else f"inverse:{self._inverse_units():g}")
        hint = "" if measure == "ray" or tell else " (with which the median depth is that of a room)"
        text = f"depth is {what}: {', '.join(words)}; try `depth_kind` {remedy}{hint}"
        return [Verdict("depth_kind", severity, text)]  # type: ignore[arg-type]

    def _inversion_text(self, found: Inversion) -> str:
        """Of depth that was subtracted from a constant: no option undoes it."""
        number = float(f"{found.constant * self.sequence.depth_scale:.2g}")
        return (
            f"depth is inverted, a constant minus the distance: walls and floors are flat to {found.residual:.2%} if "
            f"it is about {number:g}, to {found.as_inverse:.2%} as inverse depth (disparity); write the depth images "
            "anew: the constant minus what they hold, and 0 where nothing was measured"
        )

    def _measure_by_poses(self) -> str | None:
        points = self.points
        if not points.tell:
            return None
        spreads = {name: points.spread(name) for name in ("ray", "inverse")}  # type: ignore[arg-type]
        best = min(spreads, key=lambda name: spreads[name])
        clear = spreads[best] < min(DepthDoubtTuning.max_spread, DepthDoubtTuning.max_spread_share * points.spread("z"))
        return best if clear else None

    def _inverse_units(self) -> float:
        """What is stored at 1 m of inverse depth: by the poses, else so that the median depth is a room's."""
        if self.points.tell:
            units = self.points.factor("inverse") * self.sequence.depth_scale
        else:
            depths = np.concatenate([frame.depth[frame.depth > 0] for frame in self.spread])
            units = VerdictTuning.usual_median_m * float(np.median(depths)) * self.sequence.depth_scale
        return float(f"{units:.2g}")

    def _step_verdict(self, frames: int, better: BetterFit) -> Verdict:
        side = "after" if frames > 0 else "before"
        text = (
            f"depth is 1 frame off: it was taken 1 frame {side} the colour beside it (its outlines fit the edges of "
            f"the frame {side} it to {better.best:.2f}, of its own to {better.strength:.2f})"
        )
        told = self.sequence.options.get("depth_delay") if self.sequence.options else None
        remedy = f"; try `depth_delay` {frames}f" if told is None else f"; `depth_delay` {told} is 1 frame off"
        return Verdict("depth_delay", "wrong", text + remedy)

    def _place_verdict(self, place: BetterPlacement) -> Verdict:
        camera, stored = self.sequence.camera, self.sequence.depth_size
        right, down = (share * camera.width for share in place.shift)
        known = np.concatenate([frame.depth[frame.depth > 0] for frame in self.spread])
        beside = right / camera.fx * float(np.median(known)) if len(known) else 0.0
        focal = camera.fx / place.scale * stored[0] / camera.width
        text = (
            f"depth is not registered to colour: its outlines fit the edges of colour when enlarged {place.scale:.2f} "
            f"times about the centre and moved {right:+.0f} pixels right, {down:+.0f} down (strength {place.best:.2f}, "
            f"as it is {place.strength:.2f})"
        )
        if self.sequence.registered:
            return Verdict("registration", "wrong", f"{text}; check the calibration of the depth camera")
        text += (
            f"; give the calibration of the depth camera with `depth_camera` FILE: fx is about {focal:.0f} of "
            f"{stored[0]}x{stored[1]} pixels, and T_color_depth moves by about {beside:.3f} m along x"
        )
        return Verdict("registration", "wrong", text)

    def _judge_repeats(self, hung: list[Verdict]) -> list[Verdict]:
        """Whether images come several times: `hung`, in long stretches, else all along."""
        found, verdicts = find_repeats(self.sequence), list(hung)
        for code, count, same, other in (
            ("depth_repeats", found.depth, "depth", "colour"), ("color_repeats", found.color, "colour", "depth"),
        ):  # fmt: skip
            if not found.many(count) or code in {verdict.code for verdict in hung}:
                continue
            share = count / found.pairs
            runs = round(1 / max(1 - share, 1e-9)) if share < 0.95 else 0
            remedy = f"; try `stride` {runs}" if runs > 1 and abs(share - (1 - 1 / runs)) < 0.08 else ""
            text = (
                f"{same} images repeat: {count} of {found.pairs} neighbouring frames that were compared hold the same "
                f"{same} with different {other}, so most {same} is from another time{remedy}"
            )
            if code == "color_repeats" and found.blank:
                text = (
                    f"colour images are blank: in {count} of {found.pairs} pairs of neighbours both show one and the "
                    f"same colour and nothing else; take the cover off the lens, or check how the images were written"
                )
            verdicts.append(Verdict(code, "doubtful", text))
        return verdicts

    def _judge_codes(self) -> list[Verdict]:
        found = find_invalid_depth_code(self.sequence)
        if found is None:
            return []
        remedy = self._kind.with_words(f"none:{found.code:g}")
        text = (
            f"depth {found.code:g} stands in {found.share:.1%} of the pixels with depth and almost no depth is near "
            f'it: it seems to mean "not measured"; try `depth_kind` {remedy}'
        )
        return [Verdict("depth_codes", "doubtful", text)]


def _read(sequence: Sequence, index: int) -> Frame | None:
    try:
        return sequence.frame(index, masks=False)
    except SequenceError:
        return None
