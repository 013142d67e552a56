# SPDX-License-Identifier: Apache-2.0
"""Packed splat files: their rows, and what they cannot hold. tests/conformance opens them with other programs."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError, MissingDependency
from ggslam.formats.morton import morton_order
from ggslam.formats.packed_splats import write_spz
from ggslam.formats.splat_file import SPLAT_ROW, write_splat
from ggslam.formats.splat_formats import open_splats
from ggslam.scene.gaussian_map import GaussianMap


def small_map(degree: int = 1, count: int = 600) -> GaussianMap:
    """A room of small Gaussians with their own shape, turn, colour and opacity."""
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    out = GaussianMap(degree, 0, with_moments=False)
    rows = out.insert(
        2 * normal(count, 3), normal(count, 4), -4 + 0.7 * normal(count, 3), 1.5 * normal(count),
        torch.rand(count, 3, generator=generator),
    )  # fmt: skip
    out.sh[rows, 1:] = 0.2 * normal(count, (degree + 1) ** 2 - 1, 3)
    return out


def test_a_splat_file_of_parts_is_that_of_the_whole(tmp_path: Path) -> None:
    one, two, whole = small_map(), small_map(), small_map()
    one.keep(torch.arange(600) < 250)
    two.keep(torch.arange(600) >= 250)
    assert write_splat(tmp_path / "parts.splat", iter([one, two])) == 600
    assert write_splat(tmp_path / "map.splat", [whole]) == 600
    assert (tmp_path / "parts.splat").read_bytes() == (tmp_path / "map.splat").read_bytes()
    assert (tmp_path / "map.splat").stat().st_size == 32 * 600 == SPLAT_ROW.itemsize * 600


def test_morton_order_keeps_neighbours_together() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    order = morton_order(grid)
    assert sorted(order) == list(range(64))
    for start in range(0, 64, 8):
        assert (np.ptp(grid[order[start : start + 8]], axis=0) == 1).all()  # each eight are a cube


def test_too_far_for_spz(tmp_path: Path) -> None:
    pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
    far = small_map()
    far.means[0, 0] = 3000.0
    with pytest.raises(FormatError, match="2048"):
        write_spz(tmp_path / "map.spz", far)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("version", [3, 4])
def test_maps_are_not_trained_for_antialiased_renderers_and_say_so(version: int, tmp_path: Path) -> None:
    for package in ("gaussforge", *(["zstandard"] if version == 4 else [])):
        pytest.importorskip(package, reason=f"{package} is not installed (extra [splats])")
    write_spz(tmp_path / "map.spz", small_map(), version)
    data = (tmp_path / "map.spz").read_bytes()
    header = data if version == 4 else gzip.decompress(data)
    assert header[:4] == b"NGSP" and header[4] == version and header[14] & 1 == 0
    assert open_splats(tmp_path / "map.spz").notes == []


def test_without_gaussforge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(MissingDependency, match="splats"):
        write_spz(tmp_path / "map.spz", small_map())
    assert not list(tmp_path.iterdir())
