# SPDX-License-Identifier: Apache-2.0
"""PLY files of Gaussians of others: bad ones are left out or bounded, and said; what others add is applied or named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.formats.gaussian_ply_reading import PlyGaussianRows, apply_filter
from ggslam.formats.gaussian_rows import GaussianRowsTuning
from ggslam.formats.ply import write_ply
from ggslam.formats.splat_formats import open_splats, read_splats
from ggslam.scene.gaussian_map import SH_C0
from ggslam.system.tuning import overridden

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)),
         *(f"rot_{i}" for i in range(4))]  # fmt: skip


def rows(count: int = 300, names: list[str] | None = None, seed: int = 0) -> np.ndarray:
    """Good Gaussians, as structured rows."""
    names = names or NAMES
    random, out = np.random.default_rng(seed), np.zeros(count, [(name, "f4") for name in names])
    for name in names:
        out[name] = random.normal(size=count) - (3 if name.startswith("scale") else 0)
    return out


def stored(path: Path, vertex: np.ndarray) -> Path:
    write_ply(path, {"vertex": vertex})
    return path


@pytest.mark.parametrize(("name", "value", "bad", "what"), [
    ("scale_0", np.inf, 30, "size is infinite"), ("scale_1", np.nan, 1, "size is infinite"),
    ("opacity", np.nan, 1, "opacity is no number"), ("x", np.nan, 2, "position is no number"),
    ("y", -np.inf, 2, "position is no number"), ("f_dc_1", np.nan, 3, "colour is no number"),
    ("rot_2", np.nan, 4, "quaternion is zero"),
])  # fmt: skip
def test_gaussians_that_cannot_be_drawn_are_left_out(
    name: str, value: float, bad: int, what: str, tmp_path: Path
) -> None:
    good = rows()
    vertex, gone = good.copy(), np.random.default_rng(1).choice(300, bad, replace=False)
    vertex[name][gone] = value
    opened = open_splats(stored(tmp_path / "map.ply", vertex))
    assert len(opened.notes) == 1 and opened.notes[0].startswith(f"{bad} of 300 Gaussians left out: {what}")
    kept = np.setdiff1d(np.arange(300), gone)
    np.testing.assert_array_equal(read_splats(tmp_path / "map.ply").means.numpy()[:, 0], good["x"][kept])
    with pytest.raises(FormatError, match=name):  # a run's own map.ply is damaged then
        read_gaussian_ply(tmp_path / "map.ply")


def test_gaussians_that_can_be_bounded_are(tmp_path: Path) -> None:
    vertex = rows()
    vertex["scale_2"][:30], vertex["opacity"][30:40], vertex["opacity"][40:45] = -np.inf, np.inf, -np.inf
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        vertex[name][50:80] = 0
    opened = open_splats(stored(tmp_path / "map.ply", vertex))
    found = opened.rows.read(0, len(opened.rows))
    assert len(found) == 270 and len(opened.notes) == 3
    wide = np.maximum(vertex["scale_0"], vertex["scale_1"])[:30]
    np.testing.assert_allclose(found.log_scales.numpy()[:30, 2], wide - np.log(1000), rtol=1e-6)
    np.testing.assert_allclose(found.opacities.numpy()[30:45], [1 - 1e-6] * 10 + [1e-6] * 5, atol=1e-6)
    assert "30 of 300 Gaussians left out: quaternion is zero" in opened.notes[0]


def test_2d_gaussians_are_thin_discs(tmp_path: Path) -> None:
    vertex = rows(names=[name for name in NAMES if name != "scale_2"])
    opened = open_splats(stored(tmp_path / "map.ply", vertex))
    sizes = opened.rows.read(0, 300).log_scales.numpy()
    np.testing.assert_allclose(sizes[:, 2], np.maximum(vertex["scale_0"], vertex["scale_1"]) - np.log(1000), rtol=1e-6)
    assert len(opened.notes) == 1 and "2D Gaussians" in opened.notes[0]


def test_the_filter_of_mip_splatting_is_part_of_sizes_and_opacities(tmp_path: Path) -> None:
    """A ball of 3 cm with a filter of 4 cm has 5 cm and 0.6^3 of its opacity; none without a filter changes."""
    vertex = rows(3, [*NAMES, "filter_3D"])
    for name in ("scale_0", "scale_1", "scale_2"):
        vertex[name] = np.log(0.03)
    vertex["opacity"] = 0.0
    vertex["filter_3D"] = [0.04, 0.0, np.nan]
    opened = open_splats(stored(tmp_path / "map.ply", vertex))
    found = opened.rows.read(0, 3)
    np.testing.assert_allclose(found.scales.numpy(), [[0.05] * 3, [0.03] * 3, [0.03] * 3], rtol=1e-5)
    np.testing.assert_allclose(found.opacities.numpy(), [0.5 * 0.6**3, 0.5, 0.5], rtol=1e-5)
    assert len(opened.notes) == 1 and "filter_3D" in opened.notes[0]


def test_the_filter_keeps_mass() -> None:
    """opacity times the root of the determinant stays, of ellipsoids of any shape."""
    random = np.random.default_rng(0)
    log_scales, logits = random.normal(-3, 1, (50, 3)).astype("f4"), random.normal(size=50).astype("f4")
    size = random.uniform(0.001, 0.1, 50)
    wider, fainter = apply_filter(log_scales, logits, size)
    np.testing.assert_allclose(np.exp(2 * wider), np.exp(2 * log_scales) + size[:, None] ** 2, rtol=1e-5)
    before, after = (1 / (1 + np.exp(-x.astype(float))) * np.exp(s.astype(float).sum(1))
                     for x, s in ((logits, log_scales), (fainter, wider)))  # fmt: skip
    np.testing.assert_allclose(after, before, rtol=1e-4)


def test_what_others_add_is_named(tmp_path: Path) -> None:
    opened = open_splats(stored(tmp_path / "map.ply", rows(5, [*NAMES, *(f"obj_dc_{i}" for i in range(16))])))
    assert opened.notes == ["left out 16 properties that are not of 3DGS: obj_dc_0, obj_dc_1, ..., obj_dc_15"]


def test_harmonics_of_degree_4_become_3_and_bytes_are_colours(tmp_path: Path) -> None:
    names = [name for name in NAMES if not name.startswith("f_dc")] + [f"f_rest_{i}" for i in range(72)]
    plain = rows(4, names)
    vertex = np.zeros(4, [*plain.dtype.descr, ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for name in names:
        vertex[name] = plain[name]
    vertex["green"] = [0, 51, 102, 255]
    opened = open_splats(stored(tmp_path / "map.ply", vertex))
    found = opened.rows.read(0, 4)
    np.testing.assert_allclose(found.rgb.numpy()[:, 1], [0, 0.2, 0.4, 1], atol=1e-6)
    np.testing.assert_array_equal(found.sh.numpy()[:, 15, 2], vertex["f_rest_62"])  # the 15th of the third channel's 24
    assert found.sh_degree == 3 and "27 of 72" in opened.notes[0]
    assert float(0.5 + SH_C0 * found.sh[0, 0, 0]) == pytest.approx(0, abs=1e-6)


def test_blocks_are_the_whole_without_the_bad_ones(tmp_path: Path) -> None:
    with overridden(GaussianRowsTuning, rows_at_once=64):
        vertex = rows(1000)
        gone = np.random.default_rng(5).random(1000) < 0.3
        gone[[0, 63, 64, 999]] = True
        vertex["opacity"][gone] = np.nan
        found = PlyGaussianRows(stored(tmp_path / "map.ply", vertex))
        expected = vertex["x"][~gone]
        assert len(found) == len(expected)
        np.testing.assert_array_equal(np.concatenate([b.means.numpy()[:, 0] for b in found.blocks()]), expected)
        for start, count in ((0, 1), (17, 100), (len(expected) - 1, 1), (5, 0)):
            np.testing.assert_array_equal(found.read(start, count).means.numpy()[:, 0], expected[start : start + count])


def test_files_without_a_good_gaussian_are_refused(tmp_path: Path) -> None:
    vertex = rows(5)
    vertex["x"] = np.nan
    with pytest.raises(FormatError, match="no Gaussian that can be drawn.*5 of 5"):
        open_splats(stored(tmp_path / "map.ply", vertex))
    with pytest.raises(FormatError, match="no Gaussians in a format that is known"):
        open_splats(stored(tmp_path / "points.ply", rows(5, ["x", "y", "z"])))
