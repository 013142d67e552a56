# SPDX-License-Identifier: Apache-2.0
"""`.splat` files: 32 bytes a Gaussian, without a header, as web viewers load them.

The layout is that of the program that it came with (github.com/antimatter15/splat): per Gaussian float32 x y z
(metres), float32 standard deviations (metres), uint8 red green blue and opacity, uint8 quaternion wxyz as
128 + 128 q. Colours do not depend on the viewing direction; there are neither object ids nor identities.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_reader import read_whole
from ggslam.formats.splat_repair import columns_of, logarithms_of, logits_of
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.system.atomic import atomic_write
from ggslam.system.untrusted_files import read_untrusted

SPLAT_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian as it is stored."""


def write_splat(path: str | Path, parts: Iterable[GaussianMap]) -> int:
    """Writes a map that comes in parts, of which one is in memory at a time; whole or not at all.

    Args:
        path: the file to write.
        parts: in the order of the file.

    Returns:
        The number of Gaussians written.

    Raises:
        RunFolderError: the file cannot be written.
    """
    count = 0
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        for part in parts:
            file.write(splat_rows(part).tobytes())
            count += len(part)
    return count


def splat_rows(gaussians: GaussianMap) -> np.ndarray:
    """The Gaussians as they are stored, `SPLAT_ROW` [N]: colours and opacities rounded to 1/255, quaternions of unit
    length rounded to 1/128."""
    rows = np.empty(len(gaussians), SPLAT_ROW)
    rgba = torch.cat([gaussians.rgb, gaussians.opacities[:, None]], 1)
    unit = torch.nn.functional.normalize(gaussians.quaternions, dim=1)
    rows["position"] = gaussians.means.detach().cpu().numpy()
    rows["scale"] = gaussians.scales.detach().cpu().numpy()
    rows["rgba"] = _bytes(255 * rgba)
    rows["rotation"] = _bytes(128 + 128 * unit)
    return rows


def read_splat(path: Path) -> SplatColumns:
    """The Gaussians of a file.

    Raises:
        FormatError: it is missing, empty, or no whole number of Gaussians long.
    """
    data = read_untrusted(path)
    if not data or len(data) % SPLAT_ROW.itemsize:
        raise FormatError(f"{path}: {len(data)} bytes, expected a multiple of {SPLAT_ROW.itemsize} bytes")
    rows = np.frombuffer(data, SPLAT_ROW)
    rgba = rows["rgba"] / 255
    sh = ((rgba[:, None, :3] - 0.5) / SH_C0).astype(np.float32)
    quaternions = (rows["rotation"].astype(np.float32) - 128) / 128
    return columns_of(rows["position"], logarithms_of(rows["scale"]), quaternions, logits_of(rgba[:, 3]), sh)


def _bytes(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().round().clamp(0, 255).to(torch.uint8).numpy()


def _write(path: Path, splats: Splats) -> str:
    write_splat(path, splats.parts())
    return splats.text(path)


WRITER = Writer("splat", (".splat",), Takes.GAUSSIANS, "the same in 32 bytes a Gaussian", _write)
READER = read_whole(".splat", lambda path, head: path.suffix.lower() == ".splat", read_splat)
