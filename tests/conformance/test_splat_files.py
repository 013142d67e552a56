# SPDX-License-Identifier: Apache-2.0
"""What is particular to single splat formats: how near their bits allow, what the rest of a file says, what they cannot
hold. test_exported_splats.py holds them all to the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from splat_formats import UPRIGHT
from splat_maps import (
    DIRECTIONS,
    Splats,
    convert,
    from_compressed_ply,
    from_glb,
    from_ply,
    glb_attributes,
    glb_parts,
    ply_elements,
    small_map,
    spz_streams,
)

from ggslam.errors import FormatError
from ggslam.formats.compressed_ply import write_compressed_ply
from ggslam.formats.gaussian_gltf import write_gaussian_gltf
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.morton import morton_order
from ggslam.formats.packed_splats import write_spz

DEGREES = [0, 1, 2, 3]


def check_same(seen: Splats, written: Splats, turn: np.ndarray | None = None, rounding: float = 1e-6) -> None:
    """Exact but for float32: positions, shapes, opacities, colours from everywhere; `turn`: of the file's axes."""
    R = np.eye(3) if turn is None else turn
    np.testing.assert_allclose(seen.means, written.means @ R.T, atol=1e-6)
    expected = R @ written.covariances() @ R.T
    difference = np.linalg.norm(seen.covariances() - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert difference.max() < 1e-5
    np.testing.assert_allclose(seen.opacities, written.opacities, atol=rounding)
    assert seen.sh.shape == written.sh.shape
    for direction in DIRECTIONS:
        np.testing.assert_allclose(seen.colors(R @ direction), written.colors(direction), atol=1e-5)


def check_packed(seen: Splats, written: Splats) -> None:
    """As near as the bits of a compressed PLY allow, rows in Morton order."""
    written = written.take(morton_order(written.means))
    for start in range(0, len(written.means), 256):
        chunk = slice(start, start + 256)
        for found, given in ((seen.means, written.means), (seen.log_scales, written.log_scales)):
            step = np.ptp(given[chunk], axis=0) / np.array([2047, 1023, 2047])
            assert (np.abs(found[chunk] - given[chunk]) <= 0.51 * step + 2e-6).all()
        step = np.ptp(written.sh[chunk, 0], axis=0) / 255
        assert (np.abs(seen.sh[chunk, 0] - written.sh[chunk, 0]) <= 0.51 * step + 2e-6).all()
    unit = [q / np.linalg.norm(q, axis=1, keepdims=True) for q in (seen.quaternions, written.quaternions)]
    assert np.abs((unit[0] * unit[1]).sum(1)).min() > 1 - 3e-6  # half a step of sqrt(2)/1023 in each of three
    np.testing.assert_allclose(seen.opacities, written.opacities, atol=0.51 / 255 + 1e-6)
    assert seen.sh.shape == written.sh.shape
    np.testing.assert_allclose(seen.sh[:, 1:], written.sh[:, 1:], atol=1 / 64 + 1e-5)


@pytest.mark.parametrize("degree", DEGREES)
def test_ply(degree: int, tmp_path: Path) -> None:
    gaussians = small_map(degree)
    write_gaussian_ply(tmp_path / "map.ply", gaussians, ["object_id"])
    check_same(from_ply(tmp_path / "map.ply"), Splats.of(gaussians))
    np.testing.assert_array_equal(ply_elements(tmp_path / "map.ply")["vertex"]["object_id"], gaussians.object_id)


@pytest.mark.parametrize("degree", DEGREES)
def test_compressed_ply(degree: int, tmp_path: Path) -> None:
    gaussians = small_map(degree)
    write_compressed_ply(tmp_path / "map.compressed.ply", gaussians)
    check_packed(from_compressed_ply(tmp_path / "map.compressed.ply"), Splats.of(gaussians))


def test_extremes_in_a_compressed_ply(tmp_path: Path) -> None:
    """One Gaussian, opaque, as flat as can be, with colours out of reach: readers find finite numbers."""
    gaussians = small_map(1, 1)
    gaussians.opacity_logits[:] = 100.0
    gaussians.log_scales[0, 2] = -60.0
    gaussians.sh[0, 1:] = 9.0
    write_compressed_ply(tmp_path / "map.ply", gaussians)
    seen = from_compressed_ply(tmp_path / "map.ply")
    np.testing.assert_array_equal(seen.means, gaussians.means)
    np.testing.assert_allclose(seen.log_scales[0], [*gaussians.log_scales[0, :2], -20.0])
    assert seen.opacities[0] == 254 / 255 and (seen.sh[0, 1:] == 4.0).all()


def test_what_no_compressed_ply_can_hold(tmp_path: Path) -> None:
    gaussians = small_map(0, 5)
    gaussians.log_scales[3, 1] = float("inf")
    with pytest.raises(FormatError, match="size of Gaussian 3"):
        write_compressed_ply(tmp_path / "map.ply", gaussians)
    gaussians.keep(gaussians.opacities > 2)
    with pytest.raises(FormatError, match="at least one"):
        write_compressed_ply(tmp_path / "map.ply", gaussians)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("degree", DEGREES)
def test_gltf(degree: int, tmp_path: Path) -> None:
    gaussians, one, two = small_map(degree), small_map(degree), small_map(degree)
    first = torch.arange(600) < 250
    one.keep(first)
    two.keep(~first)
    path = tmp_path / "map.glb"
    write_gaussian_gltf(path, 600, iter([one, two]), degree, {1: "mug", 2: "", 3: "chair \u00e4", 4: "4"})
    check_same(from_glb(path), Splats.of(gaussians), UPRIGHT)
    gltf, _ = glb_parts(path)
    primitive = gltf["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and set(gltf["extensionsUsed"]) == set(primitive["extensions"])
    kernel = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (kernel["kernel"], kernel["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    found = glb_attributes(path)
    corners = gltf["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(found["POSITION"].min(0), corners["min"])
    np.testing.assert_array_equal(found["POSITION"].max(0), corners["max"])
    rotation = found["KHR_gaussian_splatting:ROTATION"]
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    light = found["COLOR_0"][:, :3] / 65535
    shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown, gaussians.rgb.clamp(0, 1), atol=2e-4)
    np.testing.assert_allclose(found["COLOR_0"][:, 3] / 65535, gaussians.opacities, atol=1e-5)
    np.testing.assert_array_equal(found["_FEATURE_ID_0"][:, 0], gaussians.object_id)
    (ids,) = primitive["extensions"]["EXT_mesh_features"]["featureIds"]
    assert (ids["attribute"], ids["nullFeatureId"], ids["featureCount"]) == (0, 0, 5)
    assert gltf["meshes"][0]["extras"]["objects"] == {"1": "mug", "2": "", "3": "chair \u00e4", "4": "4"}


@pytest.mark.parametrize("degree", DEGREES)
def test_gltf_is_what_splat_transform_writes(degree: int, tmp_path: Path, splat_transform: list[str]) -> None:
    """Of our PLY, turned by 180 degrees about y: it takes splats for turned about z, not x, and cannot read glTF."""
    gaussians = small_map(degree)
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    convert(splat_transform, tmp_path / "map.ply", "-r", "0,180,0", tmp_path / "theirs.glb")
    write_gaussian_gltf(tmp_path / "ours.glb", 600, [gaussians], degree)
    ours, theirs = glb_attributes(tmp_path / "ours.glb"), glb_attributes(tmp_path / "theirs.glb")
    assert set(ours) == set(theirs)
    (primitive,) = glb_parts(tmp_path / "ours.glb")[0]["meshes"][0]["primitives"]
    (their,) = glb_parts(tmp_path / "theirs.glb")[0]["meshes"][0]["primitives"]
    assert primitive["extensions"] == their["extensions"] and primitive["mode"] == their["mode"]
    check_same(from_glb(tmp_path / "theirs.glb"), Splats.of(gaussians), UPRIGHT)
    for name in set(ours) - {"COLOR_0", "KHR_gaussian_splatting:ROTATION"}:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-5, atol=2e-6)


def test_what_no_gltf_can_hold(tmp_path: Path) -> None:
    path, gaussians = tmp_path / "map.glb", small_map(0, 5)
    with pytest.raises(FormatError, match="at least one"):
        write_gaussian_gltf(path, 0, [], 0)
    with pytest.raises(ValueError, match=r"\b5\b.*\b6\b"):
        write_gaussian_gltf(path, 6, [gaussians], 0)
    with pytest.raises(ValueError, match=r"\b5\b.*\b3\b"):
        write_gaussian_gltf(path, 3, [gaussians], 0)
    with pytest.raises(FormatError, match="GLB holds 4"):
        write_gaussian_gltf(path, 2**26, [gaussians], 0)
    gaussians.object_id[2] = 2**24 + 1
    with pytest.raises(FormatError, match="ids.*16777216"):
        write_gaussian_gltf(path, 5, [gaussians], 0, {1: ""})
    gaussians.log_scales[1, 1] = 100.0
    with pytest.raises(FormatError, match="float32"):
        write_gaussian_gltf(path, 5, [gaussians], 0)
    gaussians.means[4, 0] = float("nan")
    with pytest.raises(FormatError, match="position of Gaussian 4"):
        write_gaussian_gltf(path, 5, [gaussians], 0)
    assert not list(tmp_path.iterdir())


def test_gltf_by_trimesh(tmp_path: Path) -> None:
    """A program without the extension sees a cloud of points."""
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra [mesh])")
    gaussians = small_map(1)
    write_gaussian_gltf(tmp_path / "map.glb", 600, [gaussians], 1, {1: "mug"})
    (cloud,) = trimesh.load_scene(tmp_path / "map.glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, gaussians.means.numpy() @ UPRIGHT, atol=1e-6)


@pytest.mark.parametrize("degree", DEGREES)
def test_both_versions_of_spz_hold_the_same(degree: int, tmp_path: Path) -> None:
    pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
    pytest.importorskip("zstandard", reason="zstandard is not installed (extra [splats])")
    gaussians = small_map(degree)
    for version in (3, 4):
        write_spz(tmp_path / f"{version}.spz", gaussians, version)
    streams = spz_streams(tmp_path / "4.spz")
    assert streams == spz_streams(tmp_path / "3.spz") and len(streams) == (6 if degree else 5)
