# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
import pytest

from ggslam.features.orb import Landmarks
from ggslam.loops.settings import VerificationSettings
from ggslam.loops.verification import LocalMap, Verification, verify, voxel_overlap
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp, se3_log

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
T_OLD_NEW = se3_exp(np.array([0.2, -0.1, 0.1, 0.05, -0.15, 0.1]))


class Status(enum.Enum):
    OK = "ok"
    LOST = "lost"


@dataclass(frozen=True)
class Aligned:
    """What an alignment says: by default that all is well."""

    T_world_camera: np.ndarray
    status: Status = Status.OK
    overlap: float = 0.9
    rmse: float = 0.004
    information: np.ndarray = field(default_factory=lambda: 1e4 * np.eye(6))


def local_maps(patch: float = 1.0, wrong: float = 0.4, count: int = 100) -> tuple[LocalMap, LocalMap]:
    """Two views of a wavy wall; features in a part of it, a share of them matched wrongly."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 90), np.linspace(-0.9, 0.9, 70))
    wall = np.stack([x, y, 2 + 0.2 * np.sin(3 * x)], -1).reshape(-1, 3)
    xy = patch * random.uniform((-0.9, -0.6), (0.9, 0.6), (count, 2))
    features = np.column_stack([xy, 2 + 0.2 * np.sin(3 * xy[:, 0])])
    T = inverse(T_OLD_NEW)
    seen = features @ T[:3, :3].T + T[:3, 3]
    bad = random.choice(count, round(wrong * count), replace=False)
    seen[bad] = seen[random.permutation(bad)]
    descriptors = random.integers(0, 256, (count, 32)).astype(np.uint8)
    old = LocalMap(Landmarks(descriptors, features.astype(np.float32)), wall)
    return old, LocalMap(Landmarks(descriptors, seen.astype(np.float32)), wall @ T[:3, :3].T + T[:3, 3])


def verified(old: LocalMap, new: LocalMap, aligned: Aligned | None = None) -> Verification:
    return verify(
        old, new, CAMERA, lambda z: 0.001 + 0.002 * z * z, lambda T: aligned or Aligned(T), VerificationSettings()
    )


def test_the_same_place_is_accepted_with_its_motion() -> None:
    found = verified(*local_maps())
    assert found.accepted and found.reason == ""
    assert np.linalg.norm(se3_log(found.T_old_new @ inverse(T_OLD_NEW))) < 0.01
    assert (found.matches, found.alignment_overlap, found.rmse) == (100, 0.9, 0.004)
    assert 60 <= found.inliers <= 66 and found.kept >= 60
    assert found.overlap > 0.9
    np.testing.assert_array_equal(found.information, 1e4 * np.eye(6))


def test_refinement_starts_from_the_features_and_is_what_counts() -> None:
    starts = []
    nearby = se3_exp(np.array([0.01, 0, 0, 0, 0, 0])) @ T_OLD_NEW

    def align(T: np.ndarray) -> Aligned:
        starts.append(T)
        return Aligned(nearby)

    found = verify(*local_maps(), CAMERA, lambda z: 0.01, align, VerificationSettings())
    assert len(starts) == 1 and np.linalg.norm(se3_log(starts[0] @ inverse(T_OLD_NEW))) < 0.01
    assert found.accepted
    np.testing.assert_array_equal(found.T_old_new, nearby)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"status": Status.LOST}, "too few matches"),
        ({"overlap": 0.31}, "31%.*50%"),
        ({"rmse": 0.06}, r"60\.0 mm.*\d+\.\d mm"),
        ({"T_world_camera": se3_exp(np.array([0.15, 0, 0, 0, 0, 0])) @ T_OLD_NEW}, "left .* of .* feature matches"),
    ],
)
def test_geometry_must_agree(change: dict, reason: str) -> None:
    found = verified(*local_maps(), Aligned(**{"T_world_camera": T_OLD_NEW, **change}))
    assert not found.accepted
    assert found.inliers >= 60
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(found.reason)


def test_features_must_agree() -> None:
    few = verified(*local_maps(count=14, wrong=0.0))
    assert not few.accepted and few.reason == "14 of 14 matches agree with one pose, 15 needed"
    other = verified(*local_maps(wrong=1.0))
    assert not other.accepted and "of 100 matches agree with one pose" in other.reason
    crowded = verified(*local_maps(patch=0.25))
    assert not crowded.accepted and "of 16 parts of the image, 4 needed" in crowded.reason
    assert few.overlap == crowded.overlap == 0.0 and not crowded.information.any()


def test_features_in_few_places_need_more_common_surface() -> None:
    """In four of the 16 parts: 95 % of the voxels are enough, 45 % are not, though 40 % are of features everywhere."""
    old, new = local_maps(patch=0.367)
    assert verified(old, new).accepted
    half = LocalMap(old.landmarks, old.points[old.points[:, 0] > 0.15])
    found = verified(half, new)
    assert not found.accepted and "in 4 of 16 parts of the image, 5 needed" in found.reason
    assert 0.4 < found.overlap < 0.6
    everywhere = local_maps()
    assert verified(LocalMap(everywhere[0].landmarks, half.points), everywhere[1]).accepted


def test_the_surfaces_must_fill_the_same_voxels() -> None:
    old, new = local_maps()
    elsewhere = LocalMap(old.landmarks, old.points[old.points[:, 0] > 0.6])
    found = verified(elsewhere, new)
    assert not found.accepted and 0.15 < found.overlap < 0.4
    assert "of the voxels are filled in both places, 40% needed" in found.reason
    nowhere = verified(LocalMap(old.landmarks, old.points[:0]), new)
    assert not nowhere.accepted and nowhere.overlap == 0.0


def test_voxel_overlap_counts_the_new_voxels() -> None:
    old = np.array([[0.05, 0.05, 0.05], [0.15, 0.05, 0.05], [-0.05, 0.05, 1.05]])
    assert voxel_overlap(old, old[:2] + 0.01, 0.1) == 1.0
    assert voxel_overlap(old[:2], old, 0.1) == pytest.approx(2 / 3)
    assert voxel_overlap(old, -old, 0.1) == 0.0
    assert voxel_overlap(old, old[:0], 0.1) == 0.0
