# SPDX-License-Identifier: Apache-2.0
"""The same settings serve a table top, a room and a hall."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ggslam.geometry.scene_size import scene_scale
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.tracking.scale import scale_settings
from ggslam.tracking.settings import TrackerSettings


def test_rooms_are_the_measure() -> None:
    for depth, scale in ((1.0, 1.0), (2.2, 1.0), (4.0, 1.0), (16.0, 4.0), (0.5, 0.5)):
        image = np.full((6, 8), depth, np.float32)
        image[0] = 0
        assert scene_scale(image) == pytest.approx(scale)
    assert scene_scale(np.zeros((6, 8), np.float32)) == 1.0
    usual = TrackerSettings()
    assert scale_settings(usual, 1.0) == usual
    assert scale_settings(usual, 4.0).target.voxel == 4 * usual.target.voxel
    assert (scale_settings(usual, 4.0).points.max_depth, scale_settings(usual, 0.5).points.max_depth) == (32.0, 8.0)


@pytest.mark.parametrize("size", [0.2, 1.0, 4.0])
def test_the_defaults_track_scenes_of_all_sizes(room: Path, size: float) -> None:
    """The room as a doll's house and as a hall; with the voxels of a room all but the first frames of the hall are
    lost."""
    sequence = open_sequence(room, stop=10)
    assert sequence.ground_truth is not None
    slam = Slam(sequence.camera, load_config(None, ["mapping.iterations_per_frame=0", "identity.enabled=false"]))
    for frame in sequence.stream(masks=False):
        slam.step(replace(frame, depth=frame.depth * np.float32(size)))
    result = slam.finish()
    assert [frame.status for frame in result.frames].count("lost") == 0
    expected = inverse(sequence.ground_truth[0]) @ sequence.ground_truth[:10]
    apart = np.linalg.norm(result.trajectory()[:, :3, 3] / size - expected[:, :3, 3], axis=1)
    assert apart.max() < 0.02
