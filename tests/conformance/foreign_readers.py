# SPDX-License-Identifier: Apache-2.0
"""Programs and packages of others that read splats, as the tests call them; a test is skipped where they are not."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from splat_maps import Splats, convert, from_ply


def splat_transform_command() -> list[str]:
    """PlayCanvas' splat-transform: GGSLAM_SPLAT_TRANSFORM, or `splat-transform` on the PATH."""
    command = os.environ.get("GGSLAM_SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if not command:
        pytest.skip("splat-transform is not there (GGSLAM_SPLAT_TRANSFORM, or on the PATH)")
    return shlex.split(command)


def by_splat_transform(path: Path, folder: Path) -> Splats:
    """By way of a 3DGS PLY, into which it copies what stands in the file, axes as they are."""
    convert(splat_transform_command(), path, folder / "seen.ply")
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


@dataclass(frozen=True)
class ForeignReader:
    """A reader and the formats of `ggslam export` that it takes."""

    read: Callable[[Path, Path], Splats]
    formats: tuple[str, ...]


FOREIGN_READERS = {
    "splat-transform": ForeignReader(
        by_splat_transform, ("ply", "segmented", "compressed-ply", "spz", "spz4", "splat")
    ),
    "gsply": ForeignReader(by_gsply, ("ply", "segmented", "compressed-ply", "spz")),
    "gaussforge": ForeignReader(by_gaussforge, ("ply", "segmented", "splat")),
}  # fmt: skip
