# SPDX-License-Identifier: Apache-2.0
"""Verifies that a view shows the place that it resembles, and finds its pose: by features, then geometry, then both.

A candidate is refused with the first reason that is found; the reason says what was expected and what was seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ggslam.features.orb import Landmarks
from ggslam.features.registration import Matches, Registration, pixels_of, register
from ggslam.geometry.voxels import voxel_keys
from ggslam.loops.settings import VerificationSettings
from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning


class VerificationTuning(Tuning):
    """Check of a candidate place."""

    cells = 4
    """Parts of the image along each axis, over which matches must be spread."""
    sufficient_overlap = 1.5
    """Overlap, in multiples of the required one, from which matches may be concentrated in fewer parts."""


class Status(Protocol):
    """A member of an enumeration of strings."""

    @property
    def value(self) -> Any:
        """ "lost" for an alignment that found nothing to hold on to."""


class Refinement(Protocol):
    """What is asked of an alignment of a new local map to an old one (`AlignmentResult` has it).

    The world of its names is here the old keyframe's camera frame.
    """

    @property
    def T_world_camera(self) -> np.ndarray:
        """T_old_new, float64 [4, 4]."""

    @property
    def status(self) -> Status:
        """Whether it can be used at all."""

    @property
    def overlap(self) -> float:
        """Share of the new points that match."""

    @property
    def rmse(self) -> float:
        """Of the matches, metres."""

    @property
    def information(self) -> np.ndarray:
        """Inverse covariance [6, 6] of the left twist (v, w) in the old frame."""


@dataclass(frozen=True)
class LocalMap:
    """What is known about the surroundings of a keyframe.

    Attributes:
        landmarks: features of the keyframe.
        points: float [n, 3], surface points in the keyframe's camera frame, metres; of it alone or of its neighbours
            as well.
    """

    landmarks: Landmarks
    points: np.ndarray


@dataclass(frozen=True)
class Verification:
    """The outcome for a candidate.

    Attributes:
        accepted: whether all tests were passed.
        reason: why not; empty if accepted.
        T_old_new: float64 [4, 4], the pose as far as it was found: refined, by features alone, or the identity.
        matches: feature matches, right or wrong.
        inliers: those that agree with one pose.
        kept: those of the inliers that agree with the refined pose as well.
        alignment_overlap, rmse: the refinement's, 0 if there was none.
        overlap: share of the new voxels that the old points fill, 0 if it was not computed.
        information: float64 [6, 6] of the refinement, for `PoseGraph.add_loop`; zeros if there was none.
    """

    accepted: bool
    reason: str
    T_old_new: np.ndarray
    matches: int
    inliers: int
    kept: int
    alignment_overlap: float
    rmse: float
    overlap: float
    information: np.ndarray


def verify(
    old: LocalMap,
    new: LocalMap,
    camera: Camera,
    sigma: Callable[[float], float],
    align: Callable[[np.ndarray], Refinement],
    settings: VerificationSettings,
) -> Verification:
    """Whether two keyframes see the same surfaces, and the motion between them. The same input gives the same answer.

    Args:
        sigma: standard deviation of depth in metres at a depth in metres.
        align: refines T_old_new [4, 4] by geometry, from a start that is right to some centimetres and degrees.
    """
    registration = register(old.landmarks, new.landmarks, camera, settings.registration)
    cells = _count_cells(registration, camera)
    reason = _doubt_about_features(registration, cells, settings, settings.min_cells_alike)
    if reason:
        return _refusal(reason, registration)
    refined = align(registration.T_old_new)
    kept = registration.matches.agree(refined.T_world_camera, camera, settings.registration, slack=2.0)
    found = _judge(old, new, registration, refined, int((kept & registration.inliers).sum()), sigma, settings)
    narrow = _doubt_about_features(registration, cells, settings, settings.min_cells)
    if found.accepted and narrow and found.overlap < VerificationTuning.sufficient_overlap * settings.min_overlap:
        return replace(found, accepted=False, reason=narrow)
    return found


def _judge(
    old: LocalMap, new: LocalMap, registration: Registration, refined: Refinement, agreeing: int,
    sigma: Callable[[float], float], settings: VerificationSettings,
) -> Verification:  # fmt: skip
    """What the geometry says, `plural` of the inliers being where the refined pose has them."""
    depth = float(np.median(new.points[:, 2])) if len(new.points) else 0.0
    noise = sigma(depth)
    overlap = voxel_overlap(
        old.points,
        transform_points(new.points, refined.T_world_camera),
        settings.voxel_constant + settings.voxel_sigmas * noise,
    )
    reason = _doubt_about_geometry(refined, registration, agreeing, noise, settings)
    if not reason and overlap < settings.min_overlap:
        reason = f"{overlap:.0%} of the voxels are filled in both places, {settings.min_overlap:.0%} needed"
    return Verification(
        not reason, reason, refined.T_world_camera, len(registration.matches), registration.count, agreeing,
        refined.overlap, refined.rmse, overlap, refined.information,
    )  # fmt: skip


def verify_expected(
    old: LocalMap,
    new: LocalMap,
    matches: Matches,
    T_expected: np.ndarray,
    camera: Camera,
    sigma: Callable[[float], float],
    align: Callable[[np.ndarray], Refinement],
    settings: VerificationSettings,
    min_witnesses: int,
) -> Verification:
    """As `verify`, where the motion T_old_new [4, 4] is known to about a hand's breadth. Then far fewer matches tell
    that it is right: hardly any that are wrong agree with a given pose.

    Args:
        matches: of the landmarks.
        T_expected: where the alignment starts.
        min_witnesses: matches that have to agree with the refined pose.
    """
    refined = align(T_expected)
    kept = matches.agree(refined.T_world_camera, camera, settings.registration, slack=2.0)
    registration = Registration(T_expected, matches, kept)
    if registration.count < min_witnesses:
        reason = f"{registration.count} of {len(matches)} matches agree with the expected pose, {min_witnesses} needed"
        return _refusal(reason, registration)
    return _judge(old, new, registration, refined, registration.count, sigma, settings)


def voxel_overlap(old: np.ndarray, new: np.ndarray, voxel: float) -> float:
    """Share of the voxels with new points [n, 3] that hold old points [m, 3], too; edge `voxel` metres."""
    if not len(old) or not len(new):
        return 0.0
    new_keys, old_keys = np.unique(voxel_keys(new, voxel)), voxel_keys(old, voxel)
    return float(np.isin(new_keys, old_keys).mean())


def _doubt_about_features(found: Registration, cells: int, settings: VerificationSettings, min_cells: int) -> str:
    if found.count < settings.min_inliers:
        return f"{found.count} of {len(found.matches)} matches agree with one pose, {settings.min_inliers} needed"
    if cells < min_cells:
        return (
            f"the {found.count} matches that agree lie in {cells} of {VerificationTuning.cells**2} parts of the image, "
            f"{min_cells} needed"
        )
    return ""


def _count_cells(found: Registration, camera: Camera) -> int:
    """Parts of the image in which features agree."""
    pixels = pixels_of(found.matches.new[found.inliers], camera)
    across = VerificationTuning.cells
    cells = np.floor(pixels / (camera.width, camera.height) * across).clip(0, across - 1).astype(int)
    return len(np.unique(cells[:, 0] * across + cells[:, 1]))


def _doubt_about_geometry(
    refined: Refinement, found: Registration, kept: int, noise: float, settings: VerificationSettings
) -> str:
    limit = settings.max_rmse_constant + settings.max_rmse_sigmas * noise
    if refined.status.value == "lost":
        return "the surfaces have too few matches"
    if refined.overlap < settings.min_alignment_overlap:
        needed = settings.min_alignment_overlap
        return f"{refined.overlap:.0%} of the points match the old surface, {needed:.0%} needed"
    if refined.rmse > limit:
        return f"the surfaces lie {1e3 * refined.rmse:.1f} mm apart (RMSE), at most {1e3 * limit:.1f} mm allowed"
    if kept < settings.min_kept * found.count:
        return (
            f"aligning the surfaces left {kept} of {found.count} feature matches in place, "
            f"{settings.min_kept:.0%} needed"
        )
    return ""


def _refusal(reason: str, found: Registration) -> Verification:
    return Verification(
        False, reason, found.T_old_new, len(found.matches), found.count, 0, 0.0, 0.0, 0.0, np.zeros((6, 6))
    )
