# SPDX-License-Identifier: Apache-2.0
"""OpenUSD's ParticleField3DGaussianSplat in text, as a program reads it that knows the schema from its description."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from splat_maps import Splats


def splats_of(values: dict[str, np.ndarray], degree: int) -> Splats:
    """From the schema's attributes; quaternions have the real part first in text."""
    count = len(values["positions"])
    sh = values["radiance:sphericalHarmonicsCoefficients"].reshape(count, (degree + 1) ** 2, 3)
    with np.errstate(divide="ignore"):
        log_scales = np.log(values["scales"])
    ids = values.get("primvars:object_id")
    return Splats(values["positions"], log_scales, values["orientations"], values["opacities"], sh, ids)


def from_text(path: Path) -> tuple[Splats, dict[str, np.ndarray], str]:
    """A .usda with one splat: what it says, all arrays, and the text without them."""
    text = path.read_text(encoding="utf-8")
    arrays: dict[str, np.ndarray] = {}
    for kind, name, body in re.findall(r"^\s+(\w+)\[\] ([\w:]+) = \[(.*?)\]", text, re.M | re.S):
        numbers = np.array(re.findall(r"[-+.\deE]+", body), float)
        width = {"point3f": 3, "float3": 3, "color3f": 3, "quatf": 4}.get(kind)
        arrays[name] = numbers if width is None else numbers.reshape(-1, width)
    (degree,) = re.findall(r"uniform int radiance:sphericalHarmonicsDegree = (\d)", text)
    return splats_of(arrays, int(degree)), arrays, re.sub(r"= \[.*?\]", "", text, flags=re.S)


def from_usda(path: Path) -> Splats:
    """The splat of a .usda."""
    return from_text(path)[0]
