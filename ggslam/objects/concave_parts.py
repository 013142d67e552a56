# SPDX-License-Identifier: Apache-2.0
"""What belongs to a thing although a gap parts it: the inside of a bowl or a mug behind its rim, and what lies behind a
frame all around, such as the panes of a window."""

from __future__ import annotations

import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.pixel_passes import Bodies, connected_pieces, count_contacts, find_bodies
from ggslam.objects.regions import Groups
from ggslam.system.tuning import Tuning


class ConcavePartTuning(Tuning):
    """When a gap parts one object."""

    max_bend = -0.35
    """Correlation of normals and positions below which a surface is an inside."""
    max_radius_m = 0.4
    """Largest radius of a vessel (root mean square), in metres."""
    min_rim = 0.25
    """Smallest share of an inside's outline behind the rim of its vessel."""
    max_growth = 1.55
    """Inside and outside together are at most this many times as large as the larger."""
    min_framed = 0.5
    """Smallest share of a pane's outline at its frame."""
    min_framed_seen = 0.85
    """The same of the outline that nothing hides."""
    min_behind = 0.7
    """Smallest share of that outline at which the pane is not in front of the frame."""
    frame_depth = (0.04, 0.015)
    """How far panes lie behind their frame at most: metres, and a share of the depth."""
    before_share = 0.001
    """How far they lie in front of it at most, as a share of the depth."""
    hiding = (0.02, 0.005)
    """Something this far in front of a pane hides where it goes on: metres, and a share of the depth."""


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
            if (
                bodies.bend[inside] < ConcavePartTuning.max_bend
                and length >= ConcavePartTuning.min_rim * rim[inside]
                and _fits(bodies, inside, vessel)
            ):
                groups.join(inside, vessel)


def _fits(bodies: Bodies, inside: int, vessel: int) -> bool:
    larger = max(bodies.radius[inside], bodies.radius[vessel])
    if larger > ConcavePartTuning.max_radius_m:
        return False
    n, m = bodies.count[inside], bodies.count[vessel]
    apart = float(np.sum((bodies.centre[inside] - bodies.centre[vessel]) ** 2))
    together = n * bodies.radius[inside] ** 2 + m * bodies.radius[vessel] ** 2 + n * m / (n + m) * apart
    return bool(np.sqrt(together / (n + m)) <= ConcavePartTuning.max_growth * larger)


def join_panes(regions: np.ndarray, surface: DepthSurface) -> np.ndarray:
    """Regions int32 [H, W] (0 = none) with pieces that one other region frames given to that."""
    pieces = connected_pieces(regions)
    n = int(pieces.max()) + 1
    owner = np.zeros(n, np.int64)
    owner[pieces.ravel()] = regions.ravel()
    pairs, counts = count_contacts(
        pieces,
        owner,
        surface.depth,
        ConcavePartTuning.frame_depth,
        ConcavePartTuning.hiding,
        ConcavePartTuning.before_share,
    )
    (piece, frame), (length, near, behind, hidden) = pairs.T, counts.T
    # What stands before the pane, or the image's border, cuts it off: who knows what is there.
    seen = np.bincount(piece, length - hidden, n)
    outline = np.bincount(np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]]), minlength=n)
    outline = outline + np.bincount(piece, length, n)
    framed = (length >= ConcavePartTuning.min_framed * outline[piece]) & (
        near >= ConcavePartTuning.min_framed_seen * seen[piece]
    )
    framed &= (near >= ConcavePartTuning.min_behind * length) & (behind >= ConcavePartTuning.min_behind * length)
    framed &= (frame > 0) & (owner[piece] > 0) & (frame != owner[piece])
    area = np.bincount(pieces.ravel(), minlength=n)
    whole = np.bincount(owner, area)
    target = owner.copy()
    for k in np.flatnonzero(framed):
        if area[piece[k]] < 4 * whole[frame[k]]:
            target[piece[k]] = frame[k]
    return target.astype(np.int32)[pieces]
