# SPDX-License-Identifier: Apache-2.0
"""A camera that stands still, and what must not be taken for one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config
from ggslam.slam.slam import Slam
from ggslam.synthetic import RayCaster, furnished_room, write_synthetic_sequence
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.still_camera import SmallFrame, is_still, still_notes

CAMERA = Camera(320, 240, 240.0, 240.0, 159.5, 119.5)
NOISE = DepthNoise(0.0012, 0.0019)


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(furnished_room(0), 0)


def pose() -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = (2.0, 1.8, 1.4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    return T


def frame(caster: RayCaster, T: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour with two grey levels of noise, and depth with a Kinect's."""
    images, rng = caster.render(CAMERA, T), np.random.default_rng(seed)
    color = np.clip(images.color + rng.normal(0, 2, images.color.shape), 0, 255).astype(np.uint8)
    noise = NOISE.constant + NOISE.square * images.depth**2
    return color, (images.depth + noise * rng.standard_normal(images.depth.shape)).astype(np.float32)


def test_noise_exposure_and_what_moves_are_not_the_camera(caster: RayCaster) -> None:
    anchor = SmallFrame.of(*frame(caster, pose(), 0))
    color, depth = frame(caster, pose(), 1)
    assert is_still(anchor, SmallFrame.of(color, depth), NOISE)
    brighter = np.clip(1.08 * color + 3, 0, 255).astype(np.uint8)
    assert is_still(anchor, SmallFrame.of(brighter, depth), NOISE)
    color[60:, 120:260] = np.random.default_rng(2).integers(0, 255, (180, 140, 3))  # somebody in a third of the image
    depth[60:, 120:260] = 0.8
    assert is_still(anchor, SmallFrame.of(color, depth), NOISE)


def test_small_motions_are_seen(caster: RayCaster) -> None:
    """Two millimetres to the side, one along the view, a twentieth of a degree."""
    anchor = SmallFrame.of(*frame(caster, pose(), 0))
    for twist in ((2e-3, 0, 0, 0, 0, 0), (0, 0, 5e-3, 0, 0, 0), (0, 0, 0, 0, 1e-3, 0), (0, 0, 0, 0, 0, 1.5e-3)):
        moved = SmallFrame.of(*frame(caster, pose() @ se3_exp(np.array(twist)), 1))
        assert not is_still(anchor, moved, NOISE), twist


def test_colour_that_got_stuck_is_no_still_camera(caster: RayCaster) -> None:
    color, depth = frame(caster, pose(), 0)
    elsewhere = frame(caster, pose() @ se3_exp(np.array([0.2, 0, 0, 0, 0.2, 0])), 1)[1]
    assert not is_still(SmallFrame.of(color, depth), SmallFrame.of(color, elsewhere), NOISE)


def test_what_is_fixed_to_the_camera_is_no_still_camera(caster: RayCaster) -> None:
    """A textured holder in the lower third of the image."""
    holder = np.random.default_rng(3).integers(0, 255, (80, 320, 3)).astype(np.uint8)
    frames = []
    for seed, T in enumerate((pose(), pose() @ se3_exp(np.array([0.05, 0, 0, 0, 0.05, 0])))):
        color, depth = frame(caster, T, seed)
        color[160:], depth[160:] = holder, 0.4
        frames.append(SmallFrame.of(color, depth))
    assert not is_still(frames[0], frames[1], NOISE)


def tiles(shift: float, seed: int) -> SmallFrame:
    """A tiled wall at 2 m, whose joints are 12 pixels apart, seen from so many pixels farther left."""
    columns, rows = np.meshgrid(np.arange(160) + shift, np.arange(120))
    grey = np.where((columns / 12 % 1 > 0.12) & (rows / 12 % 1 > 0.12), 200, 60)
    grey = grey + np.random.default_rng(seed).normal(0, 2, grey.shape)
    color = np.repeat(grey[..., None], 3, 2).clip(0, 255).astype(np.uint8)
    return SmallFrame.of(color, np.full((120, 160), 2, np.float32))


@pytest.mark.parametrize("shift", [3.8, 5.0, 7.8, 15.6])
def test_edges_along_a_motion_tell_nothing_of_it(shift: float) -> None:
    """Half of the edges are horizontal, and stay where they are when the camera moves sideways."""
    assert is_still(tiles(0, 0), tiles(0, 1), NOISE)
    assert not is_still(tiles(0, 0), tiles(shift, 1), NOISE)


def test_an_image_without_texture_tells_nothing() -> None:
    blank = SmallFrame.of(np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 2, np.float32))
    assert not is_still(blank, blank, NOISE)


@pytest.mark.long("a room with movers is drawn and tracked")
def test_a_camera_on_a_tripod_stays_where_it_is(tmp_path: Path) -> None:
    """A mug and a drawer move, and a person walks; by geometry and grey values alone it goes 8 cm away."""
    folder = write_synthetic_sequence(
        tmp_path / "still", trajectory="still", seed=3, frames=40, movers=["walker", "mug", "door"]
    )
    sequence, config = open_sequence(folder), Config()
    slam = Slam(
        sequence.camera,
        replace(config, mapping=replace(config.mapping, iterations_per_frame=1, first_frame_iterations=5)),
    )
    for each in sequence.stream():
        slam.step(each)
    places = np.stack([slam.pose_of(each)[:3, 3] for each in slam.frames])
    assert np.linalg.norm(places - places[0], axis=1).max() < 5e-3
    assert len(slam.movers.pixels) > 5
    assert any("stands still in 39 of 40 frames" in note for note in slam.result().notes)


def test_a_note_only_where_the_camera_mostly_stands_still() -> None:
    assert still_notes(4, 10) == [] and len(still_notes(5, 10)) == 1
