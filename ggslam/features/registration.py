# SPDX-License-Identifier: Apache-2.0
"""Finds the pose of one view relative to another when both have depth.

Three matches make a pose by aligning their points (Arun, Huang and Blostein, PAMI 1987); RANSAC (Fischler and Bolles,
CACM 1981) counts the matches that agree with it in the image and in depth; the best is refined on the image. Against
PnP on the pixels of one view alone, depth on both sides tells wrong matches apart and ties down what a small patch of
features leaves open: on far-apart views of real rooms more poses are right, and fewer that seem right are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.features.orb import Landmarks
from ggslam.scene.camera import Camera
from ggslam.scene.poses import fit_similarity, inverse
from ggslam.system.settings import setting, tuning_class
from ggslam.system.tuning import Tuning


class RegistrationTuning(Tuning):
    """Pose from matched features."""

    min_matches = 6
    """Fewest matches of a pose."""
    alike_m = 0.03
    """Largest difference of the distance of two points between views, in metres..."""
    alike_share = 0.1
    """...plus this share of the distance."""


@tuning_class(frozen=True)
class RegistrationSettings:
    """Registration of two views by their matches."""

    max_hamming: int = setting(64, 0, 256, "bits")
    """Largest distance of two matching descriptors, of 256 bits."""
    hypotheses: int = setting(400, 1, 10**5)
    """Triples of matches tried."""
    reprojection: float = setting(2.5, 0.01, 1e3, "px")
    """Inlier distance in a 320-pixel-wide image."""
    depth_constant: float = setting(0.025, 1e-4, 10, "m")
    """Constant part of the inlier distance in depth, constant + square z^2."""
    depth_square: float = setting(0.008, 0, 10, "1/m")
    """Quadratic part of the inlier distance in depth, constant + square z^2."""


@dataclass(frozen=True)
class Matches:
    """Matched points in two camera frames.

    Attributes:
        old, new: float64 [m, 3], metres, each in its own camera's frame.
    """

    old: np.ndarray
    new: np.ndarray

    def __len__(self) -> int:
        return len(self.old)

    def agree(
        self, T_old_new: np.ndarray, camera: Camera, settings: RegistrationSettings, slack: float = 1.0
    ) -> np.ndarray:
        """Which matches a pose [..., 4, 4] explains, bool [..., m]; `slack` widens both limits."""
        T = inverse(T_old_new)
        moved = np.einsum("...ij,mj->...mi", T[..., :3, :3], self.old) + T[..., None, :3, 3]
        z = np.maximum(moved[..., 2], 1e-6)
        seen = pixels_of(self.new, camera)
        error = np.hypot(
            camera.fx * moved[..., 0] / z + camera.cx - seen[:, 0],
            camera.fy * moved[..., 1] / z + camera.cy - seen[:, 1],
        )
        depth_error = np.abs(moved[..., 2] - self.new[:, 2])
        depth_limit = settings.depth_constant + settings.depth_square * self.new[:, 2] ** 2
        pixel_limit = settings.reprojection * camera.width / 320
        return (error < slack * pixel_limit) & (depth_error < slack * depth_limit)


@dataclass(frozen=True)
class Registration:
    """A relative pose from matches.

    Attributes:
        T_old_new: float64 [4, 4].
        matches: all matches, right or wrong.
        inliers: bool [m], those that agree with the pose.
    """

    T_old_new: np.ndarray
    matches: Matches
    inliers: np.ndarray

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(self.inliers.sum())


def pixels_of(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Where points [n, 3] in front of the camera fall, float64 [n, 2]."""
    return points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def match(old: Landmarks, new: Landmarks, settings: RegistrationSettings) -> Matches:
    """Mutually nearest descriptors that are near enough."""
    pairs: list = []
    if len(old) and len(new):
        found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(old.descriptors, new.descriptors)
        pairs = [(m.queryIdx, m.trainIdx) for m in found if m.distance <= settings.max_hamming]
    chosen = np.array(pairs, int).reshape(-1, 2)
    return Matches(old.points[chosen[:, 0]].astype(float), new.points[chosen[:, 1]].astype(float))


def register(old: Landmarks, new: Landmarks, camera: Camera, settings: RegistrationSettings) -> Registration:
    """Pose of a new view relative to an old one. The same landmarks give the same pose.

    Returns:
        The pose with the most inliers; the identity with none if no three matches make one.
    """
    matches = match(old, new, settings)
    nothing = Registration(np.eye(4), matches, np.zeros(len(matches), bool))
    hypotheses = (
        _hypotheses(matches, settings) if len(matches) >= RegistrationTuning.min_matches else np.zeros((0, 4, 4))
    )
    if not len(hypotheses):
        return nothing
    agreeing = matches.agree(hypotheses, camera, settings, slack=2.0)
    best = int(agreeing.sum(1).argmax())
    T, inliers = hypotheses[best], agreeing[best]
    for _ in range(3):
        if inliers.sum() < RegistrationTuning.min_matches:
            return nothing
        T = _refine(T, matches, inliers, camera)
        inliers = matches.agree(T, camera, settings)
    return Registration(T, matches, inliers)


def _hypotheses(matches: Matches, settings: RegistrationSettings) -> np.ndarray:
    """T_old_new [h, 4, 4] of random triples whose sides are alike in both views."""
    triples = np.random.default_rng(0).integers(0, len(matches), (settings.hypotheses, 3))
    a, b = matches.old[triples], matches.new[triples]
    sides, others = (np.linalg.norm(p - np.roll(p, 1, 1), axis=2) for p in (a, b))
    alike = (
        np.abs(sides - others) < RegistrationTuning.alike_share * np.maximum(sides, others) + RegistrationTuning.alike_m
    )
    chosen = alike.all(1) & (sides.min(1) > 0.1)  # a small triangle says little about rotation
    a, b = a[chosen], b[chosen]
    return fit_similarity(b, a)[0]


def _refine(T_old_new: np.ndarray, matches: Matches, inliers: np.ndarray, camera: Camera) -> np.ndarray:
    """The pose with the smallest reprojection error of the inliers near a first one."""
    T = inverse(T_old_new)
    rotation, translation = cv2.solvePnPRefineLM(
        matches.old[inliers], pixels_of(matches.new[inliers], camera), camera.matrix(), None,
        cv2.Rodrigues(T[:3, :3])[0], T[:3, 3:].copy(),
    )  # fmt: skip
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return inverse(T)
