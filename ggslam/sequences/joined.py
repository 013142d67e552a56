# SPDX-License-Identifier: Apache-2.0
"""Reads several recordings one after the other as one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import SupportsIndex

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.recording import FrameFiles
from ggslam.sequences.sequence import ReadMasks, Sequence, SkippedFrame


@dataclass(frozen=True)
class JoinedPart:
    """A recording among others.

    Attributes:
        sequence: the recording.
        time_shift_s: seconds that are added to its times.
        T_joint_truth: brings its true poses into the world of the others', float64 [4, 4].
        mask_ids: what its mask ids are called in the whole; None: as they are. Others become 0.
    """

    sequence: Sequence
    time_shift_s: float = 0.0
    T_joint_truth: np.ndarray = field(default_factory=lambda: np.eye(4))
    mask_ids: Mapping[int, int] | None = None

    def truth(self) -> np.ndarray:
        """T_world_camera of its frames in the world of the whole, NaN where unknown."""
        own = self.sequence.ground_truth
        return np.full((len(self.sequence), 4, 4), np.nan) if own is None else self.T_joint_truth @ own

    def mask(self, ids: np.ndarray | None) -> np.ndarray | None:
        """A mask with the ids of the whole."""
        if ids is None or self.mask_ids is None:
            return ids
        table = np.zeros(1 << 16, np.uint16)
        table[list(self.mask_ids)] = list(self.mask_ids.values())
        return table[ids]

    def names(self) -> dict[int, str]:
        """Names of its objects by the ids of the whole."""
        own = self.sequence.instance_names
        if self.mask_ids is None:
            return dict(own)
        return {self.mask_ids[i]: name for i, name in own.items() if i in self.mask_ids}


class JoinedSequence(Sequence):
    """Recordings as one: `Frame.index` counts on from one to the next, `Frame.source_index` and `Frame.camera` are
    those of the frame's own recording. What a recording has one of (`camera`, `scale`, `path`, ...) is the first one's.

    Args:
        parts: one or more.
    """

    def __init__(self, parts: list[JoinedPart]) -> None:
        first = parts[0].sequence
        vars(self).update(vars(first))
        self.parts = parts
        self._starts = np.cumsum([0, *(len(part.sequence) for part in parts)])
        self._selection = range(int(self._starts[-1]))
        self._reopen, self.options, self._skipped, self.moving = None, None, {}, None
        self.timestamps = np.concatenate([part.sequence.timestamps + part.time_shift_s for part in parts])
        known = any(part.sequence.ground_truth is not None for part in parts)
        self.ground_truth = np.concatenate([part.truth() for part in parts]) if known else None
        self.has_masks = any(part.sequence.has_masks for part in parts)
        self.mask_problems = {}
        self.warnings = [warning for part in parts for warning in part.sequence.warnings]
        self.instance_names = {i: name for part in reversed(parts) for i, name in part.names().items()}
        same = all(part.sequence.camera == first.camera for part in parts)
        self.valid = first.valid if same else None

    def __getitem__(self, index: SupportsIndex | slice) -> Frame | Sequence:  # type: ignore[override]
        """See `Sequence`; there are no slices.

        Raises:
            SequenceError: a slice was asked for.
        """
        if isinstance(index, slice):
            raise SequenceError(f"{self.path}: several recordings read as one have no slices")
        return super().__getitem__(index)

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)

    def part_of(self, index: int) -> tuple[JoinedPart, int]:
        """The recording of frame `index`, and the frame's number there.

        Raises:
            SequenceError: no such frame.
        """
        if not 0 <= index < len(self):
            raise SequenceError(f"{self.path}: expected a frame from 0 to {len(self) - 1}, found {index}")
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self.parts[number], index - int(self._starts[number])

    def files(self, index: int) -> FrameFiles:
        """See `Sequence`."""
        part, own = self.part_of(index)
        return part.sequence.files(own)

    def mask_kinds(self) -> Counter[str]:
        """See `Sequence`."""
        return sum((part.sequence.mask_kinds() for part in self.parts), Counter())

    def frame(self, index: int, masks: ReadMasks = True) -> Frame:
        """See `Sequence`."""
        part, own = self.part_of(index)
        found = part.sequence.frame(own, masks)
        pose = found.T_world_camera
        joined = replace(
            found, index=index, timestamp=float(self.timestamps[index]), mask=part.mask(found.mask),
            T_world_camera=None if pose is None else part.T_joint_truth @ pose,
            mask_loader=None if found.mask_loader is None else partial(_load_mask, part, found),
        )  # fmt: skip
        return joined if self.moving is None else self.moving.without(joined)

    def _attempt(self, index: int, masks: ReadMasks) -> Frame | SkippedFrame:
        part, own = self.part_of(index)
        try:
            return self.frame(index, masks)
        except SequenceError as error:
            if part.sequence._on_bad_frame == "error":
                raise
            return SkippedFrame(index, part.sequence.selection[own], str(error))


def _load_mask(part: JoinedPart, frame: Frame) -> np.ndarray | None:
    return part.mask(frame.load_mask())
