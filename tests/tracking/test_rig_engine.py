# SPDX-License-Identifier: Apache-2.0
"""Points of several cameras in one alignment."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, se3_exp, separation
from ggslam.sequences import open_sequence
from ggslam.sequences.rig import RigSequence
from ggslam.tracking.gicp import align
from ggslam.tracking.points import extract_points
from ggslam.tracking.rig_engine import RigTrackingEngine, RigView, join_points
from ggslam.tracking.settings import AlignSettings, DepthNoise, PointSettings, TargetSettings
from ggslam.tracking.surface import MeasuredSurface

NOISE = DepthNoise(0.001, 0.002)


@pytest.fixture(scope="module")
def views(rig: Path) -> list[RigView]:
    """What both cameras saw at the first instant, as if together."""
    sequence = open_sequence(rig)
    assert isinstance(sequence, RigSequence)
    frames = [sequence.frame(k) for k in range(2)]
    return [RigView(f.camera, f.depth, T) for f, T in zip(frames, sequence.rig.T_first_camera, strict=True)]


def engine_for(views: list[RigView]) -> RigTrackingEngine:
    engine = RigTrackingEngine(NativeContext(1))
    engine.views = views
    return engine


def test_points_keep_their_own_depth(views: list[RigView]) -> None:
    engine = engine_for(views)
    joined = engine.points(views[0].depth, PointSettings(), NOISE)
    assert len(joined) == sum(map(len, engine.parts))
    behind = slice(len(engine.parts[0]), None)
    assert (joined.points[behind, 2] < 0).mean() > 0.9  # the other camera looks back
    np.testing.assert_array_equal(joined.z[behind], engine.parts[1].points[:, 2])
    assert joined.median_depth > 1
    T = views[1].T_first_camera
    np.testing.assert_allclose((joined.points[behind] - T[:3, 3]) @ T[:3, :3], engine.parts[1].points, atol=1e-5)
    xx, xy, xz, yy, yz, zz = joined.covariances[behind][7]
    turned = T[:3, :3].T @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ T[:3, :3]
    np.testing.assert_allclose(turned[np.triu_indices(3)], engine.parts[1].covariances[7], atol=1e-5)


def test_a_camera_alone_is_what_it_was(views: list[RigView]) -> None:
    engine = engine_for(views[:1])
    joined = engine.points(views[0].depth, PointSettings(), NOISE)
    alone = extract_points(views[0].depth, views[0].camera, PointSettings(), NOISE, NativeContext(1))
    for name in ("points", "normals", "covariances", "weights"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(alone, name))
    assert joined.depths is None


def test_noise_follows_from_the_depth_of_the_camera_that_saw_a_point(views: list[RigView]) -> None:
    """Both cameras aligned to what they saw: the same as seen from the second one, whose points are in front then."""
    context, settings = NativeContext(1), AlignSettings()
    engine = engine_for(views)
    joined = engine.points(views[0].depth, PointSettings(), NOISE)
    surface = MeasuredSurface(TargetSettings(), context)
    for part, view in zip(engine.parts, views, strict=True):
        surface.add(part, view.T_first_camera)
    assert surface.target is not None
    guess = se3_exp(np.array([0.02, -0.01, 0.015, 0.01, 0.005, -0.01]))
    found = align(joined, surface.target, guess, settings, NOISE, context)
    assert separation(found.T_world_camera, np.eye(4))[0] < 2e-3
    T_back_first = inverse(views[1].T_first_camera)
    turned = join_points(engine.parts, [T_back_first @ view.T_first_camera for view in views])
    other = align(turned, surface.target, guess @ views[1].T_first_camera, settings, NOISE, context)
    np.testing.assert_allclose(other.T_world_camera @ T_back_first, found.T_world_camera, atol=1e-4)
    assert other.overlap == pytest.approx(found.overlap, abs=0.01)
    wrong = align(dataclasses.replace(joined, depths=None), surface.target, guess, settings, NOISE, context)
    assert wrong.information.trace() != pytest.approx(found.information.trace(), rel=1e-3)


def test_overlap_is_that_of_the_camera_that_fits_best(views: list[RigView]) -> None:
    """The second camera looks at what was never mapped."""
    context, settings = NativeContext(1), AlignSettings()
    engine = engine_for(views)
    joined = engine.points(views[0].depth, PointSettings(), NOISE)
    surface = MeasuredSurface(TargetSettings(), context)
    target = surface.add(engine.parts[0], np.eye(4))
    found = engine.align(joined, target, np.eye(4), settings, NOISE)
    shares = engine.overlaps(found, settings, NOISE)
    assert shares[0] is not None and shares[1] is not None
    assert found.overlap == shares[0] > 0.95 > 0.3 > shares[1]
    plain = align(joined, target, np.eye(4), settings, NOISE, context)
    counts = [len(part) for part in engine.parts]
    expected = (shares[0] * counts[0] + shares[1] * counts[1]) / sum(counts)
    assert plain.overlap == pytest.approx(expected, abs=2 / sum(counts))
