# SPDX-License-Identifier: Apache-2.0
"""Repairs Gaussians of other programs' files: bad ones are left out or bounded, and counted."""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch

from ggslam.formats.splat_columns import SplatColumns
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class RepairTuning(Tuning):
    """What damaged numbers are replaced with."""

    max_logit = 13.8
    """Logit of an opacity of 0.999999; infinite logits become this or its negative."""
    thinner = np.float32(np.log(1000.0))
    """Logarithm of how many times thinner than wide a flat Gaussian becomes."""
    min_log_scale = np.float32(-20.0)
    """Smallest log scale of a flat Gaussian."""
    min_norm = 1e-6
    """Smallest norm of a quaternion that has a direction."""


_POSITION, _SIZE, _TURN = "position is no number", "size is infinite or zero", "quaternion is zero or no number"
_OPACITY, _COLOR = "opacity is no number", "colour is no number"
_FLAT, _ENDLESS = "thickness of zero, now a thousandth of the width", "infinite logit of opacity, now +-13.8"
_STRANGE = "colour coefficients that were not finite set to 0"


class SplatFaults:
    """Counts the Gaussians of a file that are left out or bounded, over all parts that are looked at."""

    def __init__(self) -> None:
        self.seen = 0
        self.left_out, self.bounded = Counter[str](), Counter[str]()

    def notes(self) -> list[str]:
        """What the user should know, a line for each kind."""
        kinds = ((self.left_out, "left out"), (self.bounded, "changed"))
        return [f"{count} of {self.seen} Gaussians {done}: {what}" for counter, done in kinds
                for what, count in counter.items()]  # fmt: skip


def mend(columns: SplatColumns, faults: SplatFaults) -> np.ndarray:
    """Bounds what can be bounded, in place, and finds what cannot be drawn.

    A size of zero along one or two axes makes a Gaussian flat: it becomes a thousand times thinner than it is wide.
    Infinite logits become finite. Higher colour coefficients that are no numbers become 0.

    Args:
        columns: as a file has them; quaternions of any length.
        faults: counts what was found.

    Returns:
        bool [N]: those to keep.
    """
    with np.errstate(invalid="ignore"):
        norms = np.linalg.norm(columns.quaternions.astype(np.float64), axis=1)
    log_scales = columns.log_scales
    flat = np.isneginf(log_scales).any(1) & np.isfinite(log_scales).any(1) & ~np.isposinf(log_scales).any(1)
    flat &= ~np.isnan(log_scales).any(1)
    reasons = {
        _POSITION: ~np.isfinite(columns.means).all(1), _SIZE: ~np.isfinite(log_scales).all(1) & ~flat,
        _TURN: ~(np.isfinite(norms) & (norms > RepairTuning.min_norm)), _OPACITY: np.isnan(columns.logits),
        _COLOR: ~np.isfinite(columns.sh[:, 0]).all(1),
    }  # fmt: skip
    keep = np.ones(len(columns), bool)
    for name, bad in reasons.items():
        _count(faults.left_out, name, bad & keep)
        keep &= ~bad
    faults.seen += len(columns)
    _flatten(columns, flat & keep, faults)
    endless = np.isinf(columns.logits)
    _count(faults.bounded, _ENDLESS, endless & keep)
    columns.logits[endless] = np.sign(columns.logits[endless]) * RepairTuning.max_logit
    strange = ~np.isfinite(columns.sh).all((1, 2))
    _count(faults.bounded, _STRANGE, strange & keep)
    columns.sh[~np.isfinite(columns.sh)] = 0
    return keep


def _flatten(columns: SplatColumns, flat: np.ndarray, faults: SplatFaults) -> None:
    _count(faults.bounded, _FLAT, flat)
    sizes = columns.log_scales[flat]
    widest = np.where(np.isneginf(sizes), -np.inf, sizes).max(1, initial=-np.inf)
    columns.log_scales[flat] = np.maximum(
        sizes, np.maximum(widest - RepairTuning.thinner, RepairTuning.min_log_scale)[:, None]
    )


def _count(counter: Counter[str], name: str, rows: np.ndarray) -> None:
    if rows.any():
        counter[name] += int(rows.sum())


def map_of_columns(columns: SplatColumns, features: np.ndarray | None = None) -> GaussianMap:
    """The map of columns that `mend` found nothing wrong with, on the CPU, without optimizer state.

    Args:
        columns: of N Gaussians; quaternions of any length.
        features: float32 [N, F]; None: there are none.
    """
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[columns.sh.shape[1]]
    out = GaussianMap(degree, 0 if features is None else features.shape[1], with_moments=False)
    growth, out.growth = out.growth, 0.0
    unit = columns.quaternions.astype(np.float64)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), RepairTuning.min_norm)
    as_tensor = torch.from_numpy
    out.insert(
        as_tensor(np.ascontiguousarray(columns.means)), as_tensor(unit.astype(np.float32)),
        as_tensor(np.ascontiguousarray(columns.log_scales)), as_tensor(np.ascontiguousarray(columns.logits)),
        torch.zeros(len(columns), 3), None if features is None else as_tensor(np.ascontiguousarray(features)),
        object_id=as_tensor(np.ascontiguousarray(columns.object_id)),
    )  # fmt: skip
    out.sh[:] = as_tensor(np.ascontiguousarray(columns.sh))
    out.growth = growth
    return out


def logits_of(opacities: np.ndarray) -> np.ndarray:
    """Logits float32 of opacities; of 0 and less, and of 1 and more, those of `RepairTuning.max_logit`; NaN of NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.clip(np.asarray(opacities, np.float64), 0.0, 1.0)
        logits = np.log(values) - np.log1p(-values)
    return np.clip(logits, -RepairTuning.max_logit, RepairTuning.max_logit).astype(np.float32)


def logarithms_of(sizes: np.ndarray) -> np.ndarray:
    """Logarithms float32 of standard deviations; -inf of zero, which `mend` knows; NaN of negative ones."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(np.asarray(sizes, np.float64)).astype(np.float32)


def columns_of(
    means: np.ndarray, log_scales: np.ndarray, quaternions: np.ndarray, logits: np.ndarray, sh: np.ndarray,
    object_id: np.ndarray | None = None,
) -> SplatColumns:  # fmt: skip
    """Columns of N Gaussians of numbers of any type, writable; 0 of N ids where there are none."""
    with np.errstate(over="ignore", invalid="ignore"):  # ids that are no numbers are some number, and harm nothing
        ids = np.zeros(len(means), np.int32) if object_id is None else np.asarray(object_id).astype(np.int32)
        return SplatColumns(
            np.array(means, np.float32), np.array(log_scales, np.float32), np.array(quaternions, np.float32),
            np.array(logits, np.float32), np.array(sh, np.float32), ids,
        )  # fmt: skip
