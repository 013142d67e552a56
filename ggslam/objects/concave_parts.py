# SPDX-License-Identifier: Apache-2.0
"""What belongs to a thing although a gap parts it: the inside of a bowl or a mug behind its rim, and what lies behind a
frame all around, such as the panes of a window."""

from __future__ import annotations

import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.pixel_passes import Bodies, connected_pieces, count_contacts, find_bodies
from ggslam.objects.regions import Groups

_CONCAVE = -0.35
"""Correlation of normals and places below which a surface is the inside of something."""
_LARGEST = 0.4
"""Metres; a larger radius (root mean square) than this has no vessel."""
_RIM = 0.25
"""Share of an inside's outline that lies behind the rim of its vessel at least."""
_WIDER = 1.55
"""Inside and outside together are at most so many times as large as the larger of them."""
_HALF, _ENCLOSED = 0.5, 0.85
"""Share of a pane's outline that is its frame's at least: of all, and of what nothing hides."""
_BEHIND = 0.7
"""Share of that outline at which the pane is not before the frame."""
_FRAME = (0.04, 0.015)
"""How far panes lie behind their frame at most: metres, plus a share of the depth."""
_BEFORE = 0.001
"""...and before it: a share of the depth."""
_HIDES = (0.02, 0.005)
"""Where something stands so far before a pane, a curtain, it hides where the pane goes on: metres, plus a share of the
depth."""


def join_insides(groups: Groups, regions: np.ndarray, planes: int, surface: DepthSurface, pairs: np.ndarray) -> None:
    """Joins regions that are the inside of something with the outside before them.

    Args:
        groups: of the regions; changed in place.
        regions: int32 [H, W]; those up to `planes` are planes, 0 = none.
        pairs: int [n, 3], touching regions with the number of links between them.
    """
    bodies = find_bodies(np.where(regions > planes, regions, 0), surface)
    rim = np.bincount(pairs[:, :2].ravel(), np.repeat(pairs[:, 2], 2), len(bodies.count))
    for a, b, length in pairs[(pairs[:, :2] > planes).all(1)].tolist():
        for inside, vessel in ((a, b), (b, a)):
            if bodies.bend[inside] < _CONCAVE and length >= _RIM * rim[inside] and _fits(bodies, inside, vessel):
                groups.join(inside, vessel)


def _fits(bodies: Bodies, inside: int, vessel: int) -> bool:
    larger = max(bodies.radius[inside], bodies.radius[vessel])
    if larger > _LARGEST:
        return False
    n, m = bodies.count[inside], bodies.count[vessel]
    apart = float(np.sum((bodies.centre[inside] - bodies.centre[vessel]) ** 2))
    together = n * bodies.radius[inside] ** 2 + m * bodies.radius[vessel] ** 2 + n * m / (n + m) * apart
    return bool(np.sqrt(together / (n + m)) <= _WIDER * larger)


def join_panes(regions: np.ndarray, surface: DepthSurface) -> np.ndarray:
    """Regions int32 [H, W] (0 = none) with pieces that one other region frames given to that."""
    pieces = connected_pieces(regions)
    n = int(pieces.max()) + 1
    owner = np.zeros(n, np.int64)
    owner[pieces.ravel()] = regions.ravel()
    pairs, counts = count_contacts(pieces, owner, surface.depth, _FRAME, _HIDES, _BEFORE)
    (piece, frame), (length, near, behind, hidden) = pairs.T, counts.T
    # What stands before the pane, or the image's border, cuts it off: who knows what is there.
    seen = np.bincount(piece, length - hidden, n)
    outline = np.bincount(np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]]), minlength=n)
    outline = outline + np.bincount(piece, length, n)
    framed = (length >= _HALF * outline[piece]) & (near >= _ENCLOSED * seen[piece])
    framed &= (near >= _BEHIND * length) & (behind >= _BEHIND * length)
    framed &= (frame > 0) & (owner[piece] > 0) & (frame != owner[piece])
    area = np.bincount(pieces.ravel(), minlength=n)
    whole = np.bincount(owner, area)
    target = owner.copy()
    for k in np.flatnonzero(framed):
        if area[piece[k]] < 4 * whole[frame[k]]:
            target[piece[k]] = frame[k]
    return target.astype(np.int32)[pieces]
