# SPDX-License-Identifier: Apache-2.0
"""Aligns laser scans to the surface of a map: from a good guess, or from one that is metres and degrees off.

Far from the pose the nearest surface is another one. A search therefore starts with voxels as wide as the start may be
off, whose planes are few and large, with a kernel of their size, and halves both until the map's own voxels take over.

Most of what a scan sees from near is ground, which matches at any place of a flat world, and walls match along a whole
street. Whether a pose found from far off is the right one is therefore judged by the direction of motion that matches
tell the least of: the points that match across it, against those that match nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ggslam.localization.localizer import ANY_NORMAL
from ggslam.localization.surface import SCAN_TARGET, Surface
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import orthonormalize, rotation_about, separation, transform_points
from ggslam.system.settings import setting, settings_class, tuning_class
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, align
from ggslam.tracking.points import FramePoints
from ggslam.tracking.scan_points import ScanSettings, scan_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, TargetSettings
from ggslam.tracking.surface import SurfaceTuning, quaternions_from_normals


class ScanAlignmentTuning(Tuning):
    """Alignment of scans."""

    opacity_logit = 3.0
    """Opacity of the map's points, as a logit."""
    kernel_voxels = 0.6
    """Width of the robust kernel of a search, in voxels."""
    coarse_voxels = 4
    """Width of a target's coarse voxels, in fine ones."""
    max_iterations = 30
    """Most iterations of a stage of a search."""
    min_step = 1e-3
    """Last step of a stage, in metres and radians."""
    voxel_sigmas = 8
    """Standard deviations in a voxel's edge, at least: sparse maps know their surfaces no better."""
    plain_overlap = 0.9
    """Overlap from which a pose is accepted with an unobserved direction, which is then reported."""
    promising_share = 0.35
    """Share of the required overlap that thinned points must reach: more of them are far away or seldom seen."""
    max_repeats = 4
    """Most alignments, each from the result of the one before."""
    settled_m = 0.002
    """Shift of an alignment, in metres, below which it has converged."""
    around = (0.5, -0.5)
    """Further starts beside the guess along two horizontal directions, as shares of the reach."""
    min_across = np.cos(np.radians(60))
    """Cosine of the angle to a direction within which a normal's surface lies across that direction."""




@tuning_class(frozen=True)
class SearchTuning:
    """Numbers of the search for a pose."""

    turn_deg: float = setting(12.0, 0, 180, "deg")
    """Initial poses turned by this angle either way about the vertical are tried too."""
    voxel: float = setting(1.0, 1e-3, 100, "m")
    """One point is used per cube of this edge in the search."""
    min_structure: float = setting(0.42, 0, 1)
    """Least share of matches among the points that constrain the weakest direction of motion."""


@settings_class(frozen=True)
class SearchSettings(SearchTuning):
    """How a scan is located whose initial pose is far off: the first one, and those that were lost."""

    reach: float = setting(2.4, 0, 100, "m")
    """Largest distance, roughly, from which a search converges; 0: no search."""


@dataclass(frozen=True)
class ScanMatch:
    """A scan, aligned to the map.

    Attributes:
        found: the alignment of the points that the map can contain.
        counted: how many those are.
        total: points of the scan, evenly spread.
        target: what was aligned to.
        inlier: metres to the surface within which a point matches.
    """

    found: AlignmentResult
    counted: int
    total: int
    target: GicpTarget
    inlier: float

    @property
    def pose(self) -> np.ndarray:
        """T_world_sensor, float64 [4, 4]."""
        return orthonormalize(self.found.T_world_camera)

    @cached_property
    def structure(self) -> float:
        """Share that matches of the points that tell of the least seen direction of motion."""
        normals = self._normals
        if not len(normals):
            return 0.0
        across = int((np.abs(normals @ self.weakest) > ScanAlignmentTuning.min_across).sum())
        return across / max(1, across + self.counted - len(normals))

    @cached_property
    def weakest(self) -> np.ndarray:
        """The direction of motion that matches tell the least of, unit vector [3] in the world."""
        return _directions(self._normals)[:, 0]

    @cached_property
    def _normals(self) -> np.ndarray:
        """Of the surfaces that points match, [n, 3]."""
        matches = self.found.matches.read()
        matched = matches.squared_distances < self.inlier**2  # infinite without a match
        return self.target.normals(matches.voxels[matched])

    @property
    def beyond(self) -> float:
        """Share of the points that lie beyond what the map can contain."""
        return 1 - self.counted / max(1, self.total)


class ScanSource:
    """Points of one scan, dense for aligning and sparse for searching.

    Args:
        points: [n, 3], metres, in the sensor's frame.
        settings: which are used.
        sparse: edge of the cubes that one point each is searched with, metres.
    """

    def __init__(self, points: np.ndarray, settings: ScanSettings, sparse: float) -> None:
        self.dense = scan_points(points, settings)
        self._settings, self._width = settings, sparse
        self._sparse: FramePoints | None = None

    @property
    def sparse(self) -> FramePoints:
        """For searching."""
        if self._sparse is None:
            width = max(self._width, self._settings.voxel)
            self._sparse = scan_points(self.dense.points, replace(self._settings, voxel=width))
        return self._sparse


class ScanAligner:
    """Aligns scans to the target of a surface.

    Args:
        scan, align, search: see the classes.
        sigma: standard deviation of a range, metres.
        context: threads.
    """

    def __init__(
        self, scan: ScanSettings, align: AlignSettings, search: SearchSettings, sigma: float, context: NativeContext
    ) -> None:
        self._scan, self._settings, self._search = scan, align, search
        self._sigma, self._context = sigma, context
        self._pyramid: tuple[GicpTarget, list[GicpTarget], np.ndarray] | None = None

    @property
    def span(self) -> float:
        """Metres that a start may be off for the search to find the place."""
        return self._search.reach * (1 + max(ScanAlignmentTuning.around))

    def source(self, points: np.ndarray) -> ScanSource:
        """The points of a scan [n, 3] as `fine` and `search` want them."""
        return ScanSource(points, self._scan, self._search.voxel)

    def fine(self, source: ScanSource, surface: Surface, target: GicpTarget, guess: np.ndarray) -> ScanMatch:
        """Aligns from a guess that is right to about a coarse voxel of the target."""
        dot = self._settings.min_normal_dot if surface.has_sides else ANY_NORMAL
        return self._match(source.dense, surface, target, guess, replace(self._settings, min_normal_dot=dot))

    def refine(self, source: ScanSource, surface: Surface, target: GicpTarget, match: ScanMatch) -> ScanMatch:
        """Aligns again from a match while that still moves it: an alignment that begins far off ends short of the
        pose, with the points that the map can contain from where it began."""
        for _ in range(ScanAlignmentTuning.max_repeats):
            again = self.fine(source, surface, target, match.pose)
            if again.found.status is AlignmentStatus.LOST or again.found.overlap < match.found.overlap:
                break
            moved, _ = separation(match.pose, again.pose)
            match = again
            if moved < ScanAlignmentTuning.settled_m:
                break
        return match

    def is_right(self, match: ScanMatch, min_overlap: float, share: float = 1.0) -> bool:
        """Whether a pose is believed that nothing but the match speaks for; `share`: of what must match."""
        if match.found.status is AlignmentStatus.LOST or match.found.overlap < share * min_overlap:
            return False
        return self.is_told(match, share) or match.found.overlap >= max(ScanAlignmentTuning.plain_overlap, min_overlap)

    def is_told(self, match: ScanMatch, share: float = 1.0) -> bool:
        """Whether enough of what tells one place from another matches, along all directions of motion."""
        return match.structure >= share * self._search.min_structure

    def search(
        self, source: ScanSource, surface: Surface, target: GicpTarget, guess: np.ndarray, min_overlap: float,
        around: bool = True,
    ) -> ScanMatch | None:  # fmt: skip
        """Aligns from a guess that is metres and degrees off, then, with `around`, from places around it; ends with the
        first match that is right. None: there is none. The surface moves to where the scan is."""
        if not self._search.reach or not len(target):
            return None
        levels, up = self._levels(target)
        for start in self._starts(guess, up) if around else [guess]:
            T = start
            for level in levels:
                T = self._stage(source.sparse, surface, level, T)
            sparse = self._last_stage(source.sparse, surface, target, T)
            if self.is_right(sparse, min_overlap, ScanAlignmentTuning.promising_share):
                found = self.at_place(source, surface, target, sparse.pose)
                if self.is_right(found, min_overlap):
                    return found
                surface.move_to(guess[:3, 3])
                target = surface.target or target
        return None

    def at_place(self, source: ScanSource, surface: Surface, target: GicpTarget, T: np.ndarray) -> ScanMatch:
        """The match at a place, with the map around it: the surface moves there."""
        if surface.move_to(T[:3, 3]) and surface.target is not None:
            target = surface.target
        return self.refine(source, surface, target, self.fine(source, surface, target, T))

    def _starts(self, guess: np.ndarray, up: np.ndarray) -> Iterator[np.ndarray]:
        """The guess, turned and moved over the ground, nearest first."""
        turns = [np.eye(3), *(rotation_about(up, sign * self._search.turn_deg) for sign in (1, -1))]
        across = np.linalg.svd(up[None])[2][1:]
        shifts = [
            np.zeros(3),
            *(share * self._search.reach * axis for axis in across for share in ScanAlignmentTuning.around),
        ]
        for shift in shifts:
            for turn in turns:
                T = guess.copy()
                T[:3, :3], T[:3, 3] = turn @ guess[:3, :3], guess[:3, 3] + shift
                yield T

    def _stage(self, points: FramePoints, surface: Surface, level: GicpTarget, guess: np.ndarray) -> np.ndarray:
        tuning = ScanAlignmentTuning
        settings = replace(
            self._settings, min_normal_dot=ANY_NORMAL, coarse_iterations=0, fine_iterations=tuning.max_iterations,
            kernel_constant=tuning.kernel_voxels * level.voxel, kernel_sigmas=0.0,
            translation_tolerance=tuning.min_step, rotation_tolerance=tuning.min_step,
        )  # fmt: skip
        points = _rows(points, surface.covers(transform_points(points.points.astype(float), guess)))
        if len(points) < settings.min_matches:
            return guess
        noise = DepthNoise(self._sigma, 0.0)
        return orthonormalize(align(points, level, guess, settings, noise, self._context).T_world_camera)

    def _last_stage(
        self, points: FramePoints, surface: Surface, target: GicpTarget, guess: np.ndarray
    ) -> ScanMatch:
        """On the target's own voxels, the coarse ones with a kernel of their size; then again with the points that the
        map can contain from there."""
        width = self._settings.kernel_constant + self._settings.kernel_sigmas * self._sigma_of(target)
        tuning = ScanAlignmentTuning
        factor = min(100.0, tuning.kernel_voxels * tuning.coarse_voxels * target.voxel / width)
        settings = replace(
            self._settings, min_normal_dot=ANY_NORMAL, coarse_iterations=tuning.max_iterations,
            coarse_kernel_factor=factor,
        )  # fmt: skip
        found = self._match(points, surface, target, guess, settings)
        return self._match(points, surface, target, found.pose, replace(self._settings, min_normal_dot=ANY_NORMAL))

    def _match(
        self, points: FramePoints, surface: Surface, target: GicpTarget, guess: np.ndarray, settings: AlignSettings
    ) -> ScanMatch:
        inside = surface.covers(transform_points(points.points.astype(float), guess))
        counted = points if inside.all() else _rows(points, inside)
        sigma = self._sigma_of(target)
        found = align(counted, target, guess, settings, DepthNoise(sigma, 0.0), self._context)
        limit = settings.overlap_constant + settings.overlap_sigmas * sigma
        return ScanMatch(found, len(counted), len(points), target, limit)

    def _sigma_of(self, target: GicpTarget) -> float:
        return max(self._sigma, target.voxel / ScanAlignmentTuning.voxel_sigmas)

    def _levels(self, target: GicpTarget) -> tuple[list[GicpTarget], np.ndarray]:
        """Targets of wide voxels, the widest first, made of the target's coarse ones; and the most common normal."""
        if self._pyramid is None or self._pyramid[0] is not target:
            voxels, levels, width = target.voxels(1), [], self._search.reach
            while width > 1.2 * ScanAlignmentTuning.coarse_voxels * target.voxel:
                levels.append(_wider(voxels, width, target.origin, self._context))
                width /= 2
            self._pyramid = target, levels, _directions(voxels["normals"])[:, 2]
        return self._pyramid[1:]


def _wider(
    voxels: dict[str, np.ndarray], width: float, origin: np.ndarray, context: NativeContext
) -> GicpTarget:
    """Voxels of a target that counts from an origin [3], gathered in wider ones, `width` metres."""
    means = np.ascontiguousarray(voxels["means"])
    turns = np.ascontiguousarray(quaternions_from_normals(_unit(voxels["normals"])), np.float32)
    flat = np.log(width * np.array([1, 1, SurfaceTuning.flatness])).astype(np.float32)
    log_scales = np.tile(flat, (len(means), 1))
    logits = np.full(len(means), ScanAlignmentTuning.opacity_logit, np.float32)
    settings: TargetSettings = replace(SCAN_TARGET, voxel=width)
    target = GicpTarget.from_arrays(means, turns, log_scales, logits, settings, context)
    target.origin = origin
    return target


def _directions(normals: np.ndarray) -> np.ndarray:
    """Orthonormal columns [3, 3]: the direction that normals [n, 3] lie along the least, ..., the most."""
    return np.linalg.eigh((normals.T @ normals).astype(np.float64))[1]


def _unit(normals: np.ndarray) -> np.ndarray:
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)


def _rows(points: FramePoints, chosen: np.ndarray) -> FramePoints:
    return FramePoints(
        points.points[chosen], points.normals[chosen], points.covariances[chosen], points.pixels[chosen],
        points.weights[chosen],
    )  # fmt: skip
