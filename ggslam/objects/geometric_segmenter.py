# SPDX-License-Identifier: Apache-2.0
"""Segments from one depth image without any learned model.

Large planes are taken out first: they are what things stand on and hang on. What remains falls apart at depth jumps
and at concave edges (Tateno et al., "Real-time and scalable incremental segmentation on dense SLAM", IROS 2015), and
pieces that meet in a convex edge are put together again (Stein et al., "Object Partitioning using Local Convexity",
CVPR 2014).
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.objects.border_kinds import is_convex, is_hollow, is_painted, lies_on
from ggslam.objects.concave_parts import join_insides, join_panes
from ggslam.objects.depth_surface import DepthSurface, surface_of
from ggslam.objects.overhangs import join_overhangs
from ggslam.objects.pixel_passes import connected_pieces, grow_regions, link_surfaces, share_near_planes
from ggslam.objects.plane_colors import colors_to_compare, find_flat_things
from ggslam.objects.plane_parts import part_planes
from ggslam.objects.planes import find_planes
from ggslam.objects.regions import Borders, Groups, find_borders
from ggslam.objects.settings import GeometricSettings
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class RegionTuning(Tuning):
    """How regions become segments."""

    flake_area = 6
    """Regions below this multiple of the smallest area are flakes."""
    flake_closed = 0.6
    """Share of a flake's outline without a gap from which it joins its neighbour."""
    growth = 4
    """Pixels that regions grow by, for images 320 wide."""
    min_flat_border = 12
    """Fewest pixels of border between a plane and a flat region on it."""
    min_flat = 0.9
    """Smallest share of a flat region near its plane."""
    alike_contrast = 0.75
    """Contrast below which regions look alike, as a share of the contrast that tells objects apart."""


_SQUARE = np.ones((3, 3), np.uint8)


class GeometricSegmenter:
    """Class-agnostic segments of single RGB-D frames. Keeps nothing from frame to frame."""

    def __init__(self, settings: GeometricSettings | None = None) -> None:
        self._settings = settings or GeometricSettings()

    def segment(self, color: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """Segments of one frame.

        Args:
            color: uint8 [H, W, 3].
            depth: float32 [H, W], metres, 0 = unknown.
            camera: intrinsics of both.

        Returns:
            uint16 [H, W], 1 to n by size, largest first; 0 = no depth, or too small to tell.
        """
        surface = surface_of(depth, camera, self._settings.max_depth_m)
        if not surface.valid.any():
            return np.zeros(depth.shape, np.uint16)
        plane_of, planes = part_planes(*find_planes(surface, camera, self._settings), surface, camera, self._settings)
        regions, body_of = self._join_regions(self._regions(surface, plane_of), plane_of, planes, surface, color)
        regions = join_panes(regions, surface)
        things = find_flat_things(color, np.where(regions <= len(planes), regions, 0), self._settings)
        regions = np.where(things > 0, len(body_of) + things, body_of[regions])
        return _by_size(regions, surface.valid, self._settings.min_area)

    def _regions(self, surface: DepthSurface, plane_of: np.ndarray) -> np.ndarray:
        """Planes, and the smooth pieces of the rest: int32 [H, W] from 1 on, 0 = no depth or a crumb."""
        rest = surface.valid & (plane_of == 0)
        closed, smooth = link_surfaces(surface, rest, self._settings)
        pieces = connected_pieces(rest, smooth)
        area = np.bincount(pieces[rest], minlength=int(pieces.max()) + 1)
        # Strips along edges, where normals are blurred, are left to be grown over.
        inner = cv2.erode(rest.astype(np.uint8), _SQUARE) > 0
        wide = pieces.astype(np.float32)
        inner &= cv2.erode(wide, _SQUARE) == cv2.dilate(wide, _SQUARE)
        has_inner = np.bincount(pieces[inner], minlength=len(area)) > 0
        kept = np.flatnonzero(has_inner & (area >= self._settings.min_area * rest.size))
        number = np.zeros(len(area), np.int32)
        number[kept] = int(plane_of.max()) + 1 + np.arange(len(kept))
        regions = np.where(rest, number[pieces], plane_of)
        return grow_regions(regions, surface.valid, closed, RegionTuning.growth * surface.step)

    def _join_regions(
        self, regions: np.ndarray, plane_of: np.ndarray, planes: np.ndarray, surface: DepthSurface, color: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Regions with convex and smooth neighbours joined; what is flat on a plane and looks like it is the plane. And
        the number of the body that each region is a face of, by region."""
        settings = self._settings
        borders = find_borders(regions, surface, plane_of, planes, colors_to_compare(color), surface.step + 1, settings)
        groups = Groups(int(regions.max()) + 1)
        convex, lies = is_convex(borders), lies_on(borders, regions, planes, surface, settings)
        alike = ~convex & (borders.contrast < RegionTuning.alike_contrast * settings.color_contrast)
        parts = is_hollow(borders, len(planes)) | self._is_flat(borders, alike, regions, planes, surface)
        bodies = convex & ~is_painted(borders, settings.color_contrast) & ~lies
        for k in np.flatnonzero(bodies | (alike & parts)):
            groups.join(*borders.pairs[k].tolist())
        pairs = np.column_stack([borders.pairs, borders.length])
        join_insides(groups, regions, len(planes), surface, pairs)
        joined = groups.roots().astype(np.int32)[regions]
        joined = _without_flakes(joined, len(planes), borders, groups, self._settings.min_area, lies)
        join_overhangs(groups, regions, surface, pairs)
        return joined, groups.roots().astype(np.int32)

    def _is_flat(
        self, borders: Borders, asked: np.ndarray, regions: np.ndarray, planes: np.ndarray, surface: DepthSurface
    ) -> np.ndarray:
        """bool [n]: those of the borders `asked` that part a plane and something that lies flat on it."""
        first, second = borders.pairs.T
        asked = (
            asked & (first <= len(planes)) & (second > len(planes)) & (borders.length >= RegionTuning.min_flat_border)
        )
        flat, places = np.zeros(len(asked), bool), np.flatnonzero(asked & (borders.closed >= 0.5 * borders.length))
        questions = [(int(second[k]), planes[first[k] - 1]) for k in places]
        flat[places] = (
            share_near_planes(surface.points, regions, questions, self._settings.flat_m) >= RegionTuning.min_flat
        )
        return flat


def _without_flakes(
    regions: np.ndarray, planes: int, borders: Borders, groups: Groups, min_area: float, things: np.ndarray
) -> np.ndarray:
    """Small regions that lie on one neighbour without a gap for most of their rim join it: noise that rose above the
    tolerance of a plane. Not across borders of `things`, bool [n]."""
    area = np.bincount(regions.ravel(), minlength=int(regions.max()) + 1)
    roots = groups.roots()
    ends = roots[borders.pairs]
    rim = np.zeros(len(roots), np.int64)
    best: dict[int, tuple[int, int]] = {}
    outer = ends[:, 0] != ends[:, 1]
    for (a, b), length, closed, concave, thing in zip(
        ends[outer].tolist(), borders.length[outer].tolist(), borders.closed[outer].tolist(),
        borders.concave[outer].tolist(), things[outer].tolist(), strict=True,
    ):  # fmt: skip
        for flake, other in ((a, b), (b, a)):
            rim[flake] += length
            if not thing and closed - concave > best.get(flake, (0, 0))[0]:
                best[flake] = (closed - concave, other)
    for flake in sorted(best, key=lambda k: area[k]):
        joined, other = best[flake]
        small = flake > planes and area[flake] < RegionTuning.flake_area * min_area * regions.size
        if small and joined >= RegionTuning.flake_closed * rim[flake]:
            groups.join(flake, other)
    return groups.roots().astype(np.int32)[regions]


def _by_size(regions: np.ndarray, valid: np.ndarray, min_area: float) -> np.ndarray:
    area = np.bincount(regions[valid], minlength=int(regions.max()) + 1)
    area[0] = 0
    order = np.argsort(-area, kind="stable")
    order = order[area[order] >= max(1, min_area * regions.size)]
    number = np.zeros(len(area), np.uint16)
    number[order] = np.arange(1, len(order) + 1)
    return np.where(valid, number[regions], np.uint16(0))
