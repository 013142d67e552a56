# SPDX-License-Identifier: Apache-2.0
"""Where segments lie, and the ids that they get, against the reference in numpy: no id differs."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest
from association_reference import ReferenceAssociator, ReferencePoints
from random_masks import masks, random_depth, random_mask
from simulated_map import LabelledVoxels, scramble

from ggslam.abi import core
from ggslam.errors import CoreInputError, InputError
from ggslam.native.loader import load_library
from ggslam.objects.association import Association, Associator, MapView
from ggslam.objects.overlap import SegmentOverlap, overlap_of
from ggslam.objects.segment_points import SegmentPlane, SegmentPoints
from ggslam.objects.segments import clean_segments
from ggslam.objects.settings import IDS, AssociationSettings
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence

UNCHANGED = np.arange(IDS).astype(np.uint16)
TURNED = np.array([[0.8, 0, 0.6, 0.3], [0, 1, 0, -0.2], [-0.6, 0, 0.8, 1], [0, 0, 0, 1]])


def camera_of(shape: tuple[int, int]) -> Camera:
    height, width = shape
    return Camera(width, height, 0.9 * width, 0.8 * width, 0.47 * width, 0.52 * height)


def overlap_with_itself(mask: np.ndarray, depth: np.ndarray) -> SegmentOverlap:
    view = MapView(mask, np.ones(mask.shape, np.float32), depth)
    return overlap_of(mask, view, depth, AssociationSettings(), UNCHANGED)


def test_extents_are_those_of_the_reference() -> None:
    rng, found = np.random.default_rng(0), 0
    for mask in masks(10):
        depth = random_depth(rng, mask)
        arguments = overlap_with_itself(mask, depth), depth, camera_of(mask.shape)
        asked = rng.permutation(len(arguments[0].segments))[: rng.integers(0, 40)]
        centres, radii = SegmentPoints(*arguments).find_extents(asked)
        expected_centres, expected_radii = ReferencePoints(*arguments).find_extents(asked)
        np.testing.assert_array_equal(centres, expected_centres)
        np.testing.assert_array_equal(radii, expected_radii)
        found += int((radii > 0).sum())
    assert found > 200


def test_planes_are_those_of_the_reference() -> None:
    rng, flat, bent = np.random.default_rng(1), 0, 0
    for mask in masks(11):
        if min(mask.shape) < 5:
            continue  # points on a line have no plane of their own
        depth = random_depth(rng, mask)
        arguments = overlap_with_itself(mask, depth), depth, camera_of(mask.shape)
        asked = np.flatnonzero(arguments[0].area >= 30)
        for stride in (1, 2):
            ours = SegmentPoints(*arguments).fit_planes(asked, stride, 0.03, 0.9, 0.08)
            theirs = ReferencePoints(*arguments).fit_planes(asked, stride, 0.03, 0.9, 0.08)
            for plane, expected in zip(ours, theirs, strict=True):
                assert (plane is None) == (expected is None)
                if plane is not None and expected is not None:
                    assert_same_plane(plane, expected)
            flat += sum(plane is not None for plane in ours)
            bent += sum(plane is None for plane in ours)
    assert flat > 100 and bent > 20


def assert_same_plane(plane: SegmentPlane, expected: SegmentPlane) -> None:
    np.testing.assert_allclose(plane.normal, expected.normal, rtol=0, atol=1e-9)
    np.testing.assert_allclose(plane.offset, expected.offset, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(plane.middle, expected.middle)
    assert plane.behind == expected.behind


def assert_same_result(ours: Association, theirs: Association) -> None:
    assert ours.ids.dtype == theirs.ids.dtype
    np.testing.assert_array_equal(ours.ids, theirs.ids)
    for name in ("merges", "created", "splits", "forgotten"):
        assert getattr(ours, name) == getattr(theirs, name), name


@pytest.mark.parametrize("seed", range(12))
def test_ids_are_those_of_the_reference(seed: int) -> None:
    """Masks at random that change, and maps that show what was found before, with errors."""
    rng = np.random.default_rng(seed)
    settings = AssociationSettings(mode=("always", "auto")[seed % 2], patience=4)  # type: ignore[arg-type]
    ours, theirs = Associator(settings), ReferenceAssociator(settings)
    shape, view, kinds = ((48, 64), (61, 83), (30, 45))[seed % 3], None, np.zeros(4, int)
    mask = random_mask(rng, shape, [0, *range(1, 9)])
    camera, depth = camera_of(shape), random_depth(rng, mask)
    for _ in range(40):
        if rng.random() < 0.1:
            mask = random_mask(rng, shape, [0, *range(1, 9)])
            depth = random_depth(rng, mask)
        mask, depth = np.roll(mask, rng.integers(-1, 2), 1), np.roll(depth, rng.integers(-1, 2), 1)
        raw = clean_segments(scramble(mask, rng, split=0.3, drop=0.1, merge=rng.random() < 0.3, max_id=60))
        result = ours.associate(raw, view, depth, camera, TURNED)
        assert_same_result(result, theirs.associate(raw, view, depth, camera, TURNED))
        assert ours.sightings == theirs.sightings
        shown = np.where(rng.random(shape) < 0.05, 0, result.ids).astype(np.uint16)
        view = MapView(shown, rng.uniform(0.4, 1, shape).astype(np.float32), depth)
        kinds += [len(result.merges), len(result.created), len(result.splits), len(result.forgotten)]
    assert kinds[1] > 5 and kinds.sum() > kinds[1]


def test_ids_along_a_recording_are_those_of_the_reference(room: Path) -> None:
    sequence, rng = open_sequence(room), np.random.default_rng(3)
    ours, theirs, voxels = Associator(), ReferenceAssociator(), LabelledVoxels(0.02)
    for index in range(0, len(sequence), 2):
        frame = sequence.frame(index)
        assert frame.mask is not None and frame.T_world_camera is not None
        view = voxels.render(frame.camera, frame.T_world_camera) if index else None
        segments = clean_segments(scramble(frame.mask, rng))
        result = ours.associate(segments, view, frame.depth, frame.camera, frame.T_world_camera)
        expected = theirs.associate(segments, view, frame.depth, frame.camera, frame.T_world_camera)
        assert_same_result(result, expected)
        for kept, dropped in result.merges:
            voxels.merge(kept, dropped)
        voxels.add(frame, result.ids)
    assert ours.uses_own_ids is False
    assert ours._planes._of and list(ours._planes._of) == list(theirs._planes._of)


def test_depth_that_is_no_number_gives_no_plane_of_its_own() -> None:
    mask, depth = np.ones((20, 30), np.uint16), np.full((20, 30), 2, np.float32)
    arguments = overlap_with_itself(mask, depth), depth, camera_of(mask.shape)
    [plane] = SegmentPoints(*arguments).fit_planes(np.array([0]), 1, 0.03, 0.9, 0.08)
    depth[::3], depth[1::3, ::2] = np.inf, np.nan
    [seen] = SegmentPoints(*arguments).fit_planes(np.array([0]), 1, 0.03, 0.9, 0.08)
    assert plane is not None and seen is not None
    np.testing.assert_allclose(seen.normal, plane.normal, atol=1e-12)
    assert seen.offset == pytest.approx(plane.offset) == -2


def test_images_of_another_size_are_refused() -> None:
    depth = np.ones((20, 30), np.float32)
    overlap = overlap_with_itself(np.ones((20, 30), np.uint16), depth)
    with pytest.raises(InputError, match=r"\[20, 31\], \[20, 30\], \[20, 30\]"):
        SegmentPoints(overlap, depth, camera_of((20, 31)))


def test_segments_that_are_not_there_are_refused() -> None:
    depth = np.ones((20, 30), np.float32)
    points = SegmentPoints(overlap_with_itself(np.ones((20, 30), np.uint16), depth), depth, camera_of((20, 30)))
    for asked in (np.array([1]), np.array([-1])):
        with pytest.raises(CoreInputError, match="asked: expected numbers from 0 to 0"):
            points.find_extents(asked)
        with pytest.raises(CoreInputError, match="asked: expected numbers from 0 to 0"):
            points.fit_planes(asked, 1, 0.03, 0.9, 0.08)
    points.overlap.row[3, 4] = 7
    for ask in (points.find_extents, lambda asked: points.fit_planes(asked, 1, 0.03, 0.9, 0.08)):
        with pytest.raises(CoreInputError, match="row: expected segments below 1, found 7"):
            ask(np.array([0]))
    with pytest.raises(CoreInputError, match="expected numbers below 1 and 1, found 7 and 0"):
        points.overlap.draw(np.zeros((2, 2), np.uint16))


@pytest.mark.parametrize("function, job", [
    ("ggslam_segment_extents", core.ExtentsJob(core.SegmentedDepth(height=2, width=2))),
    ("ggslam_segment_planes", core.SegmentPlanesJob(core.SegmentedDepth(height=2, width=2))),
    ("ggslam_label_pairs", core.PairLabelsJob(pixels=4)),
])  # fmt: skip
def test_jobs_without_images_are_refused(function: str, job: ctypes.Structure) -> None:
    with pytest.raises(CoreInputError, match="null pointer"):
        getattr(load_library(), function)(ctypes.byref(job))
