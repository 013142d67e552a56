# SPDX-License-Identifier: Apache-2.0
"""What the borders between the regions of a depth image say: which regions are one body, and which thing lies on what.
"""

from __future__ import annotations

import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.regions import Borders
from ggslam.objects.settings import GeometricSettings
from ggslam.system.tuning import Tuning


class BorderTuning(Tuning):
    """What the border of two regions means."""

    convex_closed = 0.6
    """Smallest share of a convex border that has no gap."""
    convex_bent = 0.25
    """Largest share of it that is concave."""
    hollow_share = 0.3
    """Share of the shorter outline from which a border is long."""
    even_bent = 0.25
    """Largest share of an even border that is bent."""
    painted_contrast = 1.5
    """Contrast across a painted border, as a multiple of the contrast that tells objects apart."""
    enclosed_share = 0.7
    """Share of the shorter outline from which a region is enclosed."""
    min_ground = 0.04
    """Smallest share of the image of a plane that things lie on."""
    max_on_ground = 0.05
    """Largest share of that plane which a thing covers."""
    min_height = 1.5
    """Smallest median height of a thing above the plane, in tolerances of the plane."""


def is_convex(borders: Borders) -> np.ndarray:
    """bool [n]: borders mostly without a gap and hardly anywhere concave."""
    closed = borders.closed >= BorderTuning.convex_closed * borders.length
    judged = (borders.judged >= 3) & (borders.judged >= 0.3 * borders.length)
    return closed & judged & (borders.concave <= BorderTuning.convex_bent * borders.judged)


def is_painted(borders: Borders, color_contrast: float) -> np.ndarray:
    """bool [n]: borders that are no edge, at which the colour changes: smooth, but not for being one body. A curtain
    hangs before a window, by less than the noise of its depth. A picture in its frame is one thing."""
    even = (borders.bent <= BorderTuning.even_bent * borders.judged) & (
        borders.length < BorderTuning.enclosed_share * _shorter_outline(borders)
    )
    return even & (borders.contrast >= BorderTuning.painted_contrast * color_contrast) & (color_contrast > 0)


def lies_on(
    borders: Borders, regions: np.ndarray, planes: np.ndarray, surface: DepthSurface, settings: GeometricSettings
) -> np.ndarray:
    """bool [n]: borders between a large plane and a small thing of another colour that lies on it. So few pixels do not
    show that the edge is concave, or that the thing is no noise: that it is clearly off the plane does."""
    if not settings.color_contrast:
        return np.zeros(len(borders.length), bool)
    area = np.bincount(regions.ravel(), minlength=int(borders.pairs.max(initial=0)) + 1)
    first, second = borders.pairs.T
    asked = (
        (first <= len(planes))
        & (second > len(planes))
        & (borders.contrast >= BorderTuning.painted_contrast * settings.color_contrast)
    )
    asked &= (area[first] >= BorderTuning.min_ground * regions.size) & (
        area[second] < BorderTuning.max_on_ground * area[first]
    )
    asked &= borders.length >= 0.5 * _shorter_outline(borders)
    wanted = np.zeros(len(area), bool)
    wanted[second[asked]] = True
    inside = np.flatnonzero(wanted[regions.ravel()])
    number, points = regions.ravel()[inside], surface.points.reshape(-1, 3)[inside]
    tolerance = settings.tolerance_sigmas * surface.sigma + settings.tolerance_m / points[:, 2] ** 2
    for k in np.flatnonzero(asked):
        own = number == second[k]
        off = np.abs(points[own] @ planes[first[k] - 1] - 1) / points[own, 2]
        asked[k] = np.median(off / tolerance[own]) > BorderTuning.min_height
    return asked


def is_hollow(borders: Borders, planes: int) -> np.ndarray:
    """bool [n]: borders between two things, none of them a plane, that make up much of the outline of one: perhaps the
    inside and the outside of a bowl."""
    return (borders.pairs[:, 0] > planes) & (borders.length >= BorderTuning.hollow_share * _shorter_outline(borders))


def _shorter_outline(borders: Borders) -> np.ndarray:
    """Of each border, links about the region that has fewer, [n]."""
    rim = np.bincount(borders.pairs.ravel(), np.repeat(borders.length, 2), int(borders.pairs.max(initial=0)) + 1)
    return rim[borders.pairs].min(1)
