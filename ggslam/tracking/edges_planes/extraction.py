# SPDX-License-Identifier: Apache-2.0
"""Edges and planes on scan lines: rows and columns of a depth image, or rings of a LiDAR.

Curvature over ten neighbours and selection per segment follow LOAM (J. Zhang and S. Singh, "LOAM: Lidar Odometry and
Mapping in Real-time", RSS 2014) and SSL-SLAM (H. Wang, C. Wang and L. Xie, "Lightweight 3-D Localization and Mapping
for Solid-State LiDAR", RA-L 2021). Here curvature is measured in standard deviations of the depth noise, so that one
limit serves near and far points and all sensors.

All arrays are torch tensors of one device; those of an image's size live in buffers that are allocated once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Protocol

import torch
from torch import Tensor

from ggslam.tracking.edges_planes.settings import ExtractionSettings

HALF: Final = 5
"""Neighbours on either side, as in LOAM."""
WINDOW = 2 * HALF + 1
_NOISE_GAIN = float(2 * HALF + (2 * HALF) ** 2)
"""Variance of the sum of 10 neighbours minus 10 times the point, in variances of a point."""


class Scan(Protocol):
    """What a tracker asks of the features of one scan, wherever they are."""

    @property
    def plane_count(self) -> int:
        """Number of planes."""

    @property
    def edge_count(self) -> int:
        """Number of edges."""

    @property
    def median_depth(self) -> float:
        """Of the planes, along the third axis (a camera's depth), metres; 0 without planes."""

    @property
    def median_distance(self) -> float:
        """Of the planes from the sensor, metres; 0 without planes."""


@dataclass(frozen=True)
class ScanFeatures:
    """Edges and planes of one scan, in the sensor's frame.

    Attributes:
        planes: float32 [P, 3], metres.
        normals: float32 [P, 3], unit, towards the sensor; zero where no patch was fitted.
        discs: float32 [P], standard deviation of the fitted patch along the surface, metres; 0 without.
        plane_sigmas: float32 [P], standard deviation of the distance measurement, metres.
        edges: float32 [E, 3].
        edge_sigmas: float32 [E].
    """

    planes: Tensor
    normals: Tensor
    discs: Tensor
    plane_sigmas: Tensor
    edges: Tensor
    edge_sigmas: Tensor

    def __len__(self) -> int:
        return len(self.planes) + len(self.edges)

    @property
    def plane_count(self) -> int:
        """See `Scan`."""
        return len(self.planes)

    @property
    def edge_count(self) -> int:
        """See `Scan`."""
        return len(self.edges)

    def to(self, device: torch.device | str) -> ScanFeatures:
        """The same on another device."""
        return ScanFeatures(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))

    @cached_property
    def points(self) -> Tensor:
        """Planes, then edges, float32 [P + E, 3]."""
        return torch.cat([self.planes, self.edges])

    @cached_property
    def all_sigmas(self) -> Tensor:
        """Of `points`, float32 [P + E]."""
        return torch.cat([self.plane_sigmas, self.edge_sigmas])

    @cached_property
    def all_normals(self) -> Tensor:
        """Of `points`, float32 [P + E, 3]; zero for edges."""
        return torch.cat([self.normals, torch.zeros_like(self.edges)])

    def thin(self, planes: int, edges: int) -> ScanFeatures:
        """At most so many of each kind, evenly taken from the order they are in."""
        if len(self.planes) <= planes and len(self.edges) <= edges:
            return self
        p, e = _evenly(self.planes, planes), _evenly(self.edges, edges)
        return ScanFeatures(
            self.planes[p], self.normals[p], self.discs[p], self.plane_sigmas[p], self.edges[e], self.edge_sigmas[e]
        )

    @cached_property
    def median_depth(self) -> float:
        """See `Scan`."""
        return float(self.planes[:, 2].median()) if len(self.planes) else 0.0

    @cached_property
    def median_distance(self) -> float:
        """See `Scan`."""
        return float(self.planes.square().sum(1).median().sqrt()) if len(self.planes) else 0.0


def _evenly(items: Tensor, count: int) -> Tensor:
    """Indices of at most `count` rows at even distances."""
    count = min(count, len(items))
    return torch.arange(count, device=items.device) * len(items) // max(count, 1)


@dataclass(frozen=True)
class ScanLines:
    """Points in the order in which a sensor saw them.

    Attributes:
        points: float32 [3, L, C], metres, of L lines with C points each.
        distances: float32 [L, C], metres: range (LiDAR) or depth (camera); 0 where nothing was measured.
        sigmas: float32 [L, C], standard deviation of `distances`, metres.
        plane_lines: planes are looked for on the first so many lines.
    """

    points: Tensor
    distances: Tensor
    sigmas: Tensor
    plane_lines: int


def dither(lines: int, places: int) -> Tensor:
    """What decides among planes that are as flat as can be seen, float32 [lines, places] from 0.5 to 1."""
    return 0.5 + 0.5 * torch.rand(lines, places, generator=torch.Generator().manual_seed(0))


class LineScanner:
    """Chooses edges and planes on the lines of scans of one size.

    Args:
        lines, columns: L and C of the scans.
        settings: limits.
        device: where the work is done.
    """

    def __init__(
        self, lines: int, columns: int, settings: ExtractionSettings, device: torch.device | str = "cpu"
    ) -> None:
        if columns < WINDOW:
            raise ValueError(f"lines of {columns} points, at least {WINDOW} needed")
        self.settings = settings
        self._shape = (lines, columns)
        self._inner = columns - 2 * HALF  # points with all neighbours
        self._segment = math.ceil(self._inner / settings.segments)
        padded = self._segment * settings.segments

        def buffer(*shape: int) -> Tensor:
            return torch.zeros(shape, device=device)

        self._before, self._after = buffer(3, lines, self._inner), buffer(3, lines, self._inner)
        self._difference = buffer(3, lines, self._inner)
        self._curvature, self._variance = buffer(lines, self._inner), buffer(lines, self._inner)
        self._step, self._limit = buffer(lines, columns - 1), buffer(lines, columns - 1)
        self._gaps = buffer(lines, columns - 1)
        self._scores = buffer(lines, padded)
        self._dither = dither(lines, self._inner).to(device)
        positions = torch.arange(lines, device=device)[:, None] * columns + torch.arange(padded, device=device) + HALF
        self._positions = positions.view(lines, settings.segments, self._segment)

    def scan(self, lines: ScanLines) -> tuple[Tensor, Tensor]:
        """Chooses features.

        Returns:
            Edges int64 [E] and planes [P], as positions line * C + column.

        Raises:
            ValueError: another size than this scanner's.
        """
        if tuple(lines.distances.shape) != self._shape:
            raise ValueError(f"lines are {tuple(lines.distances.shape)}, expected {self._shape}")
        s = self.settings
        continuous, near_border = self._surroundings(lines)
        curvature = self.curvature(lines)
        edges = (curvature > s.edge_sigmas**2) & (continuous | near_border if s.occluding_edges else continuous)
        at_edges = self._pick(edges, curvature, s.edges_per_segment)
        n = lines.plane_lines
        planes = continuous[:n] & (curvature[:n] < s.plane_sigmas**2)
        # Among points that are flat as far as noise lets one see, chance decides: the least would line up in columns.
        flatness = self._dither[:n] / curvature[:n].clamp(min=1.0)
        return self._find_turns(at_edges), self._pick(planes, flatness, s.planes_per_segment)

    def curvature(self, lines: ScanLines) -> Tensor:
        """c_j = |sum_{k=-5..5, k != 0} p_{j+k} - 10 p_j|^2 (equation 1) over what noise makes of it on a straight
        line, [L, C - 10]; a buffer that the next call overwrites."""
        n, before, after, points = self._inner, self._before, self._after, lines.points
        torch.add(points[..., :n], points[..., 1 : 1 + n], out=before)
        torch.add(points[..., HALF + 1 : HALF + 1 + n], points[..., HALF + 2 : HALF + 2 + n], out=after)
        for k in range(2, HALF):
            before.add_(points[..., k : k + n])
            after.add_(points[..., HALF + 1 + k : HALF + 1 + k + n])
        middle = points[..., HALF : HALF + n]
        before.sub_(middle, alpha=HALF)  # sums of differences: exact for far points, too
        after.sub_(middle, alpha=HALF)
        x, y, z = torch.add(before, after, out=self._difference).square_()
        torch.add(x, y, out=self._curvature).add_(z)
        distance, sigma = lines.distances[:, HALF : HALF + n], lines.sigmas[:, HALF : HALF + n]
        variance = torch.mul(sigma, sigma, out=self._variance)
        variance.addcmul_(distance, distance, value=self.settings.roughness**2).mul_(_NOISE_GAIN).clamp_(min=1e-12)
        return self._curvature.div_(variance)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _find_turns(self, positions: Tensor) -> Tensor:
        """Those positions where the line turns enough (equation 2): the angle between the mean directions from the
        five neighbours before and to the five after. After `curvature`."""
        columns = self._shape[1]
        line = torch.div(positions, columns, rounding_mode="floor")
        places = positions - line * 2 * HALF - HALF
        before, after = (a.view(3, -1).index_select(1, places) for a in (self._before, self._after))
        product = -(before * after).sum(0)
        lengths = (before.square().sum(0) * after.square().sum(0)).sqrt()
        return torch.masked_select(positions, product < math.cos(math.radians(self.settings.edge_angle_deg)) * lengths)

    def _surroundings(self, lines: ScanLines) -> tuple[Tensor, Tensor]:
        """Of each point with ten neighbours, bool [L, C - 10]: whether it and they are one surface; whether it is
        the last of a surface on one side and the next point belongs to a farther one.

        A missing measurement has distance 0, is therefore beyond a gap and never farther.
        """
        d, n, step, limit = lines.distances, self._inner, self._step, self._limit
        torch.sub(d[:, 1:], d[:, :-1], out=step)
        torch.minimum(d[:, 1:], d[:, :-1], out=limit).mul_(self.settings.gap).add_(lines.sigmas[:, 1:], alpha=4)
        rises = step > limit
        falls = step < limit.neg_()
        self._gaps.copy_(rises | falls)
        measured = d[:, HALF : HALF + n] > 0
        side = torch.nn.functional.max_pool1d(self._gaps, HALF, 1) > 0  # whether 5 neighbouring steps have a gap
        left, right = side[:, :n], side[:, HALF : HALF + n]
        near = (rises[:, HALF : HALF + n] & ~left) | (falls[:, HALF - 1 : HALF - 1 + n] & ~right)
        return measured & ~(left | right), measured & near

    def _pick(self, candidates: Tensor, values: Tensor, count: int) -> Tensor:
        """Positions of the candidates of each segment with the highest values that beat their ten neighbours."""
        lines = len(values)
        if count == 0:
            return torch.empty(0, dtype=torch.int64, device=values.device)
        scores = self._scores[:lines, : self._inner]
        torch.mul(values, candidates, out=scores)
        best = torch.nn.functional.max_pool1d(scores, WINDOW, 1, HALF)
        scores.mul_(scores == best)
        parts = self._scores[:lines].view(lines, self.settings.segments, self._segment)
        if count * (HALF + 1) >= self._segment:  # no more than that can have beaten their neighbours
            return torch.masked_select(self._positions[:lines], parts > 0)
        highest, places = parts.topk(count, dim=-1)
        return torch.masked_select(self._positions[:lines].gather(-1, places), highest > 0)
