# SPDX-License-Identifier: Apache-2.0
"""Finds streams that hang: colour or depth repeats an earlier frame while the other continues. Equal files are found
by size and content in all frames, recompressed images by thumbnails of some frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import SequenceError
from ggslam.sequences.recording import ImageFile
from ggslam.sequences.sequence import Sequence
from ggslam.sequences.thumbnails import Thumbnail, thumbnail_of
from ggslam.sequences.verdicts import Verdict
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, read_untrusted


class HungTuning(Tuning):
    """When a stream is said to hang."""

    min_frames = 4
    """Fewest frames that hold one image: cameras of other rates repeat images once or twice."""
    close = 3
    """Frames between two stretches that may be one."""
    max_compared = 64
    """Most neighbouring files of one size and different content that are read, in each stream."""
    max_stretches = 12
    """Most stretches that are looked at, in each stream."""
    max_named = 3
    """Most stretches that a sentence names."""


Test = Callable[[Thumbnail, Thumbnail], bool]
"""Whether two views are the same, or are not."""

Spans = dict[str, list[tuple[int, int]]]


@dataclass(frozen=True)
class Stretch:
    """Frames that all hold one image of a stream, the first to the last by index; `blank`: of one colour."""

    first: int
    last: int
    blank: bool = False


def spans_of(sequence: Sequence) -> Spans:
    """First and last of the frames whose files hold the same bytes, by "color" and "depth", the longest first. Reads
    files of one size, so it is asked for once."""
    files = [sequence.files(k) for k in range(len(sequence))]
    return {kind: _same_files([getattr(one, kind) for one in files]) for kind in ("color", "depth")}


def judge_hung(sequence: Sequence, thumbnails: list[Thumbnail], spans: Spans | None = None) -> list[Verdict]:
    """Whether colour hangs while depth moves on, or depth while colour does; `spans`: see `spans_of`."""
    known = spans_of(sequence) if spans is None else spans
    return [verdict for kind in ("color", "depth") for verdict in _judge(sequence, thumbnails, kind, known)]


def _judge(sequence: Sequence, thumbnails: list[Thumbnail], kind: str, spans: Spans) -> list[Verdict]:
    found = find_hung(sequence, thumbnails, kind, spans)
    if not found:
        return []
    frames = sum(one.last - one.first + 1 for one in found)
    where = numbers_of(sequence, found)
    more = len(found) - HungTuning.max_named
    where += f" and in {quantity(more, 'more place')}" if more > 0 else ""
    same, other = ("colour", "depth") if kind == "color" else ("depth", "colour")
    told = f"{frames} of {len(sequence)} frames, {where},"
    if all(one.blank for one in found):
        text = f"colour images are blank: {told} show one and the same colour while depth moves on; take the cover off"
        return [Verdict("color_repeats", "doubtful", f"{text} the lens, or look how the images were written")]
    text = f"{same} images hang: {told} hold the {same} image of the first of them while {other} moves on"
    return [Verdict(f"{kind}_repeats", "doubtful", f"{text}; {remedy_for(sequence, found)}")]


def numbers_of(sequence: Sequence, found: list[Stretch]) -> str:
    """The first `HungTuning.max_named` stretches, by the numbers that their frames have in the recording."""
    numbers = sequence.selection
    return ", ".join(f"{numbers[one.first]} to {numbers[one.last]}" for one in found[: HungTuning.max_named])


def remedy_for(sequence: Sequence, found: list[Stretch]) -> str:
    """How to leave them out, where they lie at one end."""
    numbers, (one, *more) = sequence.selection, found
    if not more and one.last == len(sequence) - 1 and one.first > 0:
        return f"try `stop` {numbers[one.first] + 1}"
    if not more and one.first == 0 and one.last < len(sequence) - 1:
        return f"try `start` {numbers[one.last]}"
    return "record again: check the cable, the disk and what else the computer does"


def find_hung(sequence: Sequence, thumbnails: list[Thumbnail], kind: str, spans: Spans | None = None) -> list[Stretch]:
    """Stretches in which "color" or "depth" (`kind`) hangs, in order; `spans`: see `spans_of`."""
    same, moved = _tests(kind)
    files = (spans_of(sequence) if spans is None else spans)[kind]
    found = [one for span in files[: HungTuning.max_stretches] if (one := _confirm(sequence, *span, same, moved))]
    for first, last in _same_views(sequence, thumbnails, same, moved):
        if not any(one.first <= last and first <= one.last for one in found):
            found.append(Stretch(first, last))
    found.sort(key=lambda one: one.first)
    return _merge(sequence, found, Thumbnail.like_color if kind == "color" else Thumbnail.same_depth)


def _merge(sequence: Sequence, found: list[Stretch], like: Test) -> list[Stretch]:
    """Stretches in order; neighbours that hold one view become one."""
    merged: list[Stretch] = []
    for one in found:
        last = merged[-1] if merged else None
        if (
            last is not None
            and one.first - last.last <= HungTuning.close
            and _are_alike(sequence, last.last, one.first, like)
        ):
            merged[-1] = Stretch(last.first, one.last, last.blank and one.blank)
        else:
            merged.append(one)
    return merged


def _are_alike(sequence: Sequence, first: int, second: int, like: Test) -> bool:
    a, b = thumbnail_of(sequence, first), thumbnail_of(sequence, second)
    return a is not None and b is not None and like(a, b)


def _same_views(sequence: Sequence, thumbnails: list[Thumbnail], same: Test, moved: Test) -> list[tuple[int, int]]:
    """First and last of the frames whose small views are the same while the other stream moves on."""
    spans, begin = [], 0
    while begin < len(thumbnails):
        a, end = thumbnails[begin], begin + 1
        while end < len(thumbnails) and same(a, thumbnails[end]):
            end += 1
        if any(moved(a, view) for view in thumbnails[begin + 1 : end]):
            before = thumbnails[begin - 1].index + 1 if begin else 0
            after = thumbnails[end].index - 1 if end < len(thumbnails) else len(sequence) - 1
            span = _edge(sequence, a, a.index, before, same), _edge(sequence, a, thumbnails[end - 1].index, after, same)
            spans += [span] if span[1] - span[0] + 1 >= HungTuning.min_frames else []
        begin = end
    return spans


def _tests(kind: str) -> tuple[Test, Test]:
    """That images of the kind are the same, and that those of the other kind are not."""
    if kind == "color":
        return Thumbnail.same_color, Thumbnail.depth_moved
    return Thumbnail.same_depth, Thumbnail.color_moved_on


def _confirm(sequence: Sequence, first: int, last: int, same: Test, moved: Test) -> Stretch | None:
    """A stretch of equal files, if the other stream moves on meanwhile: a camera at rest records the same for long."""
    a, *others = (thumbnail_of(sequence, k) for k in (first, (first + last) // 2, last))
    if a is None or not any(b is not None and moved(a, b) for b in others):
        return None
    return Stretch(first, last, moved is Thumbnail.depth_moved and a.blank)


def _edge(sequence: Sequence, a: Thumbnail, near: int, far: int, same: Test) -> int:
    """The last frame from `near`, which holds the image of `a`, towards `far` that does, by halving."""
    while near != far:
        middle = (near + far + (far > near)) // 2
        view = thumbnail_of(sequence, middle)
        if view is not None and same(a, view):
            near = middle
        else:
            far = middle - (1 if far > near else -1)
    return near


def _same_files(files: list[ImageFile]) -> list[tuple[int, int]]:
    """First and last of the frames whose files hold the same bytes, the longest first; none of other images."""
    spans, begin, unequal = [], 0, 0
    for k in range(1, len(files) + 1):
        alike = (
            k < len(files) and unequal < HungTuning.max_compared and _size(files[k]) == _size(files[k - 1]) is not None
        )
        if alike:
            alike = _read(files[k]) == _read(files[k - 1])
            unequal += not alike
        if not alike:
            spans += [(begin, k - 1)] if k - begin >= HungTuning.min_frames else []
            begin = k
    return sorted(spans, key=lambda span: span[0] - span[1])


def _size(file: ImageFile) -> int | None:
    try:
        return file.stat().st_size if isinstance(file, Path) and file.is_file() else None
    except OSError:
        return None


def _read(file: ImageFile) -> bytes | None:
    try:
        return read_untrusted(file, FileTuning.max_image_bytes, SequenceError) if isinstance(file, Path) else None
    except SequenceError:
        return None
