# SPDX-License-Identifier: Apache-2.0
"""Voxels of edges and planes, each with the mean and scatter of what was measured in it.

The table has a fixed number of slots, and a voxel's coordinates alone say which slot is its; of two voxels with the
same slot the newer one stays. Looking up and adding therefore cost the same however much was seen, memory is allocated
once, and everything is vectorised: no loop over points or voxels. Planes and edges share the table (a bit of the key
tells them apart), so that one look-up serves both: on a processor the number of operations counts, not their size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from ggslam.errors import FormatError
from ggslam.system.savable import savable
from ggslam.tracking.edges_planes.settings import FeatureMapSettings

_OFFSET: Final = 1 << 19
"""Added to voxel coordinates to make them positive. A key has 20 bits per axis."""
_SHIFTS: Final = (40, 20, 0)
"""Position of each coordinate in a key."""
_EDGE_BIT: Final = 1 << 60
"""Bit of a key that tells voxels of edges from voxels of planes."""
_EMPTY: Final = -1
"""Key of an empty slot."""
_MULTIPLIER: Final = -7046029254386353131
"""2^64 over the golden ratio, as a signed number (Fibonacci hashing: D. Knuth, The Art of Computer Programming,
6.4)."""


@dataclass(frozen=True)
class VoxelMatches:
    """Matches of points. Where a point has no match, its other values mean nothing.

    Attributes:
        found: bool [n].
        slots: int64 [n], the voxel's place in the table.
        surfaces: float32 [n, 8]: mean [3], axis [3] (unit: normal of a plane, direction of an edge), variance (of the
            plane along its normal, of the edge across it, square metres), number of patches.
    """

    found: Tensor
    slots: Tensor
    surfaces: Tensor


@savable(not_saved="settings _shift _mask _corners _ones _isotropic", check="check")
class FeatureMap:
    """Planes and edges gathered in voxels.

    Points come in one array, planes first: `planes` says how many.

    Args:
        settings: see `FeatureMapSettings`.
        device: where the table lives.
    """

    def __init__(self, settings: FeatureMapSettings, device: torch.device | str = "cpu") -> None:
        self.settings = settings
        self._shift, self._mask = 64 - int(math.log2(settings.slots)), settings.slots - 1
        n = settings.slots
        self._keys = torch.full((n,), _EMPTY, dtype=torch.int64, device=device)
        self._weight = torch.zeros(n, device=device)
        self._surface = torch.zeros(n, 8, device=device)  # variance 0: neither plane nor edge yet
        self._scatter = torch.zeros(n, 6, device=device)
        corners = [(i << _SHIFTS[0]) + (j << _SHIFTS[1]) + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        self._corners = torch.tensor(corners, device=device)
        self._ones = torch.ones(3, device=device)
        self._isotropic = torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], device=device)

    def check(self) -> None:
        """Raises FormatError if the table has not its number of slots: it may come from a file."""
        tables = (self._keys, self._weight, self._surface, self._scatter)
        if any(len(table) != self.settings.slots for table in tables):
            raise FormatError(f"map of features: expected {self.settings.slots} slots")

    def __len__(self) -> int:
        """Voxels held, counting those that are neither plane nor edge yet."""
        return int((self._keys != _EMPTY).sum())

    def clear(self) -> None:
        """Forgets everything."""
        self._keys.fill_(_EMPTY)

    def surfaces(self, edges: bool) -> Tensor:
        """Mean, axis, variance and number of patches [k, 8] of the voxels that are planes, or edges."""
        kind = (self._keys & _EDGE_BIT) > 0 if edges else (self._keys & _EDGE_BIT) == 0
        return self._surface[(self._surface[:, 6] > 0) & kind & (self._keys != _EMPTY)]

    # --- looking up --------------------------------------------------------------------------------------------------

    def match(self, points: Tensor, planes: int, normals: Tensor) -> VoxelMatches:
        """For each point the nearest voxel mean among the eight voxels about it.

        Args:
            points: float32 [n, 3], metres.
            planes: the first so many points are on planes, the others on edges.
            normals: float32 [n, 3]; a plane's must agree with the voxel's. Zero: unknown, agrees with all.
        """
        scale, keys = self._keys_of(points, planes, shift=0.5)
        around = keys[:, None] + self._corners
        slots = self._slots(around)
        # index_select and take are several times as fast as indexing with brackets
        rows = self._surface.index_select(0, slots.view(-1)).view(-1, 8, 8)
        squared = (rows[..., :3] - points[:, None, :]).square_() @ self._ones
        dot = torch.bmm(rows, torch.nn.functional.pad(normals, (3, 2))[:, :, None])[..., 0]
        limit = torch.where(normals.any(1), self.settings.min_normal_dot, -math.inf)
        good = (torch.take(self._keys, slots) == around) & (rows[..., 6] > 0) & (dot >= limit[:, None])
        nearest, which = squared.masked_fill_(~good, math.inf).min(1, keepdim=True)
        slot = slots.gather(1, which)[:, 0]
        reach = self.settings.match_voxels / scale[:, 0]
        return VoxelMatches(nearest[:, 0] < reach * reach, slot, self._surface.index_select(0, slot))

    def _scale(self, n: int, planes: int) -> Tensor:
        """Voxels per metre of each point, [n, 1]."""
        scale = torch.full((n, 1), 1.0 / self.settings.edge_voxel, device=self._weight.device)
        scale[:planes] = 1.0 / self.settings.plane_voxel
        return scale

    def _keys_of(self, points: Tensor, planes: int, shift: float) -> tuple[Tensor, Tensor]:
        """Voxels per metre [n, 1], and keys [n] of the voxels that hold the points moved by `shift` voxels down."""
        scale = self._scale(len(points), planes)
        i, j, k = torch.floor(points * scale + (_OFFSET - shift)).to(torch.int64).unbind(1)
        keys = (i << _SHIFTS[0]) + (j << _SHIFTS[1]) + k
        keys[planes:] += _EDGE_BIT
        return scale, keys

    def _slots(self, keys: Tensor) -> Tensor:
        return ((keys * _MULTIPLIER) >> self._shift) & self._mask

    # --- adding ------------------------------------------------------------------------------------------------------

    def add(self, points: Tensor, planes: int, normals: Tensor, discs: Tensor) -> None:
        """Adds measurements.

        Args:
            points: float32 [n, 3], metres.
            planes: the first so many points are on planes, the others on edges.
            normals: float32 [n, 3], unit, or zero where unknown.
            discs: float32 [n], standard deviation of a measured patch along the surface; 0: a point.
        """
        if not len(points):
            return
        _, keys = self._keys_of(points, planes, shift=0.0)
        unique, groups = torch.unique(keys, return_inverse=True)
        slots = self._slots(unique)
        # Of new voxels with the same slot the last one stays.
        numbers = torch.arange(len(slots), device=slots.device)
        owner = torch.full_like(numbers, -1)
        ranks = torch.unique(slots, return_inverse=True)[1]
        winner = (owner.scatter_reduce_(0, ranks, numbers, "amax")[ranks] == numbers).nonzero()[:, 0]
        moments, centres = self._moments(points, normals, discs, groups, unique)
        slots, unique, moments, centres = (a.index_select(0, winner) for a in (slots, unique, moments, centres))
        new = torch.take(self._keys, slots) != unique
        self._keys[slots] = unique
        self._merge(slots, new, centres, moments, (unique & _EDGE_BIT) > 0)

    def _centres(self, keys: Tensor) -> Tensor:
        """Of voxels [m], metres, [m, 3]."""
        cells = torch.stack([(keys >> shift) & ((1 << 20) - 1) for shift in _SHIFTS], 1) - _OFFSET
        voxel = torch.where((keys & _EDGE_BIT) > 0, self.settings.edge_voxel, self.settings.plane_voxel)
        return (cells + 0.5) * voxel[:, None]

    def _moments(
        self, points: Tensor, normals: Tensor, discs: Tensor, groups: Tensor, keys: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Per voxel: weight, mean [3] from the voxel's centre, scatter [6] about the mean, sum of normals [3], number
        of patches, [m, 14]; and the centres [m, 3]."""
        centres = self._centres(keys)
        x = points - centres.index_select(0, groups)
        spread = discs[:, None]
        products = _products(x) + spread.square() * (self._isotropic - _products(normals))
        rows = torch.cat([torch.ones_like(spread), x, products, normals, (spread > 0).to(x.dtype)], 1)
        sums = torch.zeros(len(keys), 14, device=points.device).index_add_(0, groups, rows)
        mean = sums[:, 1:4] / sums[:, :1]
        scatter = sums[:, 4:10] - sums[:, :1] * _products(mean)
        return torch.cat([sums[:, :1], mean, scatter, sums[:, 10:]], 1), centres

    def _merge(self, slots: Tensor, new: Tensor, centres: Tensor, moments: Tensor, is_edge: Tensor) -> None:
        """Joins the moments of a batch with those in the table (T. Chan, G. Golub and R. LeVeque, 1979), and renews
        the surfaces."""
        old_weight = torch.take(self._weight, slots).masked_fill_(new, 0.0)
        old = self._surface.index_select(0, slots).masked_fill_(new[:, None], 0.0)
        weight = old_weight + moments[:, 0]
        old_mean = torch.where(new[:, None], moments[:, 1:4], old[:, :3] - centres)
        step = moments[:, 1:4] - old_mean
        share = (moments[:, 0] / weight)[:, None]
        scatter = self._scatter.index_select(0, slots).masked_fill_(new[:, None], 0.0) + moments[:, 4:10]
        scatter += old_weight[:, None] * share * _products(step)
        patches = old[:, 7] + moments[:, 13]
        axes, variance = self._shape(scatter / weight[:, None], weight, patches, is_edge)
        towards = torch.where(moments[:, 13:] > 0, moments[:, 10:13], old[:, 3:6])
        axes = torch.where((axes * towards).sum(1, keepdim=True) < 0, -axes, axes)
        mean = old_mean + share * step + centres
        self._surface[slots] = torch.cat([mean, axes, variance[:, None], patches[:, None]], 1)
        shrink = (self.settings.max_weight / weight).clamp_(max=1.0)
        self._weight[slots] = weight * shrink
        self._scatter[slots] = scatter * shrink[:, None]

    def _shape(self, covariance: Tensor, weight: Tensor, patches: Tensor, is_edge: Tensor) -> tuple[Tensor, Tensor]:
        """Axes [m, 3] and variances [m] of voxels; variance 0 where a voxel is neither plane nor edge."""
        s = self.settings
        values, axes = principal_axis(covariance, is_edge)
        smallest, middle, largest = values.unbind(1)
        plane = (middle > s.plane_ratio * smallest) & ((weight >= s.min_plane_points) | (patches > 0))
        edge = (largest > s.edge_ratio * middle) & (weight >= s.min_edge_points)
        variance = torch.where(is_edge, middle, smallest).clamp_(min=1e-9)
        return axes, torch.where(torch.where(is_edge, edge, plane), variance, 0.0)


def _products(v: Tensor) -> Tensor:
    """xx xy xz yy yz zz of vectors [n, 3], [n, 6]."""
    return torch.cat([v[:, :1] * v, v[:, 1:2] * v[:, 1:], v[:, 2:].square()], 1)


def principal_axis(covariance: Tensor, largest: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues [n, 3], ascending, and the unit eigenvector [n, 3] of the smallest or, where `largest` [n] is true,
    the largest, of symmetric 3 x 3 matrices given as xx xy xz yy yz zz [n, 6].

    In closed form (O. Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961), in double precision: batched
    library solvers take microseconds per matrix. The eigenvector is arbitrary where two eigenvalues are equal.
    """
    xx, xy, xz, yy, yz, zz = covariance.double().unbind(1)
    full = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).view(-1, 3, 3)
    identity = torch.eye(3, dtype=full.dtype, device=full.device)
    mean = full.diagonal(dim1=1, dim2=2).mean(1)
    deviator = full - mean[:, None, None] * identity
    p = (deviator.square().sum((1, 2)) / 6).sqrt_().clamp_(min=1e-30)
    a, b, c = (deviator / p[:, None, None]).unbind(1)
    angle = ((a * torch.linalg.cross(b, c)).sum(1) / 2).clamp_(-1, 1).acos_() / 3
    high = mean + 2 * p * angle.cos()
    low = mean + 2 * p * (angle + 2 * math.pi / 3).cos()
    values = torch.stack([low, 3 * mean - high - low, high], 1).clamp_(min=0)
    rows = full - torch.where(largest, high, low)[:, None, None] * identity
    # The rows span what is at right angles to the eigenvector; the longest of their cross products is the most exact.
    crosses = torch.linalg.cross(rows, rows.roll(1, 1))
    lengths, best = crosses.square().sum(2).max(1)
    axis = crosses.gather(1, best[:, None, None].expand(-1, 1, 3))[:, 0]
    known = (lengths > 1e-60)[:, None]
    return values.float(), torch.where(known, axis / lengths.clamp(min=1e-60).sqrt()[:, None], identity[2]).float()
