# SPDX-License-Identifier: Apache-2.0
"""How depth lies on colour, by outlines and edges over stretches of successive frames: as it stands, mirrored or
turned, against the colour of other frames, and enlarged about the centre."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.alignment import edges_of, outlines_of
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning


class EdgeTuning(Tuning):
    """When another way of laying depth on colour is believed."""

    stretches = 3
    """Stretches of a recording that are read."""
    stretch_frames = 10
    """Successive frames of a stretch."""
    min_outlines = 15
    """Fewest outline pixels of a frame that counts."""
    min_frames = 8
    """Fewest frames that count."""
    min_outlines_in_all = 150
    """Fewest outline pixels of these frames together."""
    reach = 2
    """Frames before and after whose colour is compared."""
    errors_by_frame = 4.0
    """Standard errors, estimated from frames, by which another way must be better."""
    errors_by_part = 2.5
    """The same, estimated from parts of the image."""
    min_parts = 4
    """Fewest parts of the image with outlines."""
    min_gain = 0.15
    """Smallest gain, in standard deviations of the edge image."""
    min_strength = 0.25
    """Smallest strength of the edges under the outlines."""
    max_strength_share = 0.6
    """Strength without displacement, as a share of that at another place, above which nothing is wrong."""
    parts = 4
    """Rows and columns of the parts of an image."""
    max_strength_share_turned = 0.5
    """The same for mirrored or turned depth, of which little fits by chance."""
    errors_by_part_turned = 1.5
    """Standard errors by parts for turned depth: the horizon stays in the same parts."""
    min_strength_turned = 0.4
    """Smallest strength of the edges under turned outlines."""
    unrelated = 0.2
    """Strength below which colour and depth do not belong together. Sound recordings have 0.5 to 3.5, depth without
    registration or a frame off 0.4, colour of another room 0."""
    surely_unrelated = 0.35
    """Largest value of that strength plus two standard errors."""
    max_searched = 10
    """Most frames that are enlarged in search of a place."""
    good = 1.2
    """Strength without displacement from which depth lies on colour."""
    scales = np.geomspace(0.6, 2.2, 40)
    """Factors by which depth is enlarged."""
    max_shift = 0.08
    """Largest displacement of enlarged depth, as a share of the image's width."""
    min_inside = 0.15
    """Smallest share of the outlines that stays in the image when enlarged."""
    same_scale = 0.05
    """Largest difference of scale between the two halves of the frames (natural logarithm)."""
    same_shift = 0.02
    """Largest difference of displacement between the two halves, as a share of the image's width."""


TURNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "mirrored": lambda image: image[:, ::-1],
    "flipped": lambda image: image[::-1],
    "mirrored,flipped": lambda image: image[::-1, ::-1],
}
"""By `depth_kind` that undoes it: how depth may lie on colour."""


@dataclass
class EdgeImages:
    """Outlines of depth and edges of colour of frames, by their number; of each stretch."""

    outlines: dict[int, np.ndarray] = field(default_factory=dict)
    edges: dict[int, np.ndarray] = field(default_factory=dict)

    def pairs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Outlines and edges of all frames that show enough outlines."""
        return [(seen, self.edges[k]) for k, seen in self.outlines.items() if seen.sum() >= EdgeTuning.min_outlines]


@dataclass(frozen=True)
class Better:
    """Another way of laying depth on colour that fits clearly better.

    Attributes:
        strength: of the edges under the outlines as they stand, in standard deviations of the edge images.
        best: the same the other way.
    """

    strength: float
    best: float


@dataclass(frozen=True)
class BetterPlace(Better):
    """Depth fits when enlarged `scale` times about the centre and moved by `shift`, shares of the width."""

    scale: float
    shift: tuple[float, float]


def look_at_edges(frames: list[Frame]) -> EdgeImages:
    """Edge images of frames."""
    found = EdgeImages()
    for frame in frames:
        found.outlines[frame.index], found.edges[frame.index] = outlines_of(frame.depth), edges_of(frame.color)
    return found


def stretches(
    sequence: Sequence, count: int = EdgeTuning.stretches, length: int = EdgeTuning.stretch_frames
) -> list[Frame]:
    """Frames of some stretches of a recording, those that can be read, without masks."""
    first = np.unique(np.linspace(0, max(len(sequence) - length, 0), count).round().astype(int))
    numbers = sorted({k for start in first.tolist() for k in range(start, min(start + length, len(sequence)))})
    frames = []
    for number in numbers:
        try:
            frames.append(sequence.frame(number, masks=False))
        except SequenceError:
            continue
    return frames


def find_turn(seen: EdgeImages) -> tuple[str, Better] | None:
    """The name of `TURNS` that lays depth on colour; None if as it stands, or nothing can be told."""
    found = None
    for name, turn in TURNS.items():
        hits = _Hits()
        for outlines, edges in seen.pairs():
            hits.add(outlines, [edges, turn(edges)])  # each of them undoes itself
        better = hits.compare(0, 1, EdgeTuning.errors_by_part_turned)
        if (
            better is not None
            and better.strength < EdgeTuning.max_strength_share_turned * better.best
            and better.best > EdgeTuning.min_strength_turned
        ):
            found = max(found, (name, better), key=lambda one: one[1].best) if found else (name, better)
    return found


def find_unrelated(seen: EdgeImages) -> float | None:
    """Strength of the edges of colour under outlines of depth, if it is what chance gives; None: it is more, or nothing
    can be told."""
    pairs = seen.pairs()
    if not _enough([outlines for outlines, _ in pairs]):
        return None
    values = np.array([edges[outlines > 0].mean() for outlines, edges in pairs])
    weights = _weights([outlines for outlines, _ in pairs])
    strength = float(weights @ values)
    error = float(np.sqrt((weights**2 * (values - strength) ** 2).sum()))
    return strength if strength < EdgeTuning.unrelated and strength + 2 * error < EdgeTuning.surely_unrelated else None


def find_step(seen: EdgeImages) -> tuple[int, Better] | None:
    """Frames by which depth was taken after the colour beside it (negative: before); None if at the same time, or
    nothing can be told."""
    hits = _Hits()
    for k, outlines in seen.outlines.items():
        around = [
            edges
            for step in range(-EdgeTuning.reach, EdgeTuning.reach + 1)
            if (edges := seen.edges.get(k + step)) is not None
        ]
        if outlines.sum() >= EdgeTuning.min_outlines and len(around) == 2 * EdgeTuning.reach + 1:
            hits.add(outlines, around)
    # At the right step strength falls off to both sides; where it goes on rising, something else is wrong.
    best = hits.best()
    better = (
        hits.compare(EdgeTuning.reach, best)
        if best in range(1, 2 * EdgeTuning.reach) and best != EdgeTuning.reach
        else None
    )
    return None if better is None else (best - EdgeTuning.reach, better)


def find_place(seen: EdgeImages) -> BetterPlace | None:
    """Where depth lies on colour if it has to be enlarged and moved; None if as it stands, or nothing can be told."""
    pairs = seen.pairs()
    pairs = pairs[:: -(-len(pairs) // EdgeTuning.max_searched)] if pairs else []
    if not _enough([outlines for outlines, _ in pairs]):
        return None
    plain = np.array([edges[outlines > 0].mean() for outlines, edges in pairs])
    strength = float(_weights([outlines for outlines, _ in pairs]) @ plain)
    if strength > EdgeTuning.good:
        return None
    middle = len(pairs) // 2  # in time: what is next to one another looks alike
    halves = [_surface(part) for part in (pairs[:middle], pairs[middle:])]
    first, second, place = (_peak(surface) for surface in (*halves, (halves[0] + halves[1]) / 2))
    apart = abs(np.log(first[0] / second[0])), float(np.hypot(first[1] - second[1], first[2] - second[2]))
    if (
        apart[0] > EdgeTuning.same_scale
        or apart[1] > EdgeTuning.same_shift
        or abs(np.log(place[0])) < EdgeTuning.same_scale
    ):
        return None
    if (
        min(first[3], second[3]) < max(EdgeTuning.min_strength, strength / EdgeTuning.max_strength_share)
        or place[3] - strength < 2 * EdgeTuning.min_gain
    ):
        return None
    better = _compare_place(pairs, place[0], place[1], place[2])
    return None if better is None else BetterPlace(better.strength, better.best, place[0], (place[1], place[2]))


def _compare_place(
    pairs: list[tuple[np.ndarray, np.ndarray]], scale: float, right: float, down: float
) -> Better | None:
    """Outlines enlarged and moved against outlines as they stand, of those that stay in the image."""
    hits = _Hits()
    for outlines, edges in pairs:
        height, width = edges.shape
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        warp = np.column_stack([scale * np.eye(2), (1 - scale) * centre + np.array([right, down]) * width])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP  # what an outline falls on comes to where it is now
        moved = cv2.warpAffine(edges, warp, (width, height), flags=flags, borderValue=float("nan"))
        inside = outlines * np.isfinite(moved)
        if inside.any():
            hits.add(inside, [edges, np.nan_to_num(moved)])
    return hits.compare(0, 1)


def _enough(outlines: list[np.ndarray]) -> bool:
    return (
        len(outlines) >= EdgeTuning.min_frames
        and sum(float(seen.sum()) for seen in outlines) >= EdgeTuning.min_outlines_in_all
    )


def _weights(outlines: list[np.ndarray]) -> np.ndarray:
    """Of frames, with sum 1: the root of how many outlines they show."""
    weights = np.sqrt([float(seen.sum()) for seen in outlines])
    return weights / weights.sum()


class _Hits:
    """Strengths of edges under outlines, laid on several images, summed by frame and by part of the image: both tell
    how sure a difference is. Neighbouring frames show the same edges, so frames alone would make it look too sure."""

    def __init__(self) -> None:
        self._sums: list[np.ndarray] = []
        self._outlines: list[np.ndarray] = []

    def add(self, outlines: np.ndarray, images: list[np.ndarray]) -> None:
        """Takes a frame in: its outlines [H, W], and edges [H, W] that they may belong to."""
        rows, columns = np.nonzero(outlines)
        part = (
            rows * EdgeTuning.parts // outlines.shape[0] * EdgeTuning.parts
            + columns * EdgeTuning.parts // outlines.shape[1]
        )
        weight = 1 / np.sqrt(len(rows))  # a frame full of outlines counts more, but not in proportion
        values = [np.ones(len(rows)), *(edges[rows, columns] for edges in images)]
        self._sums.append(weight * np.stack([np.bincount(part, v, EdgeTuning.parts**2) for v in values]))
        self._outlines.append(outlines)

    def best(self) -> int:
        """Number of the image that fits best; -1: nothing can be told."""
        return int(np.sum(self._sums, axis=(0, 2))[1:].argmax()) if _enough(self._outlines) else -1

    def compare(self, plain: int, other: int, sure_by_part: float = EdgeTuning.errors_by_part) -> Better | None:
        """Another image against that of the frame itself, if it fits clearly better."""
        if not _enough(self._outlines):
            return None
        sums = np.stack(self._sums)[:, [0, 1 + plain, 1 + other]]
        by_part, by_frame = sums.sum(0), sums.sum(2).T
        count, strength, best = by_part.sum(1)
        found = Better(float(strength / count), float(best / count))
        gain = found.best - found.strength
        sure = gain > sure_by_part * _error(by_part) and gain > EdgeTuning.errors_by_frame * _error(by_frame)
        return found if sure and gain > EdgeTuning.min_gain and found.best > EdgeTuning.min_strength else None


def _error(sums: np.ndarray) -> float:
    """Standard error of the gain by leaving out one group in turn: counts and two strengths of groups [3, n]."""
    used = sums[:, sums[0] > 0]
    count, plain, other = used.sum(1)[:, None] - used
    if used.shape[1] < EdgeTuning.min_parts:
        return float("inf")
    left = (other - plain) / count
    return float(np.sqrt((len(left) - 1) / len(left) * ((left - left.mean()) ** 2).sum()))


def _surface(pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Mean strength under the outlines enlarged by all scales and moved [scales, rows, columns]; NaN: few inside."""
    height, width = pairs[0][1].shape
    reach = round(EdgeTuning.max_shift * width)
    found = np.full((len(EdgeTuning.scales), 2 * reach + 1, 2 * reach + 1), np.nan)
    for j, scale in enumerate(EdgeTuning.scales):
        total, inside, count = np.zeros(found.shape[1:]), 0.0, 0.0
        for outlines, edges in pairs:
            drawn, share = _enlarge(outlines, float(scale))
            weight = 1 / np.sqrt(outlines.sum())  # a frame full of outlines counts more, but not in proportion
            padded = cv2.copyMakeBorder(edges, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0.0)
            total += weight * cv2.matchTemplate(padded, drawn, cv2.TM_CCORR)
            inside, count = inside + weight * drawn.sum(), count + weight * outlines.sum()
        if inside >= EdgeTuning.min_inside * count:
            found[j] = total / inside
    return found


def _enlarge(outlines: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    """Outlines enlarged about the centre, float32 [H, W], and the share that stays inside."""
    height, width = outlines.shape
    rows, columns = np.nonzero(outlines)
    v = np.rint((rows - (height - 1) / 2) * scale + (height - 1) / 2).astype(int)
    u = np.rint((columns - (width - 1) / 2) * scale + (width - 1) / 2).astype(int)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    drawn = np.zeros((height, width), np.float32)
    np.add.at(drawn, (v[inside], u[inside]), 1.0)
    return drawn, float(inside.mean())


def _peak(surface: np.ndarray) -> tuple[float, float, float, float]:
    """Scale, right, down (shares of the width) and strength of the highest place."""
    scale, row, column = np.unravel_index(int(np.nanargmax(surface)), surface.shape)
    reach = surface.shape[1] // 2
    right, down = (float(place - reach) * EdgeTuning.max_shift / reach for place in (column, row))
    return float(EdgeTuning.scales[scale]), right, down, float(surface[scale, row, column])
