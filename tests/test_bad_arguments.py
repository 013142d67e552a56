# SPDX-License-Identifier: Apache-2.0
"""Whatever is wrong with the arguments of a public call is said by an error of ggslam, in words, not by what broke."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ggslam

CAMERA = ggslam.Camera(40, 30, 30.0, 30.0, 19.5, 14.5)
DEPTH = np.full((30, 40), 2.0, np.float32)
COLOR = np.zeros((30, 40, 3), np.uint8)
POINTS = np.random.default_rng(0).random((50, 3))
MODEL = ggslam.GaussianModel.from_points(POINTS, POINTS)
MIRRORED, DOUBLED = np.diag([-1.0, 1, 1, 1]), np.diag([2.0, 2, 2, 1])


def _render(**pose: np.ndarray) -> object:
    return ggslam.render(MODEL, CAMERA, **pose)


CASES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "camera": (lambda _: ggslam.Camera(0, 30, 30.0, 30.0, 1.0, 1.0), "impossible camera"),
    "fusion, size": (lambda _: ggslam.TsdfMap().integrate(DEPTH[1:], CAMERA, np.eye(4)), r"depth: expected float32"),
    "fusion, pose": (lambda _: ggslam.TsdfMap().integrate(DEPTH, CAMERA, MIRRORED), "expected a rotation"),
    "fusion, mm": (lambda _: ggslam.TsdfMap().integrate(1000 * DEPTH, CAMERA, np.eye(4)), "looks like millimetres"),
    "distance": (lambda _: ggslam.DistanceField(ggslam.TsdfMap()).query(np.zeros((4, 2))), r"expected points \[N, 3\]"),
    "trajectories": (lambda _: ggslam.score_trajectory(np.zeros((3, 4, 4)), np.zeros((4, 4, 4))), "3 estimated and 4"),
    "trajectory": (lambda _: ggslam.score_trajectory(np.zeros((4, 3, 4)), np.zeros((4, 3, 4))), "pose 0: expected a 4"),
    "image, size": (lambda _: ggslam.score_image(COLOR, None, COLOR[1:], DEPTH), "sizes differ"),
    "image, torch": (lambda _: ggslam.score_image(torch.zeros(30, 40, 3), None, COLOR, DEPTH),  # type: ignore[arg-type]
                     r"rendered_color: expected a numpy array, found Tensor; call"),
    "cloud": (lambda _: ggslam.score_cloud(np.zeros((0, 3)), POINTS), r"expected points \[N, 3\]"),
    "masks": (lambda _: ggslam.SegmentationCounts().add(COLOR, COLOR), r"predicted: expected ids uint16"),
    "voxels": (lambda _: ggslam.sample_points(MODEL.to_map(), voxel_size=0), "impossible voxel size"),
    "degree": (lambda _: ggslam.GaussianMap(sh_degree=4), "sh_degree must be 0 to 3"),
    "places": (lambda _: ggslam.objects_at(MODEL.to_map(), np.zeros((4, 2))), "points: expected finite numbers"),
    "tum, shape": (lambda path: ggslam.write_tum(path / "a.txt", [0.0], np.zeros((1, 3, 4))), r"found shape \[1, 3, 4"),
    "tum, count": (lambda path: ggslam.write_tum(path / "a.txt", [0.0], np.zeros((2, 4, 4))), "1 times need poses"),
    "points": (lambda path: ggslam.write_point_cloud(path / "a.ply", POINTS[:, :2], {}), r"points: expected \[N, 3\]"),
    "labels": (lambda path: ggslam.write_point_cloud(path / "a.ply", POINTS, {"label": np.zeros(3, np.uint8)}),
               r"label: expected \[50\]"),
    "xyz": (lambda path: ggslam.write_point_cloud(path / "a.xyz", POINTS, {}), "ends in .ply or .pcd"),
    "no camera": (lambda _: ggslam.Slam(CAMERA.matrix()), "camera: expected a Camera, found ndarray"),  # type: ignore[arg-type]
    "no settings": (lambda _: ggslam.Slam(CAMERA, {"seed": 1}),  # type: ignore[arg-type]
                    r"config: expected a Config, found dict; Config\(\*\*values\)"),
    "extra loss": (lambda _: ggslam.Slam(CAMERA, extra_loss=3), "extra_loss: expected a function, found 3"),  # type: ignore[arg-type]
    "mirrored": (lambda _: _render(T_camera_world=MIRRORED), "T_camera_world: expected a rotation"),
    "doubled": (lambda _: _render(T_world_camera=DOUBLED), "T_world_camera: expected a rotation"),
    "from NaN": (lambda _: ggslam.GaussianModel.from_points(POINTS * np.nan, POINTS), "point 0 is not finite"),
    "from 255": (lambda _: ggslam.GaussianModel.from_points(POINTS, 255 * POINTS), "colors reach from .* to 25"),
    "bytes": (lambda _: ggslam.color_loss(torch.zeros(3, 30, 40), torch.zeros(3, 30, 40, dtype=torch.uint8)),
              "color_loss: expected tensors of floating-point numbers, found torch.uint8; divide it by 255"),
    "list of objects": (lambda _: ggslam.ObjectTable([], 0).select(["sofa"]),  # type: ignore[arg-type]
                        "expected names or ids as text"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_bad_arguments(name: str, tmp_path: Path) -> None:
    call, message = CASES[name]
    with pytest.raises(ggslam.GgslamError, match=message):
        call(tmp_path)
    assert not list(tmp_path.iterdir()), "a file was left"


def test_those_that_were_value_errors_still_are() -> None:
    with pytest.raises(ValueError, match="impossible camera"):
        ggslam.Camera(0, 30, 30.0, 30.0, 1.0, 1.0)


def test_nothing_to_compare_is_none() -> None:
    unknown = np.full((4, 4, 4), np.nan)
    for poses in (unknown, np.eye(4)[None], []):
        assert ggslam.score_trajectory(poses, poses) is None


def test_points_that_lie_on_others_become_gaussians() -> None:
    """As large as if the others were not there."""
    twice = POINTS.copy()
    twice[:30] = POINTS[0]
    distinct = np.unique(twice, axis=0)
    model, expected = (ggslam.GaussianModel.from_points(p, np.ones_like(p)) for p in (twice, distinct))
    row = int(np.flatnonzero((distinct == POINTS[0]).all(1))[0])
    assert torch.allclose(model.log_scales[:30], expected.log_scales[row])
    assert len(ggslam.GaussianModel.from_points(np.zeros((5, 3)), np.zeros((5, 3)))) == 5
