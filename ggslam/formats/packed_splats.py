# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps in two packed formats, written by the package gaussforge (extra `[splats]`).

Compressed PLY (PlayCanvas; SuperSplat opens it): chunks of 256 Gaussians, positions and scales with 11, 10 and 11 bits
between the corners of their chunk. Axes as in the map. SPZ (Niantic, version 3, gzip): positions in steps of 1/4096 m,
everything else in bytes. Its specification puts y upwards and z backwards, so the map (y down, z forward at the first
camera) is turned by 180 degrees about x on the way.

Neither holds object ids or identities.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from ggslam.errors import FormatError, MissingDependency, RunFolderError
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.atomic import write_bytes

SPZ_REACH = 2048.0
"""Metres: positions in SPZ are 24 bits with 12 behind the point."""
_ODD_IN_Y_AND_Z = (1, 2, 4, 7, 9, 11, 12, 14)
"""Spherical harmonics, in the order of 3DGS, that change sign when y and z do."""


def check_gaussforge(path: str | Path) -> ModuleType:
    """The package gaussforge.

    Raises:
        MissingDependency: it is not installed; says how to get it.
    """
    try:
        import gaussforge
    except ImportError as error:
        raise MissingDependency(
            f"to write {path} the package gaussforge is needed: `pip install 'ggslam[splats]'` ({error})"
        ) from None
    return gaussforge


def write_compressed_ply(path: str | Path, gaussians: GaussianMap) -> None:
    """Writes a compressed PLY, whole or not at all. Rows are put into Morton order, so that chunks are small.

    Args:
        path: the file to write.
        gaussians: at least one.

    Raises:
        MissingDependency: gaussforge is not installed.
        RunFolderError: the file cannot be written.
    """
    gaussforge = check_gaussforge(path)
    order = torch.from_numpy(morton_order(gaussians.means.detach().cpu().numpy()))
    columns = {name: values[order] for name, values in _columns(gaussians).items()}
    write_bytes(path, _pack(gaussforge, path, columns, gaussians.sh_degree, "compressed.ply"))


def write_spz(path: str | Path, gaussians: GaussianMap) -> None:
    """Writes an SPZ file, whole or not at all.

    Args:
        path: the file to write; ends in .spz.
        gaussians: at least one, within `SPZ_REACH` of the origin.

    Raises:
        MissingDependency: gaussforge is not installed.
        FormatError: a Gaussian is too far away for the format.
        RunFolderError: the file cannot be written.
    """
    gaussforge = check_gaussforge(path)
    farthest = float(gaussians.means.abs().max())
    if not farthest < SPZ_REACH:
        raise FormatError(f"{path}: SPZ holds positions up to {SPZ_REACH:g} m, found {farthest:g} m; write a PLY")
    columns = _columns(gaussians)
    columns["positions"][:, 1:] *= -1
    columns["rotations"][:, 2:] *= -1  # D R D with D = diag(1, -1, -1): the same ellipsoid as D R
    odd = [index - 1 for index in _ODD_IN_Y_AND_Z if index <= columns["sh"].shape[1]]
    columns["sh"][:, odd] *= -1
    write_bytes(path, _pack(gaussforge, path, columns, gaussians.sh_degree, "spz"))


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices int64 [N] that put points, float [N, 3], in the order of a Z-shaped curve of 2^16 cells a side."""
    low = points.min(0)
    extent = max(float((points.max(0) - low).max()), 1e-12)
    cells = ((points - low) / extent * 65535).astype(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for axis in range(3):
        key |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(key, kind="stable")


def _spread(values: np.ndarray) -> np.ndarray:
    """Puts two zero bits between the 16 bits of numbers (uint64)."""
    steps = ((16, 0x00FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249))
    for shift, mask in steps:
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values


def _columns(gaussians: GaussianMap) -> dict[str, torch.Tensor]:
    """Copies of what a map consists of, by the names that gaussforge gives it: the numbers of a 3DGS PLY."""
    columns = {
        "positions": gaussians.means, "scales": gaussians.log_scales, "alphas": gaussians.opacity_logits,
        "rotations": torch.nn.functional.normalize(gaussians.quaternions, dim=1), "colors": gaussians.sh[:, 0],
        "sh": gaussians.sh[:, 1:],
    }  # fmt: skip
    return {name: values.detach().cpu().clone() for name, values in columns.items()}


def _pack(
    gaussforge: ModuleType, path: str | Path, columns: dict[str, torch.Tensor], degree: int, kind: str
) -> bytes:  # fmt: skip
    values = {name: np.ascontiguousarray(column.numpy(), np.float32).tobytes() for name, column in columns.items()}
    known = {"numPoints": len(columns["positions"]), "meta": {"shDegree": degree, "sourceFormat": "ply"}, "extras": {}}
    answer = gaussforge.GaussForge().write({**known, **values}, kind)
    if "error" in answer:
        raise RunFolderError(f"cannot write {path}: gaussforge: {answer['error']}")
    return bytes(answer["data"])
