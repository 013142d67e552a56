# SPDX-License-Identifier: Apache-2.0
"""Changes between two visits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ggslam.changes.alignment_score import Fit
from ggslam.changes.candidates import Candidate
from ggslam.sight.margin import Margin

Kind = Literal["moved", "removed", "added", "look", "unseen"]
HARDLY_SEEN = "hardly looked at by the newer visit"
UNCLEAR = "changed, and how cannot be told"
"""Why nothing is said of a thing."""


@dataclass(frozen=True)
class Change:
    """A change of one object.

    Attributes:
        kind: see `Kind`; "unseen": of the older visit, and the newer one did not look there, or saw too little to tell.
        old, new: the thing in either visit; None: it is not there.
        T_new_old: float64 [4, 4], world: what moved; None of other kinds.
        fit: how a moved thing's surfaces lie upon each other.
        confidence: 0 to 1.
        reason: of what is unseen: why nothing is said of it.
    """

    kind: Kind
    old: Candidate | None
    new: Candidate | None
    T_new_old: np.ndarray | None = None
    fit: Fit | None = None
    confidence: float = 1.0
    reason: str = ""


@dataclass
class Detection:
    """Result of change detection.

    Attributes:
        changes: of all kinds but "unseen", the surest first.
        unseen: things of the older visit of which nothing is said.
        ids_believed: whether one id means one thing in both visits.
        stayed: number of objects of the older visit that are where they were.
        tolerance: how near surfaces had to be to be one.
        notes: what the user should know.
    """

    changes: list[Change] = field(default_factory=list)
    unseen: list[Change] = field(default_factory=list)
    ids_believed: bool = False
    stayed: int = 0
    tolerance: Margin = field(default_factory=lambda: Margin(0.0, 0.0))
    notes: list[str] = field(default_factory=list)
