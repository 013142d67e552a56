# SPDX-License-Identifier: Apache-2.0
"""The reference software of G-PCC, as the benchmarks run it: tmc3 of release-v12.9, which `GGSLAM_TMC3` names or which
is on PATH."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.coding.container import UnitType, read_units
from ggslam.formats.point_cloud import ColoredCloud, read_point_cloud

DENSE = {
    "trisoupNodeSizeLog2": 0, "mergeDuplicatedPoints": 1, "neighbourAvailBoundaryLog2": 8,
    "adjacentChildContextualization": 1, "intra_pred_max_node_size_log2": 6, "inferredDirectCodingMode": 0,
    "qtbtEnabled": 0, "planarEnabled": 0,
}  # fmt: skip
"""The tools of the geometry that our encoder uses on dense clouds."""


@dataclass(frozen=True)
class Spent:
    """What the reference says of the time it took, seconds of one processor.

    Attributes:
        coding: of geometry and attributes.
        whole: with what stands around it: encoding, the transfer of colours to the coded points.
    """

    coding: float
    whole: float


def reference_binary() -> str | None:
    """The reference software, if the machine has it."""
    return os.environ.get("GGSLAM_TMC3") or shutil.which("tmc3")


def reference_encode(
    binary: str, source: Path, stream: Path, qp: int | None, scale: float = 1, tools: dict[str, int] | None = None
) -> Spent:
    """Codes a PLY of whole coordinates.

    Args:
        qp: of the colours; None: no colours.
        scale: of the positions.
        tools: of the geometry; None: `DENSE`.
    """
    options: dict[str, object] = {
        "mode": 0, "uncompressedDataPath": source, "compressedStreamPath": stream, "positionQuantizationScale": scale,
        **(DENSE if tools is None else tools),
    }  # fmt: skip
    if qp is not None:
        options |= {"convertPlyColourspace": 1, "colourMatrix": 1, "transformType": 0, "qp": qp, "qpChromaOffset": 0,
                    "bitdepth": 8, "attribute": "color"}  # fmt: skip
    return _spent(_run(binary, options))


def reference_decode(binary: str, stream: Path, out: Path) -> tuple[ColoredCloud, Spent]:
    """Decodes a stream to a PLY in the units that the stream tells."""
    said = _run(binary, {"mode": 1, "compressedStreamPath": stream, "reconstructedDataPath": out, "outputBinaryPly": 1,
                         "convertPlyColourspace": 1})  # fmt: skip
    return read_point_cloud(out), _spent(said)


def _run(binary: str, options: dict[str, object]) -> str:
    """Runs the reference and returns what it says; `attribute` has to be its last option."""
    command = [binary, *(f"--{name}={value}" for name, value in options.items())]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode or "Error" in done.stdout:
        raise SystemExit(f"{binary} failed:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def _spent(said: str) -> Spent:
    parts = re.findall(r"^\w+ processing time \(user\): ([0-9.]+)", said, re.M)
    return Spent(sum(map(float, parts)), float(re.findall(r"Processing time \(user\): ([0-9.]+)", said)[-1]))


def payloads(data: bytes) -> tuple[bytes, bytes]:
    """Geometry and attribute units of a stream of one slice; of the former what follows the header's counters."""
    units = {unit.kind: bytes(unit.payload) for unit in read_units(data)}
    return units[UnitType.GEOMETRY][3:], units.get(UnitType.ATTRIBUTE, b"")


def unit_sizes(data: bytes) -> tuple[int, int]:
    """Bytes of geometry and of attributes, headers of their units included."""
    sizes = dict.fromkeys(UnitType, 0)
    for unit in read_units(data):
        sizes[unit.kind] += unit.size
    return sizes[UnitType.GEOMETRY], sizes[UnitType.ATTRIBUTE]


def bd_rate(rates: np.ndarray, quality: np.ndarray, other_rates: np.ndarray, other_quality: np.ndarray) -> float:
    """By how many per cent the first curve's rate is above the other's at equal quality, on average over the quality
    that both reach (G. Bjontegaard, VCEG-M33, 2001)."""
    low, high = max(quality.min(), other_quality.min()), min(quality.max(), other_quality.max())
    areas = []
    for curve, rate in ((quality, rates), (other_quality, other_rates)):
        primitive = np.polyint(np.polyfit(curve, np.log(rate), 3))
        areas.append(np.polyval(primitive, high) - np.polyval(primitive, low))
    return float(100 * (np.exp((areas[0] - areas[1]) / (high - low)) - 1))
