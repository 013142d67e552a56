# SPDX-License-Identifier: Apache-2.0
"""Settings of Gaussian paging: what of a map is kept in memory when not all of it fits."""

from __future__ import annotations

from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class PagingSettings:
    """How a run keeps to its memory limit. Without a limit (`memory_limit_mb` 0) none of this has any effect."""

    cell: float = setting(2.0, 0.1, 1e4, "m")
    """Edge of the cells that Gaussians move to disk by; finer cells follow the view more closely."""
    keep_radius: float = setting(3.0, 0, 1e6, "m")
    """Cells whose centres are nearer to the camera than this stay in memory, seen or not."""
    view_range: float = setting(12.0, 0.1, 1e6, "m")
    """Farther than this from the camera the map is not needed to render a view."""
    view_margin: float = setting(1.1, 1, 100)
    """A part of the view (a tile of the image) needs the map up to the deepest that was measured in it times this, and
    `view_spare`."""
    view_spare: float = setting(0.3, 0, 1e6, "m")
    """Added to what `view_margin` allows. Gaussians behind what is measured are hidden by what lies before them; where
    nothing was measured, nothing is trained but colour."""
    budget_mb: float = setting(0.0, 0, 1e9, "MB")
    """What map and keyframe images may take; 0: the memory limit less what the program itself was measured to need.
    With a number of one's own, a run repeats bit for bit; measured ones differ a little between runs."""
    images: float = setting(0.25, 0.01, 0.9)
    """Share of the budget for the images and points of keyframes; the last used ones are kept in it."""
    slack: float = setting(0.1, 0, 0.9)
    """When Gaussians must go, this share of their budget is freed beyond need, so that it does not happen each time."""
