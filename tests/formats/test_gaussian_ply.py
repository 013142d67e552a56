# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps survive a PLY round trip, and an independent reader sees the same Gaussians, turned the same way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError
from ggslam.formats.gaussian_ply import EXTRAS, read_gaussian_ply, write_gaussian_ply
from ggslam.formats.ply import read_ply, write_ply
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.scene.gaussian_map import GaussianMap

ARRAYS = ("means", "log_scales", "opacity_logits", "sh", "features", "object_id")


def random_map(count: int = 50, degree: int = 2, features: int = 3) -> GaussianMap:
    generator = torch.Generator().manual_seed(7)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    out = GaussianMap(degree, features)
    rows = out.insert(
        normal(count, 3), normal(count, 4), normal(count, 3), normal(count), torch.rand(count, 3),
        normal(count, features), object_id=torch.arange(count),
    )  # fmt: skip
    out.sh[rows, 1:] = normal(count, (degree + 1) ** 2 - 1, 3)
    return out


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip_is_exact(tmp_path: Path, degree: int) -> None:
    written = random_map(degree=degree)
    write_gaussian_ply(tmp_path / "map.ply", written, extra=("object_id", "identity"))
    found = read_gaussian_ply(tmp_path / "map.ply")
    assert found.sh_degree == degree and found.feature_channels == 3
    for name in ARRAYS:
        torch.testing.assert_close(getattr(found, name), getattr(written, name), rtol=0, atol=0)
    unit = torch.nn.functional.normalize(written.quaternions, dim=1)
    torch.testing.assert_close(found.quaternions, unit)


def test_extras_only_when_asked_and_field_names_of_3dgs(tmp_path: Path) -> None:
    write_gaussian_ply(tmp_path / "map.ply", random_map(degree=1))
    names = read_ply(tmp_path / "map.ply").elements["vertex"].dtype.names
    expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 " + " ".join(f"f_rest_{i}" for i in range(9))
    assert names == (*expected.split(), "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    assert read_gaussian_ply(tmp_path / "map.ply").feature_channels == 0
    with pytest.raises(ValueError, match="labels"):
        write_gaussian_ply(tmp_path / "map.ply", random_map(), extra=["labels"])


def test_all_properties_are_of_one_type(tmp_path: Path) -> None:
    """Several readers know no other; object ids are whole numbers, and integers are still read."""
    written = random_map()
    written.object_id[:2] = torch.tensor([65535, 0])
    write_gaussian_ply(tmp_path / "map.ply", written, EXTRAS)
    vertex = read_ply(tmp_path / "map.ply").elements["vertex"]
    assert {vertex.dtype[name] for name in vertex.dtype.names or ()} == {np.dtype("<f4")}
    np.testing.assert_array_equal(vertex["object_id"], written.object_id)
    cloud = read_point_cloud(tmp_path / "map.ply")
    np.testing.assert_array_equal(cloud.labels["object_id"], written.object_id)
    assert cloud.labels["object_id"].dtype == np.int32 and list(cloud.labels) == ["object_id"]
    kinds = [(name, "<i4" if name == "object_id" else "<f4") for name in vertex.dtype.names or ()]
    write_ply(tmp_path / "whole.ply", {"vertex": vertex.astype(kinds)})
    np.testing.assert_array_equal(read_gaussian_ply(tmp_path / "whole.ply").object_id, written.object_id)
    for odd in (0.5, np.nan, 3e9):
        broken = vertex.copy()
        broken["object_id"][7] = odd
        write_ply(tmp_path / "odd.ply", {"vertex": broken})
        with pytest.raises(FormatError, match=r"'object_id' of vertex 7 "):
            read_gaussian_ply(tmp_path / "odd.ply")
    written.object_id[3] = 2**24 + 1
    with pytest.raises(FormatError, match=r"map\.ply: .*16777216"):
        write_gaussian_ply(tmp_path / "map.ply", written, EXTRAS)
    np.testing.assert_array_equal(read_ply(tmp_path / "map.ply").elements["vertex"], vertex)


def test_higher_colour_degrees_are_channel_major(tmp_path: Path) -> None:
    written = random_map(degree=1)
    write_gaussian_ply(tmp_path / "map.ply", written)
    vertex = read_ply(tmp_path / "map.ply").elements["vertex"]
    for channel in range(3):
        for k in range(3):
            np.testing.assert_array_equal(vertex[f"f_rest_{3 * channel + k}"], written.sh[:, 1 + k, channel])


def test_empty_map(tmp_path: Path) -> None:
    write_gaussian_ply(tmp_path / "map.ply", GaussianMap())
    assert len(read_gaussian_ply(tmp_path / "map.ply")) == 0


def stick() -> GaussianMap:
    """One Gaussian, 1 m long along its own x axis, turned by 90 degrees about z and then 30 degrees about x."""
    about_z = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    half = np.deg2rad(15)
    about_x = np.array([np.cos(half), np.sin(half), 0, 0])
    w, x, y, z = about_x
    a, b, c, d = about_z
    product = [w * a - x * b, w * b + x * a, w * c - x * d, w * d + x * c]  # y = z = 0
    out = GaussianMap()
    out.insert(
        torch.tensor([[1.0, 2.0, 3.0]]), 2 * torch.tensor([product]), torch.log(torch.tensor([[1.0, 0.01, 0.02]])),
        torch.tensor([2.0]), torch.tensor([[1.0, 0.5, 0.0]]),
    )  # fmt: skip
    return out


STICK_DIRECTION = np.array([0.0, np.cos(np.deg2rad(30)), np.sin(np.deg2rad(30))])
"""x goes to y under the first rotation, and y into the y-z plane under the second."""


def rodrigues(q_wxyz: np.ndarray, v: np.ndarray) -> np.ndarray:
    """v turned by a unit quaternion, by axis and angle."""
    angle, axis = 2 * np.arccos(q_wxyz[0]), q_wxyz[1:] / np.linalg.norm(q_wxyz[1:])
    return v * np.cos(angle) + np.cross(axis, v) * np.sin(angle) + axis * (axis @ v) * (1 - np.cos(angle))


def test_a_turned_gaussian_points_where_it_should(tmp_path: Path) -> None:
    write_gaussian_ply(tmp_path / "map.ply", stick())
    row = read_ply(tmp_path / "map.ply").elements["vertex"][0]
    q = np.array([row[f"rot_{i}"] for i in range(4)], float)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(rodrigues(q, np.array([1.0, 0, 0])), STICK_DIRECTION, atol=1e-6)
    assert row["scale_0"] == pytest.approx(0, abs=1e-6) and row["opacity"] == 2


def test_an_independent_reader_agrees(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (an independent 3DGS reader)")
    write_gaussian_ply(tmp_path / "stick.ply", stick())
    seen = gsply.plyread(str(tmp_path / "stick.ply"))
    np.testing.assert_allclose(seen.means, [[1, 2, 3]])
    np.testing.assert_allclose(np.exp(seen.scales), [[1, 0.01, 0.02]], rtol=1e-5)
    np.testing.assert_allclose(
        rodrigues(seen.quats[0].astype(float), np.array([1.0, 0, 0])), STICK_DIRECTION, atol=1e-6
    )
    written = random_map(degree=3, features=0)
    write_gaussian_ply(tmp_path / "map.ply", written)
    seen = gsply.plyread(str(tmp_path / "map.ply"))
    np.testing.assert_array_equal(seen.sh0, written.sh[:, 0])
    np.testing.assert_array_equal(np.ravel(seen.opacities), written.opacity_logits)
    np.testing.assert_array_equal(seen.shN, written.sh[:, 1:])


def test_what_an_independent_writer_writes_is_read(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (an independent 3DGS writer)")
    source = random_map(degree=0)
    arrays = [source.means, source.log_scales, source.quaternions, source.opacity_logits, source.sh[:, 0]]
    gsply.plywrite(str(tmp_path / "map.ply"), *[a.numpy() for a in arrays])
    found = read_gaussian_ply(tmp_path / "map.ply")
    for name, expected in zip(("means", "log_scales", "quaternions", "opacity_logits"), arrays, strict=False):
        torch.testing.assert_close(getattr(found, name), expected)


def test_damaged_maps_are_refused(tmp_path: Path) -> None:
    good, path = tmp_path / "map.ply", tmp_path / "bad.ply"
    write_gaussian_ply(good, random_map(degree=1))
    vertex = read_ply(good).elements["vertex"]

    def refused(rows: np.ndarray, reason: str) -> None:
        write_ply(path, {"vertex": rows})
        with pytest.raises(FormatError, match=rf"bad\.ply.*{reason}"):
            read_gaussian_ply(path)

    names = list(vertex.dtype.names or ())
    refused(vertex[[n for n in names if n not in ("scale_2", "rot_3")]].copy(), "scale_2.*rot_3")
    refused(vertex[[n for n in names if n != "f_rest_4"]].copy(), "not numbered")
    refused(vertex[[n for n in names if n != "f_rest_8"]].copy(), "0, 9, 24 or 45")
    broken = vertex.copy()
    broken["scale_1"][7] = np.nan
    refused(broken, "'scale_1'.* 7 .*nan")
    broken = vertex.copy()
    for i in range(4):
        broken[f"rot_{i}"][3] = 0
    refused(broken, "quaternion.* 3 ")
    refused(vertex.astype([(n, "u1" if n == "rot_0" else "f4") for n in names]), "rot_0.*floating")
    write_ply(path, {"points": vertex})
    with pytest.raises(FormatError, match=r"bad\.ply.*no Gaussians"):
        read_gaussian_ply(path)


def test_a_trained_map_of_other_software(shared_data: Path) -> None:
    path = shared_data / "clouds" / "angel.ply"
    if not path.exists():
        pytest.skip(f"no {path.name}")
    found = read_gaussian_ply(path)
    assert len(found) == 71359 and found.sh_degree == 0
    assert 0 < float(found.opacities.mean()) < 1 and float(found.scales.median()) < float(found.means.std())
