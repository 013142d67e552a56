# SPDX-License-Identifier: Apache-2.0
"""Depth on the pixels of finer colour: planes stay planes, edges follow colour, holes stay holes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from app_recordings import phone_frames, write_scanner_app

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence
from ggslam.sequences.upsampling import upsample_depth

GREY = np.full((72, 96, 3), 120, np.uint8)


def test_a_plane_stays_one() -> None:
    fine = Camera(96, 72, 80, 81, 46.3, 37.1)
    coarse, normal = fine.resize(32, 24), np.array([0.35, -0.25, 0.9])

    def seen_by(camera: Camera) -> np.ndarray:
        return (2 / (camera.rays().astype(np.float64) @ normal)).astype(np.float32)

    error = np.abs(upsample_depth(seen_by(coarse), GREY) - seen_by(fine))
    assert error[2:-2, 2:-2].max() < 1e-5  # beyond the outermost samples it is what they are
    np.testing.assert_array_equal(upsample_depth(seen_by(fine), GREY), seen_by(fine))


@pytest.mark.parametrize("edge", [45, 46, 47, 48, 49, 50])
def test_edges_follow_colour(edge: int) -> None:
    """The true edge lies at column `edge` of colour; samples of depth are three columns wide, and of their middle."""
    color = np.full((72, 96, 3), 200, np.uint8)
    color[:, :edge] = 40
    truth = np.where(np.arange(96) < edge, 1.0, 2.5).astype(np.float32)
    depth = np.tile(truth[1::3], (24, 1))
    fine = upsample_depth(depth, color)
    assert set(np.unique(fine.round(4))) == {np.float32(1), np.float32(2.5)}
    np.testing.assert_allclose(fine, np.tile(truth, (72, 1)), rtol=1e-5)


def test_holes_stay_holes_and_do_not_grow() -> None:
    depth = np.full((24, 32), 1.5, np.float32)
    depth[10:14, 8:20] = 0
    fine = upsample_depth(depth, GREY)
    np.testing.assert_array_equal(fine > 0, cv2.resize(depth, (96, 72), interpolation=cv2.INTER_NEAREST) > 0)
    np.testing.assert_allclose(fine[fine > 0], 1.5, rtol=1e-6)
    assert not upsample_depth(np.zeros((24, 32), np.float32), GREY).any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (24, 32), (71, 95)])
def test_any_sizes(shape: tuple[int, int]) -> None:
    assert (upsample_depth(np.full(shape, 2.0, np.float32), GREY) == 2).all()


def test_a_room_is_better_than_by_nearest_and_between_nothing() -> None:
    """Against what a depth camera as fine as colour would have seen: half as many wrong pixels as nearest samples
    leave, and hardly any between surfaces, where interpolation puts one in a hundred."""
    coarse = phone_frames(1, (320, 240), (128, 96), frames=120)[0]
    truth = phone_frames(1, (320, 240), (320, 240), frames=120)[0].depth
    low, high = cv2.erode(truth, np.ones((9, 9))), cv2.dilate(truth, np.ones((9, 9)))
    ways = {
        "guided": upsample_depth(coarse.depth, coarse.color),
        "nearest": cv2.resize(coarse.depth, (320, 240), interpolation=cv2.INTER_NEAREST),
        "linear": cv2.resize(coarse.depth, (320, 240)),
    }
    wrong = {name: np.abs(depth - truth) > 0.05 * truth for name, depth in ways.items()}
    between = {
        name: float((wrong[name] & (depth > 1.03 * low) & (depth < high / 1.03)).mean()) for name, depth in ways.items()
    }
    assert wrong["guided"].mean() < 0.6 * wrong["nearest"].mean()
    assert between["guided"] < 0.2 * between["linear"]


def test_scale_is_of_what_comes_by_default(tmp_path: Path) -> None:
    """By default as many pixels as other recordings have; 0.5 halves that; at every scale the same intrinsics."""
    frames = [dataclasses.replace(
        frame, color=cv2.resize(frame.color, (1920, 1440)), camera=frame.camera.resize(1920, 1440)
    ) for frame in phone_frames(2, (240, 180), (256, 192), frames=120)]  # fmt: skip
    folder = write_scanner_app(tmp_path / "scan", frames, color_every=1)
    for scale, size in ((None, (640, 480)), (0.75, (480, 360)), (0.5, (320, 240)), (3.0, (1920, 1440))):
        sequence = open_sequence(folder, scale=scale)
        assert (sequence.camera.width, sequence.camera.height) == size and sequence.finer
        assert sequence.native_camera == frames[0].camera
        assert sequence.camera == frames[0].camera.resize(*size)
        assert sequence.scale == pytest.approx(size[0] / 640)
    with pytest.raises(SequenceError, match=r"\b3\b.*3\.5"):
        open_sequence(folder, scale=3.5)
    again = open_sequence(**sequence.options)  # type: ignore[arg-type]
    assert again.camera == sequence.camera
