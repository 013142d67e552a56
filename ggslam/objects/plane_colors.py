# SPDX-License-Identifier: Apache-2.0
"""What colour says where depth says nothing: things that lie flat on a plane, such as papers on a table, pictures on a
wall or a stove in a counter.

A plane falls apart at edges of colour. A piece is a thing if the plane has its colour nowhere else (tiles, boards and
drawers repeat), if it differs in more than brightness (shadows do not), and if it is compact.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.objects.outlier_colors import HUE, OutlierColorTuning, find_outlier_colors
from ggslam.objects.pixel_passes import connected_pieces, count_alike
from ggslam.objects.settings import GeometricSettings
from ggslam.system.tuning import Tuning


class FlatThingTuning(Tuning):
    """When a patch of colour on a plane is an object."""

    width = 160
    """Image width at which colours are compared, in pixels."""
    min_plane = 0.04
    """Smallest share of the image that a plane covers."""
    min_area = 2.5e-3
    """Smallest area, as a share of the image."""
    max_area = 0.4
    """Largest area, as a share of its plane."""
    link = 0.6
    """Neighbouring pixels are joined up to this share of the contrast that tells objects apart."""
    repeated = 0.5
    """Most of its colour elsewhere on the plane: a share of its area..."""
    repeated_on_plane = 0.01
    """...plus this share of the plane."""
    min_solid = 0.6
    """Smallest share of its convex hull that it fills."""
    min_sure = 0.1
    """Smallest share of it that differs by more than a shadow does."""


_SQUARE = np.ones((3, 3), np.uint8)


def colors_to_compare(color: np.ndarray) -> np.ndarray:
    """CIELAB, each channel scaled to 0 to 255, float32 [H, W, 3], a little blurred, of an image uint8 [H, W, 3]."""
    return cv2.cvtColor(cv2.blur(color, (3, 3)), cv2.COLOR_RGB2LAB).astype(np.float32)


def find_flat_things(color: np.ndarray, plane_of: np.ndarray, settings: GeometricSettings) -> np.ndarray:
    """Things that differ from the plane around them by colour alone.

    Args:
        color: uint8 [H, W, 3].
        plane_of: number of each pixel's plane, int32 [H, W], 0 = none.
        settings: contrast.

    Returns:
        int32 [H, W], number of each pixel's thing from 1 on, 0 = none.
    """
    found = np.zeros(plane_of.shape, np.int32)
    if not settings.color_contrast:
        return found
    size = FlatThingTuning.width, max(1, round(plane_of.shape[0] * FlatThingTuning.width / plane_of.shape[1]))
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    plane = cv2.resize(plane_of.astype(np.float32), size, interpolation=cv2.INTER_NEAREST).astype(np.int32)
    areas = np.bincount(plane.ravel())
    large = areas >= FlatThingTuning.min_plane * plane.size
    large[0] = False
    if not large.any():
        return found
    plane[~large[plane]] = 0
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32)
    things = np.zeros(plane.shape, np.int32)
    pieces = connected_pieces(plane, _links(plane, lab, FlatThingTuning.link * settings.color_contrast))
    for number in np.flatnonzero(large):
        strange = _outlier_pieces(pieces, plane == number, lab, settings.color_contrast)
        kind = find_outlier_colors(lab, plane == number, pieces, settings.color_contrast)
        _add_compact(things, strange | (kind > 0), strange | (kind == HUE), plane == number)
    enlarged = cv2.resize(things.astype(np.float32), plane_of.shape[::-1], interpolation=cv2.INTER_NEAREST)
    found = enlarged.astype(np.int32)
    on_plane = cv2.resize(plane.astype(np.float32), plane_of.shape[::-1], interpolation=cv2.INTER_NEAREST)
    found[on_plane != plane_of] = 0
    return found


def _links(plane: np.ndarray, lab: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Whether a pixel belongs with its right and its lower neighbour, bool [h, w-1] and [h-1, w]."""
    links = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = lab[a] - lab[b]
        links.append((plane[a] == plane[b]) & (np.einsum("ijk,ijk->ij", step, step) < limit**2))
    return links[0], links[1]


def _outlier_pieces(pieces: np.ndarray, inside: np.ndarray, lab: np.ndarray, contrast: float) -> np.ndarray:
    """Pixels of the pieces of a plane (bool [h, w]) whose colour is their own, bool [h, w]."""
    out = np.zeros(inside.shape, bool)
    numbers, colors = pieces[inside], lab[inside]
    area = np.bincount(numbers)
    candidates = np.flatnonzero(
        (area >= FlatThingTuning.min_area * inside.size) & (area <= FlatThingTuning.max_area * len(numbers))
    )
    means = np.array([colors[numbers == piece].mean(0) for piece in candidates], np.float32).reshape(-1, 3)
    alike = count_alike(colors, numbers, candidates, means, contrast)
    single = alike <= FlatThingTuning.repeated * area[candidates] + FlatThingTuning.repeated_on_plane * len(numbers)
    for piece, mean in zip(candidates[single], means[single], strict=True):
        rest = colors[numbers != piece]
        usual = np.median(rest, 0)
        hue = float(np.linalg.norm(mean[1:] - usual[1:]))
        shade = mean[0] / max(usual[0], 1.0)
        if hue >= 0.5 * contrast or not OutlierColorTuning.shade[0] < shade < OutlierColorTuning.shade[1]:
            out |= pieces == piece
    return out


def _add_compact(things: np.ndarray, strange: np.ndarray, sure: np.ndarray, inside: np.ndarray) -> None:
    """Numbers what hangs together of `strange`, is compact and partly `sure` to be no shadow; with what it encloses."""
    if not strange.any():
        return
    grown = cv2.dilate(strange.astype(np.uint8), _SQUARE) & inside
    # Pieces within one another's convex hulls are one thing: the frame of a picture and what it shows.
    together = _hulls(_hulls(grown))
    _, number = cv2.connectedComponents(together, connectivity=4, ltype=cv2.CV_32S)
    # Growing bridged gaps; a thing ends where its own pixels do.
    number[~inside | ((cv2.erode(together, _SQUARE) == 0) & ~strange)] = 0
    area, own = np.bincount(number.ravel()), np.bincount(number[grown > 0], minlength=int(number.max()) + 1)
    least, most = FlatThingTuning.min_area * inside.size, FlatThingTuning.max_area * np.count_nonzero(inside)
    certain = np.bincount(number[sure], minlength=len(area))
    compact = (
        (area >= least)
        & (area <= most)
        & (own >= FlatThingTuning.min_solid * area)
        & (certain >= FlatThingTuning.min_sure * area)
    )
    for k in np.flatnonzero(compact):
        if k:
            things[number == k] = things.max() + 1


def _hulls(image: np.ndarray) -> np.ndarray:
    """Convex hulls of the connected pieces of uint8 [h, w], drawn into one."""
    outlines, _ = cv2.findContours(image, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros_like(image), [cv2.convexHull(o) for o in outlines], -1, 1, cv2.FILLED)
