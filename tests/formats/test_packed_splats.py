# SPDX-License-Identifier: Apache-2.0
"""Packed splat files, opened by programs that share no code with what writes them: gsply; for `.splat`, gaussforge."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError, MissingDependency
from ggslam.formats.compressed_ply import write_compressed_ply
from ggslam.formats.morton import morton_order
from ggslam.formats.packed_splats import write_spz
from ggslam.formats.ply import read_ply
from ggslam.formats.splat_file import SPLAT_ROW, write_splat
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import quaternion_to_matrix


class Seen(NamedTuple):
    """What another program reads: numbers as in a 3DGS PLY."""

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    logits: np.ndarray
    base: np.ndarray
    higher: np.ndarray


def seen_by_gsply(path: Path) -> Seen:
    """A packed file as gsply reads it."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (an independent reader)")
    data = gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(path)
    higher = np.zeros((len(data.means), 0, 3)) if data.shN is None else np.asarray(data.shN).reshape(len(data), -1, 3)
    return Seen(data.means, data.scales, data.quats, np.ravel(data.opacities), data.sh0, higher)


def seen_by_gaussforge(path: Path) -> Seen:
    """A `.splat` file as gaussforge reads it, by way of a 3DGS PLY."""
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed (an independent reader)")
    answer = gaussforge.GaussForge().convert(path.read_bytes(), "splat", "ply")
    assert "error" not in answer, answer
    converted = path.with_suffix(".ply")
    converted.write_bytes(answer["data"])
    rows = read_ply(converted).elements["vertex"]

    def columns(*names: str) -> np.ndarray:
        return np.stack([rows[name] for name in names], 1)

    return Seen(columns("x", "y", "z"), columns("scale_0", "scale_1", "scale_2"),
                columns("rot_0", "rot_1", "rot_2", "rot_3"), rows["opacity"], columns("f_dc_0", "f_dc_1", "f_dc_2"),
                np.zeros((len(rows), 0, 3)))  # fmt: skip


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


def covariances(log_scales: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    R = quaternion_to_matrix(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
    return (R * np.exp(2 * log_scales)[:, None, :]) @ R.transpose(0, 2, 1)


def relative_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Of matrices [N, 3, 3]: the largest, against the norm."""
    return float((np.linalg.norm(one - other, axis=(1, 2)) / np.linalg.norm(other, axis=(1, 2))).max())


def evaluated(base: np.ndarray, higher: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Colours [N, 3] seen along one direction: real spherical harmonics up to degree 3, the signs of 3DGS."""
    x, y, z = direction / np.linalg.norm(direction)
    xx, yy, zz = x * x, y * y, z * z
    basis = np.array([
        -0.4886025119 * y, 0.4886025119 * z, -0.4886025119 * x,
        1.0925484306 * x * y, -1.0925484306 * y * z, 0.3153915652 * (2 * zz - xx - yy),
        -1.0925484306 * x * z, 0.5462742153 * (xx - yy),
        -0.5900435899 * y * (3 * xx - yy), 2.8906114426 * x * y * z, -0.4570457995 * y * (4 * zz - xx - yy),
        0.3731763326 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570457995 * x * (4 * zz - xx - yy),
        1.4453057213 * z * (xx - yy), -0.5900435899 * x * (xx - 3 * yy),
    ])  # fmt: skip
    return 0.5 + 0.28209479177 * base + np.einsum("k,nkc->nc", basis[: higher.shape[1]], higher)


@pytest.fixture(scope="module")
def written() -> GaussianMap:
    return small_map()


def test_splat(written: GaussianMap, tmp_path: Path) -> None:
    one, two = small_map(), small_map()
    one.keep(torch.arange(600) < 250)
    two.keep(torch.arange(600) >= 250)
    assert write_splat(tmp_path / "map.splat", iter([one, two])) == 600
    assert (tmp_path / "map.splat").stat().st_size == 32 * 600 == SPLAT_ROW.itemsize * 600
    seen = seen_by_gaussforge(tmp_path / "map.splat")
    np.testing.assert_array_equal(seen.means, written.means)
    np.testing.assert_allclose(seen.log_scales, written.log_scales, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-seen.logits)), written.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(0.5 + 0.28209479 * seen.base, written.rgb, atol=0.51 / 255)
    unit = torch.nn.functional.normalize(written.quaternions, dim=1).numpy()
    agreement = np.abs((unit * seen.quaternions / np.linalg.norm(seen.quaternions, axis=1, keepdims=True)).sum(1))
    assert np.arccos(agreement.clip(max=1)).max() < np.sqrt(4) * 0.51 / 128  # half a step in each of four numbers


def test_compressed_ply(written: GaussianMap, tmp_path: Path) -> None:
    write_compressed_ply(tmp_path / "map.ply", written)
    seen = seen_by_gsply(tmp_path / "map.ply")
    order = morton_order(written.means.numpy())
    means = written.means.numpy()[order]
    for start in range(0, 600, 256):
        chunk = slice(start, start + 256)
        step = np.ptp(means[chunk], axis=0) / np.array([2047, 1023, 2047])
        assert (np.abs(seen.means[chunk] - means[chunk]) <= 0.51 * step + 1e-6).all()
    np.testing.assert_allclose(0.5 + 0.28209479 * seen.base, written.rgb.numpy()[order], atol=1.01 / 255)
    np.testing.assert_allclose(1 / (1 + np.exp(-seen.logits)), written.opacities.numpy()[order], atol=1.01 / 255)
    expected = covariances(written.log_scales.numpy()[order], written.quaternions.numpy()[order])
    assert relative_difference(covariances(seen.log_scales, seen.quaternions), expected) < 0.05


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_is_turned_upright(degree: int, tmp_path: Path) -> None:
    """Axes of SPZ: x right, y up, z backwards. A direction turned like the map shows the same colours."""
    pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
    written, turn = small_map(degree), np.diag([1.0, -1.0, -1.0])
    write_spz(tmp_path / "map.spz", written)
    seen = seen_by_gsply(tmp_path / "map.spz")
    np.testing.assert_allclose(seen.means, written.means.numpy() @ turn, atol=0.51 / 4096)
    expected = turn @ covariances(written.log_scales.numpy(), written.quaternions.numpy()) @ turn
    assert relative_difference(covariances(seen.log_scales, seen.quaternions), expected) < 0.08
    np.testing.assert_allclose(1 / (1 + np.exp(-seen.logits)), written.opacities, atol=1.01 / 255)
    for direction in np.array([[0.3, -0.5, 0.8], [-0.7, 0.2, -0.1]]):
        colors = evaluated(seen.base, seen.higher, turn @ direction)
        before = evaluated(written.sh[:, 0].numpy(), written.sh[:, 1:].numpy(), direction)
        bound = 0.283 * 0.51 / (0.15 * 255) + 3 * np.sqrt((degree + 1) ** 2 - 1) / 16  # higher ones are coarse in SPZ
        assert np.abs(colors - before).max() < bound
        if degree:
            assert np.abs(colors - before).mean() < 0.05
            assert np.abs(evaluated(seen.base, seen.higher, direction) - before).mean() > 0.1  # unturned: not the same


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


def test_without_gaussforge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(MissingDependency, match="splats"):
        write_spz(tmp_path / "map.spz", small_map())
    assert not list(tmp_path.iterdir())
