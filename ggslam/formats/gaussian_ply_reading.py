# SPDX-License-Identifier: Apache-2.0
"""PLY files of Gaussians that other programs wrote, a block of rows at a time.

The layout is that of 3DGS (see `gaussian_ply`) with what others leave out or add: no `f_dc_*` but `red green blue`, no
`scale_2` (2D Gaussians, which are flat), harmonics of a degree above 3 (left out), and `filter_3D`: the size in metres
of Mip-Splatting's smoothing, which belongs to the Gaussian (Yu et al., "Mip-Splatting: Alias-free 3D Gaussian
Splatting", 2024, equation 9): with variances s^2 + f^2 it is larger, and its opacity less by the root of the ratio of
the determinants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.formats.gaussian_ply import object_ids
from ggslam.formats.gaussian_rows import GaussianRows, GaussianRowsTuning
from ggslam.formats.positions import PositionTuning, coordinate_step
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_reader import SplatFile, SplatReader, properties_of_ply
from ggslam.formats.splat_repair import RepairTuning, SplatFaults, columns_of, logits_of, map_of_columns, mend
from ggslam.scene.gaussian_map import SH_C0, GaussianMap

_BYTES = ("red", "green", "blue")
_BASE = ("f_dc_0", "f_dc_1", "f_dc_2")
_NEEDED = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_FILTER = "filter_3D"
_COEFFICIENTS = {0: 0, 3: 1, 8: 2, 15: 3}
_PASSED_OVER = {"nx", "ny", "nz", *_BYTES, "alpha"}


@dataclass(frozen=True)
class SplatLayout:
    """Which properties of a file say what.

    Attributes:
        base: of the base colour; empty: there is none, and Gaussians are grey.
        rest: of the higher harmonics, those of a channel after those of another.
        channel: how many of `rest` a channel has; up to 15 of them are read.
        scales: two or three.
        identities: `identity_*` of ggslam.
        has_filter, has_ids: whether there is `filter_3D`, `object_id`.
        left_out: names of properties that are not read.
    """

    base: tuple[str, ...]
    rest: tuple[str, ...]
    channel: int
    scales: tuple[str, ...]
    identities: tuple[str, ...]
    has_filter: bool
    has_ids: bool
    left_out: tuple[str, ...]

    @staticmethod
    def of(path: Path, vertex: np.ndarray | None) -> SplatLayout:
        """That of a file's element `vertex`, of which no row is needed; raises FormatError if it has no Gaussians."""
        dtype = np.dtype([]) if vertex is None else vertex.dtype
        names = dtype.names or ()
        missing = [name for name in _NEEDED if name not in names]
        if missing:
            raise FormatError(f"{path} holds no Gaussians: the properties {missing} of 'vertex' are missing")
        base = next((group for group in (_BASE, _BYTES) if set(group) <= set(names)), ())
        rest, identities = _in_order(path, names, "f_rest_"), _in_order(path, names, "identity_")
        if len(rest) % 3:
            raise FormatError(f"{path}: {len(rest)} properties f_rest_*, expected as many for each of three colours")
        scales = ("scale_0", "scale_1", "scale_2")[: 3 if "scale_2" in names else 2]
        read = {*_NEEDED, *base, *rest, *scales, *identities, _FILTER, "object_id"}
        left_out = tuple(name for name in names if name not in read | _PASSED_OVER)
        for name in [name for name in names if name in read]:
            if dtype[name].kind not in "fiu":
                raise FormatError(f"{path}: property '{name}' is {dtype[name]}, expected a number")
        return SplatLayout(
            base, rest, len(rest) // 3, scales, identities, _FILTER in names, "object_id" in names, left_out
        )

    @property
    def coefficients(self) -> int:
        """Higher harmonics of a channel that are read: of whole degrees up to 3."""
        return max(count for count in _COEFFICIENTS if count <= self.channel)

    def notes(self) -> list[str]:
        """What the user should know of it."""
        out = []
        if len(self.scales) == 2:
            out.append("2D Gaussians (no scale_2): read as discs, a thousandth of their width thick")
        if self.has_filter:
            out.append("filter_3D of Mip-Splatting is applied to sizes and opacities")
        if not self.base:
            out.append("no colours (f_dc_*, or red green blue): shown in grey")
        if self.coefficients < self.channel:
            out.append(f"{3 * (self.channel - self.coefficients)} of {3 * self.channel} colour coefficients f_rest_* "
                       "are left out: of an unfinished degree, or one above 3")  # fmt: skip
        if self.left_out:
            some = self.left_out if len(self.left_out) < 6 else (*self.left_out[:2], "...", self.left_out[-1])
            out.append(f"left out {len(self.left_out)} properties that are not of 3DGS: {', '.join(some)}")
        return out

    def columns(self, path: Path, vertex: np.ndarray, first: int) -> SplatColumns:
        """What some rows say, of which the first has the number `first` in the file."""
        sizes = _stack(vertex, self.scales)
        if len(self.scales) == 2:
            sizes = np.column_stack([sizes, sizes.max(1) - RepairTuning.thinner])
        logits = vertex["opacity"].astype(np.float32)
        if self.has_filter:
            sizes, logits = apply_filter(sizes, logits, vertex[_FILTER].astype(np.float64))
        sh = np.zeros((len(vertex), 1 + self.coefficients, 3), np.float32)
        sh[:, 0] = self._base_colors(vertex)
        for channel in range(3):
            start = channel * self.channel
            sh[:, 1:, channel] = _stack(vertex, self.rest[start : start + self.coefficients])
        ids = object_ids(path, vertex, first) if self.has_ids else None
        quaternions = _stack(vertex, ("rot_0", "rot_1", "rot_2", "rot_3"))
        _refuse_far(path, vertex)
        return columns_of(_stack(vertex, ("x", "y", "z")), sizes, quaternions, logits, sh, ids)

    def _base_colors(self, vertex: np.ndarray) -> np.ndarray:
        if not self.base:
            return np.zeros((len(vertex), 3), np.float32)
        values = _stack(vertex, self.base)
        if self.base == _BASE:
            return values
        whole = vertex.dtype["red"].kind in "iu"
        return ((values / 255 if whole else values) - 0.5) / np.float32(SH_C0)

    def features(self, vertex: np.ndarray) -> np.ndarray | None:
        """float32 [N, F]: identity vectors of ggslam; numbers that are none become 0."""
        return np.nan_to_num(_stack(vertex, self.identities), posinf=0, neginf=0) if self.identities else None


def apply_filter(
    log_scales: np.ndarray, logits: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians convolved with a round one that takes nothing from or adds to their mass.

    Args:
        log_scales: [N, 3], of standard deviations in metres.
        logits: [N], of opacities.
        size: float64 [N], standard deviation of the filter in metres; NaN and infinite: none.

    Returns:
        Logarithms of sizes sqrt(s^2 + f^2), and logits of opacities times sqrt(det S / det(S + f^2 I)), float32.
    """
    f2 = np.where(np.isfinite(size), np.square(size), 0.0)[:, None]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        variances = np.exp(2 * log_scales.astype(np.float64))
        wider = variances + f2
        share = np.sqrt(np.prod(np.where(wider > 0, variances / wider, 1.0), axis=1))
        opacity = 0.5 + 0.5 * np.tanh(0.5 * logits.astype(np.float64))
        changed = f2[:, 0] > 0
        return (
            np.where(changed[:, None], 0.5 * np.log(wider), log_scales).astype(np.float32),
            np.where(changed & ~np.isnan(logits), logits_of(np.nan_to_num(opacity * share)), logits).astype(np.float32),
        )


class PlyGaussianRows(GaussianRows):
    """The Gaussians of others' PLY files by row, without those that cannot be drawn; what is not read from the file
    again is one number for each of these.

    Args:
        path: the file.

    Raises:
        FormatError: no PLY file, or no Gaussians in it.
    """

    def __init__(self, path: str | Path) -> None:
        self._open(Path(path))
        self._layout = SplatLayout.of(self.path, self._raw(0, 0))
        self._faults, bad = SplatFaults(), [np.empty(0, np.int64)]
        for start in range(0, self._row_count(), GaussianRowsTuning.rows_at_once):
            columns = self._columns(start, min(GaussianRowsTuning.rows_at_once, self._row_count() - start))
            bad.append(start + np.flatnonzero(~mend(columns, self._faults)))
        self._bad = np.concatenate(bad)
        self.like = self._map(0, 0)

    def __len__(self) -> int:
        return self._row_count() - len(self._bad)

    def read(self, start: int, count: int) -> GaussianMap:
        """The Gaussians of rows start to start + count, without optimizer state.

        Raises:
            FormatError: the file cannot be read any more.
        """
        if count <= GaussianRowsTuning.rows_at_once:
            begin = self._row_in_file(start) if count else 0
            return self._map(begin, self._row_in_file(start + count - 1) + 1 - begin if count else 0)
        like = self.like
        out = GaussianMap(like.sh_degree, like.feature_channels, with_moments=False)
        out.growth = 0.0
        out.reserve(count)
        step = GaussianRowsTuning.rows_at_once  # so that columns of all are not in memory beside the map
        for first in range(start, start + count, step):
            part = self.read(first, min(step, start + count - first))
            out.append(part.take(torch.arange(len(part))))
        return out

    @property
    def has_ids(self) -> bool:
        """Whether the file has object ids."""
        return self._layout.has_ids

    def notes(self) -> list[str]:
        """What the user should know: what was left out, bounded or changed."""
        return [*self._layout.notes(), *self._faults.notes()]

    def _row_in_file(self, number: int) -> int:
        """Where the Gaussian of a number is, those left out counted as well."""
        before = self._bad - np.arange(len(self._bad))  # for each bad row, the good ones before it
        return number + int(np.searchsorted(before, number, "right"))

    def _columns(self, start: int, count: int) -> SplatColumns:
        vertex = self._raw(start, count)
        assert vertex is not None
        return self._layout.columns(self.path, vertex, start)

    def _map(self, start: int, count: int) -> GaussianMap:
        vertex = self._raw(start, count)
        assert vertex is not None
        columns = self._layout.columns(self.path, vertex, start)
        keep = np.flatnonzero(mend(columns, SplatFaults()))
        features = self._layout.features(vertex)
        return map_of_columns(columns.take(keep), None if features is None else features[keep])


def _in_order(path: Path, names: Sequence[str], prefix: str) -> tuple[str, ...]:
    """The properties prefix0, prefix1, ... in numerical order; raises FormatError if one is missing between."""
    found = [name for name in names if name.startswith(prefix)]
    expected = tuple(f"{prefix}{i}" for i in range(len(found)))
    if set(found) != set(expected):
        raise FormatError(f"{path}: the properties {prefix}* are not numbered 0 to {len(found) - 1}: {sorted(found)}")
    return expected


def _refuse_far(path: Path, vertex: np.ndarray) -> None:
    """Raises FormatError if Gaussians, which are in single precision, could not be where a file has them in double."""
    doubles = [vertex[axis] for axis in "xyz" if vertex.dtype[axis] == np.float64]
    if not doubles or not len(vertex):
        return
    typical = float(np.nanmax(np.median(np.abs(doubles), axis=1)))  # some may be anywhere
    step = coordinate_step(typical)
    if step > PositionTuning.coarse_m:
        raise FormatError(
            f"{path}: its Gaussians lie {typical:.0f} m from zero, in double precision; maps are in single precision, "
            f"with steps of {step:.3g} m there: subtract an offset first"
        )


def _stack(vertex: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """float32 [N, len(names)]."""
    out = np.empty((len(vertex), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for column, name in enumerate(names):
            out[:, column] = vertex[name]
    return out


def _open(path: Path) -> SplatFile:
    rows = PlyGaussianRows(path)
    return SplatFile("3DGS PLY", rows, {} if rows.has_ids else None, rows.notes())


READER = SplatReader(
    "3DGS PLY", lambda path, head: {"scale_0", "scale_1", "rot_0", "opacity"} <= properties_of_ply(path, head), _open
)
