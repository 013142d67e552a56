# SPDX-License-Identifier: Apache-2.0
"""OpenUSD's ParticleField3DGaussianSplat at every degree of spherical harmonics: the text read as its description says,
without any library, every kind of file by usd-core, which knows the schema, and the layout against what NVIDIA's
usd-convert-gsplat writes (conftest.py)."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splat_maps import DIRECTIONS, Splats, small_map
from usd_reader import from_text, splats_of

from ggslam.errors import FormatError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.gaussian_usd import write_gaussian_usd

pxr = pytest.importorskip("pxr", reason="usd-core is not installed (extra [usd])")
DEGREES = [0, 1, 2, 3]
UPRIGHT = np.diag([1.0, -1.0, -1.0])
NAMES = {1: "mug", 2: "", 3: "chair \u00e4"}


def splat_of(stage: Any) -> Any:
    """The only splat of a stage."""
    from pxr import UsdVol

    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField3DGaussianSplat)]
    return UsdVol.ParticleField3DGaussianSplat(prim)


def check_same(seen: Splats, written: Splats, turn: np.ndarray = UPRIGHT) -> None:
    """Exact but for float32, turned."""
    np.testing.assert_allclose(seen.means, written.means @ turn, atol=1e-6)
    expected = turn @ written.covariances() @ turn
    difference = np.linalg.norm(seen.covariances() - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert difference.max() < 1e-5
    np.testing.assert_allclose(seen.opacities, written.opacities, atol=1e-6)
    for direction in DIRECTIONS:
        np.testing.assert_allclose(seen.colors(turn @ direction), written.colors(direction), atol=1e-5)


@pytest.mark.parametrize("degree", DEGREES)
def test_text(degree: int, tmp_path: Path) -> None:
    gaussians = small_map(degree)
    write_gaussian_usd(tmp_path / "map.usda", gaussians, NAMES)
    seen, arrays, text = from_text(tmp_path / "map.usda")
    check_same(seen, Splats.of(gaussians))
    np.testing.assert_array_equal(arrays["primvars:object_id"], gaussians.object_id)
    np.testing.assert_allclose(arrays["primvars:displayColor"], gaussians.rgb.clamp(0, 1), atol=1e-6)
    low, high = arrays["extent"]
    assert (low < seen.means.min(0)).all() and (high > seen.means.max(0)).all()
    for words in ('upAxis = "Y"', "metersPerUnit = 1", 'defaultPrim = "map"', 'string "1" = "mug"', "chair \u00e4",
                  'def ParticleField3DGaussianSplat "gaussians"', 'projectionModeHint = "perspective"'):  # fmt: skip
        assert words in text, words


@pytest.mark.parametrize("ending", [".usd", ".usda", ".usdc", ".usdz"])
@pytest.mark.parametrize("degree", DEGREES)
def test_by_usd_core(degree: int, ending: str, tmp_path: Path) -> None:
    from pxr import Usd

    gaussians, path = small_map(degree), tmp_path / f"map{ending}"
    write_gaussian_usd(path, gaussians, NAMES)
    stage = Usd.Stage.Open(str(path))
    splat = splat_of(stage)
    prim = splat.GetPrim()
    values = {name: np.array(prim.GetAttribute(name).Get()) for name in
              ("positions", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")}  # fmt: skip
    rotations = prim.GetAttribute("orientations").Get()
    values["orientations"] = np.array([[q.GetReal(), *q.GetImaginary()] for q in rotations])
    check_same(splats_of(values, splat.GetRadianceSphericalHarmonicsDegreeAttr().Get()), Splats.of(gaussians))
    ids = prim.GetAttribute("primvars:object_id")
    np.testing.assert_array_equal(ids.Get(), gaussians.object_id)
    assert prim.GetCustomDataByKey("objects") == {str(number): name for number, name in NAMES.items()}
    head = path.read_bytes()[:8]
    if ending == ".usdz":
        with zipfile.ZipFile(path) as archive:
            assert archive.namelist() == ["map.usdc"] and not any(i.compress_type for i in archive.infolist())
    else:
        assert head.startswith(b"#usda" if ending == ".usda" else b"PXR-USDC")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_layout_is_that_of_nvidias_converter(tmp_path: Path, usd_convert_gsplat: list[str]) -> None:
    """Of our PLY, which it does not turn: the same attributes, and the numbers in the same order."""
    gaussians = small_map(3)
    write_gaussian_ply(tmp_path / "map.ply", gaussians)
    words = ["-i", str(tmp_path / "map.ply"), "-o", str(tmp_path / "theirs.usda")]
    subprocess.run([*usd_convert_gsplat, *words], check=True, capture_output=True, timeout=300)
    write_gaussian_usd(tmp_path / "ours.usda", gaussians)
    seen, theirs, text = from_text(tmp_path / "theirs.usda")
    _, ours, own = from_text(tmp_path / "ours.usda")
    assert set(ours) == set(theirs)
    for line in ("elementSize = 16", 'interpolation = "vertex"', 'upAxis = "Y"', "metersPerUnit = 1"):
        assert line in text and line in own
    check_same(seen, Splats.of(gaussians), np.eye(3))


def test_without_objects(tmp_path: Path) -> None:
    write_gaussian_usd(tmp_path / "map.usda", small_map(0))
    _, arrays, text = from_text(tmp_path / "map.usda")
    assert "primvars:object_id" not in arrays and "objects" not in text


def test_the_schema_says_nothing_against_it(tmp_path: Path) -> None:
    """usd-core's own validators, where it has them."""
    from pxr import Usd, UsdValidation

    write_gaussian_usd(tmp_path / "map.usdz", small_map(2), NAMES)
    registry = UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    assert validators
    stage = Usd.Stage.Open(str(tmp_path / "map.usdz"))
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_what_no_usd_can_hold(tmp_path: Path) -> None:
    gaussians = small_map(0, 5)
    with pytest.raises(FormatError, match="at least one"):
        write_gaussian_usd(tmp_path / "map.usda", small_map(0, 0))
    gaussians.log_scales[1, 1] = 100.0
    with pytest.raises(FormatError, match="float32"):
        write_gaussian_usd(tmp_path / "map.usda", gaussians)
    gaussians.means[4, 0] = float("nan")
    with pytest.raises(FormatError, match="position of Gaussian 4"):
        write_gaussian_usd(tmp_path / "map.usda", gaussians)
    assert not list(tmp_path.iterdir())
