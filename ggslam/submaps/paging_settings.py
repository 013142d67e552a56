# SPDX-License-Identifier: Apache-2.0
"""Settings of Gaussian paging: what of a map is kept in memory when not all of it fits."""

from __future__ import annotations

from dataclasses import dataclass

from ggslam.errors import check_ranges


@dataclass(frozen=True)
class PagingSettings:
    """How a run keeps to its memory limit. Without a limit (`memory_limit_mb` 0) none of this has any effect."""

    cell: float = 2.0
    """Edge in metres of the cells that Gaussians move to disk by; finer cells follow the view more closely."""
    keep_radius: float = 3.0
    """Cells whose centres are nearer to the camera than this, in metres, stay in memory, seen or not."""
    view_range: float = 12.0
    """Farther than this from the camera, in metres, the map is not needed to render a view..."""
    view_margin: float = 1.1
    """...nor farther than the deepest that was measured in a part of the view (a tile of the image), times this..."""
    view_spare: float = 0.3
    """...and this many metres more. Gaussians behind what is measured are hidden by what lies before them; where
    nothing was measured, nothing is trained but colour."""
    budget_mb: float = 0.0
    """10^6 bytes that map and keyframe images may take; 0: the memory limit less what the program itself was measured
    to need. With a number of one's own, a run repeats bit for bit; measured ones differ a little between runs."""
    images: float = 0.25
    """Share of the budget for the images and points of keyframes; the last used ones are kept in it."""
    slack: float = 0.1
    """When Gaussians must go, this share of their budget is freed beyond need, so that it does not happen each time."""

    def __post_init__(self) -> None:
        ranges = {
            "cell": (0.1, 1e4), "keep_radius": (0, 1e6), "view_range": (0.1, 1e6), "view_margin": (1, 100),
            "view_spare": (0, 1e6),
            "budget_mb": (0, 1e9), "images": (0.01, 0.9), "slack": (0, 0.9),
        }  # fmt: skip
        check_ranges(self, ranges)
