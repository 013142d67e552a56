# SPDX-License-Identifier: Apache-2.0
"""Tells the mapper which parts of the map are in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np


class Residency(Protocol):
    """Knows which keyframes see nothing but Gaussians that are in memory."""

    @property
    def is_whole(self) -> bool:
        """Whether all Gaussians are in memory."""

    def trainable(self) -> Sequence[int]:
        """Numbers of these keyframes, rising; at least one if there are any."""

    def stages(self) -> Iterator[Sequence[int]]:
        """All keyframes, some after the others: while numbers are handed out, these are trainable."""

    def scale_colors(self, gain: np.ndarray) -> None:
        """Gaussians on disk get another exposure, as those in memory did: a gain for each channel [3]."""
