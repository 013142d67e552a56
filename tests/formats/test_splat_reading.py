# SPDX-License-Identifier: Apache-2.0
"""Readers of splats on what the conformance tests do not have: old versions, moved nodes, damaged and huge files."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ggslam.errors import FormatError
from ggslam.formats.compressed_ply import write_compressed_ply
from ggslam.formats.gaussian_gltf import write_gaussian_gltf
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.sog import write_sog
from ggslam.formats.splat_file import write_splat
from ggslam.formats.splat_formats import open_splats, read_splats, splat_format
from ggslam.scene.gaussian_map import GaussianMap


def some_map(count: int = 40, degree: int = 1) -> GaussianMap:
    random = torch.Generator().manual_seed(2)
    out = GaussianMap(degree, with_moments=False)
    numbers = [torch.randn((count, width), generator=random) for width in (3, 4, 3)]
    out.insert(numbers[0], numbers[1], numbers[2] - 4, 0.5, torch.rand((count, 3), generator=random))
    out.sh[:, 1:] = 0.2 * torch.randn(out.sh[:, 1:].shape, generator=random)
    return out


def spz(version: int, xyz: np.ndarray, rotation: bytes, flags: int = 0) -> bytes:
    """A file of version 1 or 2 with Gaussians of 2^-4 m, a grey base colour and no harmonics; y is up in it."""
    n = len(xyz)
    if version == 1:
        positions = xyz.astype("<f2").tobytes()
    else:
        steps = np.rint(xyz * 4096).astype("<i4")
        positions = steps.view("u1").reshape(n, 3, 4)[..., :3].tobytes()
    size = int(np.rint(16 * (np.log(2.0**-4) + 10)))
    body = struct.pack("<4sIIBBBB", b"NGSP", version, n, 0, 12, flags, 0) + positions
    return gzip.compress(body + bytes([128]) * n + bytes([128]) * 3 * n + bytes([size]) * 3 * n + rotation)


@pytest.mark.parametrize("version", [1, 2])
def test_spz_of_the_first_versions(version: int, tmp_path: Path) -> None:
    """Quaternions of three bytes: the vector part. A turn by 90 degrees about z is one by -90 degrees, y being down."""
    xyz = np.array([[0.5, 1.25, -2.0], [-3.0, 0.125, 4.0]])
    root = round(127.5 * (1 + np.sqrt(0.5)))
    (tmp_path / "map.spz").write_bytes(spz(version, xyz, bytes([127, 128, root] * 2)))
    found = read_splats(tmp_path / "map.spz")
    np.testing.assert_allclose(found.means.numpy(), xyz * [1, -1, -1], atol=1e-6)
    np.testing.assert_allclose(found.scales.numpy(), 2.0**-4, rtol=0.04)
    turn = Rotation.from_quat(np.roll(found.quaternions.numpy()[0], -1)).as_matrix()
    np.testing.assert_allclose(turn, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=0.02)
    assert found.rgb.numpy() == pytest.approx(0.5, abs=0.01)


def test_the_flag_of_an_antialiased_spz_is_named_and_changes_no_number(tmp_path: Path) -> None:
    """Bit 0x1 of the flags; another one means nothing of it."""
    xyz, turns, maps = np.array([[0.5, 1.25, -2.0]]), bytes([127, 128, 127]), []
    for flags, named in ((0, False), (1, True), (2, False), (3, True)):
        (tmp_path / "map.spz").write_bytes(spz(2, xyz, turns, flags))
        opened = open_splats(tmp_path / "map.spz")
        assert [note.startswith("antialiased") for note in opened.notes] == [True] * named
        maps.append(opened.rows.read(0, 1))
    for found in maps:
        assert torch.equal(found.log_scales, maps[0].log_scales)
        assert torch.sigmoid(found.opacity_logits).numpy() == pytest.approx(128 / 255, abs=1e-6)


def test_gltf_whose_node_is_turned_scaled_and_moved(tmp_path: Path) -> None:
    """And whose buffer is a file of its own: positions, sizes, turns and colours follow."""
    gaussians = some_map()
    write_gaussian_gltf(tmp_path / "map.glb", 40, [gaussians], 1)
    data = (tmp_path / "map.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    gltf = json.loads(data[20 : 20 + length])
    R = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    gltf["nodes"] = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "rotation": R.as_quat().tolist(),
                                                                  "scale": [2, 2, 2]}]  # fmt: skip
    gltf["buffers"][0]["uri"] = "map.bin"
    (tmp_path / "map.bin").write_bytes(data[28 + length :])
    (tmp_path / "map.gltf").write_text(json.dumps(gltf))
    found, D = read_splats(tmp_path / "map.gltf"), np.diag([1.0, -1, -1])
    expected = D @ (2 * R.as_matrix() @ D @ gaussians.means.double().numpy().T + np.array([[1], [2], [3]]))
    np.testing.assert_allclose(found.means.numpy(), expected.T, atol=1e-5)
    np.testing.assert_allclose(found.log_scales.numpy(), gaussians.log_scales.numpy() + np.log(2), atol=1e-5)
    moved, T = some_map(), torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(D @ R.as_matrix() @ D)
    moved.move(torch.arange(40), T)
    np.testing.assert_allclose(found.sh.numpy(), moved.sh.numpy(), atol=1e-5)
    gltf["nodes"][1]["scale"] = [2, 2, 1]
    (tmp_path / "map.gltf").write_text(json.dumps(gltf))
    with pytest.raises(FormatError, match="stretched"):
        read_splats(tmp_path / "map.gltf")


def test_a_mesh_is_no_map(tmp_path: Path) -> None:
    text = json.dumps({"asset": {"version": "2.0"}, "meshes": []}).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text
    (tmp_path / "mesh.glb").write_bytes(data)
    assert splat_format(tmp_path / "mesh.glb") is None and splat_format(tmp_path / "none.sog") is None


@pytest.mark.parametrize("name", ["map.ply", "c.compressed.ply", "map.sog", "map.spz", "map.glb", "map.splat"])
def test_cut_off_and_damaged_files_are_refused_or_read_but_never_crash(name: str, tmp_path: Path) -> None:
    path, gaussians, random = tmp_path / name, some_map(), np.random.default_rng(3)
    if name.endswith(".spz"):
        path.write_bytes(spz(2, random.normal(size=(40, 3)), bytes(120)))
    else:
        {"map.ply": write_gaussian_ply, "c.compressed.ply": write_compressed_ply, "map.sog": write_sog,
         "map.splat": lambda p, g: write_splat(p, [g]),
         "map.glb": lambda p, g: write_gaussian_gltf(p, 40, [g], 1)}[name](path, gaussians)  # fmt: skip
    data, refused = path.read_bytes(), 0
    for cut in range(0, len(data), max(1, len(data) // 40)):
        path.write_bytes(data[:cut])
        try:
            assert len(read_splats(path)) <= 40
        except FormatError as error:
            assert str(path) in str(error)
            refused += 1
    assert refused >= 30 or name == "map.splat"  # any number of rows is a file of that
    for _ in range(150):
        broken = bytearray(data)
        for place in random.integers(0, min(len(data), 3000), 3):
            broken[place] = random.integers(0, 256)
        path.write_bytes(broken)
        try:
            read_splats(path)
        except FormatError as error:
            assert str(path) in str(error)


def test_claims_are_checked_before_anything_is_decoded(tmp_path: Path) -> None:
    bomb = struct.pack("<4sIIBBBB", b"NGSP", 3, 10**8, 3, 12, 0, 0) + bytes(1 << 20)
    (tmp_path / "map.spz").write_bytes(gzip.compress(bomb))
    with pytest.raises(FormatError, match=r"map\.spz.*100000000"):
        read_splats(tmp_path / "map.spz")
    write_sog(tmp_path / "map.sog", some_map())
    with zipfile.ZipFile(tmp_path / "map.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    wide = bytearray(files["quats.webp"])
    wide[21:25] = ((16000 - 1) | (16000 - 1) << 14).to_bytes(4, "little")  # in the header of a lossless image
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in {**files, "quats.webp": bytes(wide)}.items():
            archive.writestr(name, content)
    (tmp_path / "wide.sog").write_bytes(out.getvalue())
    with pytest.raises(FormatError, match=r"wide\.sog.*16000x16000.*40"):
        read_splats(tmp_path / "wide.sog")


def test_names_that_lead_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    write_sog(tmp_path / "in" / "meta.json", some_map())
    (tmp_path / "quats.webp").write_bytes((tmp_path / "in" / "quats.webp").read_bytes())
    meta = json.loads((tmp_path / "in" / "meta.json").read_text())
    meta["quats"]["files"] = ["../quats.webp"]
    (tmp_path / "in" / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(FormatError, match=r"meta\.json.*file"):
        read_splats(tmp_path / "in")


def test_usd_in_centimetres_with_z_upwards(tmp_path: Path) -> None:
    """Written by usd-core itself: a prim moved by 2 m, sizes of 3 cm, one colour along z."""
    pytest.importorskip("pxr", reason="usd-core is not installed (extra [usd])")
    from pxr import Gf, Usd, UsdGeom, UsdVol

    stage = Usd.Stage.CreateNew(str(tmp_path / "map.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.Xform.Define(stage, "/above").AddTranslateOp().Set(Gf.Vec3d(0, 0, 200))
    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/above/splat")
    splat.CreatePositionsAttr([Gf.Vec3f(100, 0, 0), Gf.Vec3f(0, 300, 0)])
    splat.CreateScalesAttr([Gf.Vec3f(3, 3, 6)] * 2)
    splat.CreateOrientationsAttr([Gf.Quatf(1, 0, 0, 0)] * 2)
    splat.CreateOpacitiesAttr([0.25, 1.0])
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(1)
    along_z = [Gf.Vec3f(0, 0, 0), Gf.Vec3f(0, 0, 0), Gf.Vec3f(0.5, 0.5, 0.5), Gf.Vec3f(0, 0, 0)]
    splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(along_z * 2)
    stage.Save()
    found = read_splats(tmp_path / "map.usda")
    np.testing.assert_allclose(found.means.numpy(), [[1, -2, 0], [0, -2, 3]], atol=1e-6)  # y is down, z forward
    turn = Rotation.from_quat(np.roll(found.quaternions.numpy()[0], -1)).as_matrix()
    covariance = turn @ np.diag(np.square(found.scales.numpy()[0])) @ turn.T
    np.testing.assert_allclose(covariance, np.diag([0.03**2, 0.06**2, 0.03**2]), atol=1e-8)  # long upwards
    np.testing.assert_allclose(found.opacities.numpy(), [0.25, 1], atol=2e-6)
    np.testing.assert_allclose(found.sh.numpy()[0, 1:, 0], [0.5, 0, 0], atol=1e-6)  # -y is up: 0.4886 times -y
