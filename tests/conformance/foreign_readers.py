# SPDX-License-Identifier: Apache-2.0
"""Programs and packages of others that read splats, as the tests call them; a test is skipped where they are not."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from splat_maps import Splats, convert, from_ply
from usd_reader import splats_of


def command_of(program: str, variable: str) -> list[str]:
    """What a variable of the environment says, or a program on the PATH; skips the test where there is neither."""
    command = os.environ.get(variable) or shutil.which(program)
    if not command:
        pytest.skip(f"{program} is not there ({variable}, or on the PATH)")
    return shlex.split(command)


def splat_transform_command() -> list[str]:
    """PlayCanvas' program (npm install -g @playcanvas/splat-transform)."""
    return command_of("splat-transform", "GGSLAM_SPLAT_TRANSFORM")


def by_splat_transform(path: Path, folder: Path) -> Splats:
    """By way of a 3DGS PLY, into which it copies what stands in the file, axes as they are. From version 2 on it turns
    SPZ, which has to be turned back."""
    command = splat_transform_command()
    source: list[str | Path] = [path / "lod-meta.json", "-L", "0"] if path.is_dir() else [path]
    said = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=60)
    version = re.search(r"v(\d+)\.", said.stdout + said.stderr)
    if path.suffix == ".spz" and version is not None and int(version[1]) >= 2:
        source += ["-r", "180,0,0"]
    convert(command, *source, folder / "seen.ply")
    return from_ply(folder / "seen.ply")


def by_gsply(path: Path, folder: Path) -> Splats:
    gsply = pytest.importorskip("gsply", reason="gsply is not installed (extra [formats])")
    data = gsply.read_spz(str(path)) if path.suffix == ".spz" else gsply.plyread(str(path))
    sh = [np.asarray(data.sh0).reshape(-1, 1, 3)]
    if data.shN is not None and np.size(data.shN):
        sh.append(np.asarray(data.shN).reshape(len(sh[0]), -1, 3))
    opacities = 1 / (1 + np.exp(-np.ravel(data.opacities).astype(float)))
    return Splats(data.means, data.scales, data.quats, opacities, np.concatenate(sh, 1))


def by_gaussforge(path: Path, folder: Path) -> Splats:
    """By way of a 3DGS PLY."""
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
    answer = gaussforge.GaussForge().convert(path.read_bytes(), path.suffix[1:], "ply")
    assert "error" not in answer, answer
    (folder / "seen.ply").write_bytes(answer["data"])
    return from_ply(folder / "seen.ply")


def by_usd_core(path: Path, folder: Path) -> Splats:
    """OpenUSD's own library, which knows the schema."""
    pytest.importorskip("pxr", reason="usd-core is not installed (extra [usd])")
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField3DGaussianSplat)]
    names = ("positions", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients", "primvars:object_id")
    values = {name: np.array(prim.GetAttribute(name).Get()) for name in names if prim.HasAttribute(name)}
    turns = prim.GetAttribute("orientations").Get()
    values["orientations"] = np.array([[q.GetReal(), *q.GetImaginary()] for q in turns])
    degree = UsdVol.ParticleField3DGaussianSplat(prim).GetRadianceSphericalHarmonicsDegreeAttr().Get()
    return splats_of(values, degree)


@dataclass(frozen=True)
class ForeignReader:
    """A reader and the formats of `ggslam export` that it takes."""

    read: Callable[[Path, Path], Splats]
    formats: tuple[str, ...]


FOREIGN_READERS = {
    "splat-transform": ForeignReader(
        by_splat_transform, ("ply", "segmented", "compressed-ply", "spz", "spz4", "splat", "sog", "streamed-sog")
    ),
    "gsply": ForeignReader(by_gsply, ("ply", "segmented", "compressed-ply", "spz")),
    "usd-core": ForeignReader(by_usd_core, ("usd",)),
    "gaussforge": ForeignReader(by_gaussforge, ("ply", "segmented", "splat")),
}  # fmt: skip
