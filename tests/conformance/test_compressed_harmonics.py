# SPDX-License-Identifier: Apache-2.0
"""Harmonics of compressed PLY: rounded or left out so that pictures come nearer to the map, in decibels."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from command_line import succeed
from splat_maps import Splats, from_compressed_ply, small_map
from splat_rendering import Pinhole, decibels, look_at, render

from ggslam.formats import compressed_ply
from ggslam.formats.compressed_ply import write_compressed_ply
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Pinhole.centred()
POSES = [look_at((0.5, -1.0, -5.0)), look_at((0.2, 0.1, 0.3), (2.0, 0.5, 1.0))]


def independent(*deviations: float) -> GaussianMap:
    """A map whose harmonics of degrees 1, 2 and 3 deviate by so much from zero, each Gaussian's by its own."""
    gaussians = small_map(3, 500, -1.8)
    for degree, deviation in enumerate(deviations, start=1):
        gaussians.sh[:, degree**2 : (degree + 1) ** 2] *= deviation / 0.3
    return gaussians


def alike(value: float, count: int = 2000) -> GaussianMap:
    """A map whose Gaussians all have the same harmonics, as those of a shiny surface do; many to a pixel."""
    gaussians = small_map(3, count, -1.8)
    gaussians.opacity_logits[:] = -1.5
    gaussians.sh[:, 1:] = value * torch.randn((1, 15, 3), generator=torch.Generator().manual_seed(3)).sign()
    return gaussians


def nearest(higher: np.ndarray) -> np.ndarray:
    """Every harmonic in the interval that it lies in."""
    return np.floor((higher.astype(np.float64) / 8 + 0.5) * 256).clip(0, 255)


def score(path: Path, gaussians: GaussianMap) -> float:
    found, expected = from_compressed_ply(path), Splats.of(gaussians)
    return decibels([render(found, CAMERA, p) for p in POSES], [render(expected, CAMERA, p) for p in POSES])


def scores(gaussians: GaussianMap, folder: Path) -> tuple[float, float, float, int]:
    """Decibels of what is written, of all harmonics rounded to the nearest, of none; and the degree that is written."""
    degree = write_compressed_ply(folder / "chosen.ply", gaussians)
    found = [score(folder / "chosen.ply", gaussians)]
    for way in (nearest, lambda higher: np.empty((len(higher), 0, 3))):
        with mock.patch.object(compressed_ply, "harmonics_worth_storing", way):
            write_compressed_ply(folder / "other.ply", gaussians)
        found.append(score(folder / "other.ply", gaussians))
    return (*found, degree)


@pytest.mark.parametrize("deviations", [(0.002, 0.002, 0.002), (0.008, 0.004, 0.003)])
def test_what_is_too_faint_is_left_out(deviations: tuple[float, ...], tmp_path: Path) -> None:
    chosen, all_rounded, none, degree = scores(independent(*deviations), tmp_path)
    assert degree == 0 and chosen == none > all_rounded + 2


def test_degrees_below_what_is_too_faint_stay(tmp_path: Path) -> None:
    chosen, all_rounded, none, degree = scores(independent(0.2, 0.1, 0.002), tmp_path)
    assert degree == 2 and chosen > all_rounded + 0.2 and chosen > none + 10


def test_strong_ones_are_rounded_to_the_nearest(tmp_path: Path) -> None:
    chosen, all_rounded, none, degree = scores(independent(0.3, 0.3, 0.3), tmp_path)
    assert degree == 3 and chosen == all_rounded > none + 10


def test_what_neighbours_share_comes_back_in_their_mean(tmp_path: Path) -> None:
    """Half a step or less: each for itself they would come back as 1/64, all alike."""
    chosen, all_rounded, none, degree = scores(alike(0.006), tmp_path)
    assert degree == 3 and chosen > none + 1 and chosen > all_rounded + 5, (chosen, all_rounded, none)


def test_export_says_what_it_left_out(tmp_path: Path) -> None:
    write_gaussian_ply(tmp_path / "map.ply", independent(0.2, 0.1, 0.002))
    out = tmp_path / "out.compressed.ply"
    assert "left out colours of degree 3" in succeed("export", tmp_path / "map.ply", "--out", out)
    write_gaussian_ply(tmp_path / "map.ply", independent(0.3, 0.3, 0.3))
    assert "left out" not in succeed("export", tmp_path / "map.ply", "--out", out)
