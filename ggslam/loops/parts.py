# SPDX-License-Identifier: Apache-2.0
"""Parts of a recording. Poses are consistent within a part; different parts lie at arbitrary places.

A recording is one part until the camera is lost and tracking goes on elsewhere (`slam.part_start`). A loop between two
parts makes them one. This is the atlas of ORB-SLAM3 (Campos et al., T-RO 2021) with one map.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from ggslam.system.array_forms import check_indices
from ggslam.system.savable import savable


@savable(check="check")
@dataclass
class KeyframeParts:
    """Which part each keyframe belongs to.

    Attributes:
        of: by keyframe, the number of the oldest keyframe of its part.
        begun: the keyframes that began a part, in order: the second one began "part 2".
    """

    of: list[int] = field(default_factory=list)
    begun: list[int] = field(default_factory=list)

    def check(self) -> None:
        """Raises FormatError if a keyframe is of a part that a later one began: it may come from a file."""
        check_indices("parts of keyframes", self.begun, len(self.of))
        for keyframe, part in enumerate(self.of):
            check_indices("parts of keyframes", [part], keyframe + 1)

    def begin(self) -> None:
        """The next keyframe begins a part."""
        self.begun.append(len(self.of))
        self.of.append(len(self.of))

    def add(self, before: int) -> None:
        """The next keyframe lies right to an earlier one; the first one begins the first part."""
        if before < 0:
            self.begin()
        else:
            self.of.append(self.of[before])

    def join(self, one: int, other: int) -> None:
        """The parts of two keyframes are one from now on."""
        kept, gone = sorted((self.of[one], self.of[other]))
        self.of = [kept if part == gone else part for part in self.of]

    def together(self, one: int, other: int) -> bool:
        """Whether two keyframes are of one part."""
        return self.of[one] == self.of[other]

    def members(self, keyframe: int) -> set[int]:
        """Numbers of the keyframes of the same part."""
        part = self.of[keyframe]
        return {k for k, own in enumerate(self.of) if own == part}

    def all(self) -> list[int]:
        """The parts there are, each as its oldest keyframe, in order."""
        return sorted(set(self.of))

    def name(self, keyframes: Iterable[int]) -> str:
        """Which of the begun parts some keyframes of one part are made of: "part 2", "parts 2 and 3"."""
        own = set(keyframes)
        numbers = [str(k + 1) for k, first in enumerate(self.begun) if first in own]
        if len(numbers) < 2:
            return f"part {''.join(numbers)}"
        return f"parts {', '.join(numbers[:-1])} and {numbers[-1]}"
