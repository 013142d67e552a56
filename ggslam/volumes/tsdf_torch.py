# SPDX-License-Identifier: Apache-2.0
"""The TSDF in plain torch: the same fusion as the compiled core's (`TsdfMap`), batched over blocks, for any device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ggslam.errors import InputError
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.origin import local_origin, moved_pose
from ggslam.volumes.fusion_view import FusionView
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.torch_candidates import NEAR, BlockCandidates, DeviceView, find_candidates
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, MOST_VOXELS, OCCUPIED_HITS, SIDE, VOXELS, TsdfMap

_DOUBT: Final = 0.03
"""The compiled core's: share of the depth behind a voxel that makes free space certain."""
_DOUBTFUL_SHARE: Final = 0.03
"""The compiled core's: share of its weight that an uncertain view may take from a voxel."""
_SURPRISE: Final = 0.5
"""The compiled core's: difference to the stored value, as a share of the truncation, that is unexpected."""
_FREE_FROM = 0.98 * FREE_VALUE
_EROSION: Final = 2
"""The compiled core's: pixels by which depth is eroded to be certain."""
_RANGE_SLACK: Final = 1.00001
"""The compiled core's: factor on the largest depth, for rounding."""
_LABEL_VOXELS: Final = 2.0
"""The compiled core's: voxels around the surface that vote for an object."""
_HIT: Final = 41
"""The compiled core's: evidence that a measured point adds."""
_MISS: Final = 20
"""The compiled core's: evidence that a view through a voxel takes."""
_LEAST_HITS: Final = OCCUPIED_HITS - 47
"""The compiled core's: smallest evidence."""
_MOST_HITS: Final = OCCUPIED_HITS + 83
"""The compiled core's: largest evidence."""
_COLOR_SHARE: Final = 0.125
"""The compiled core's: smallest share of a new colour."""
_OFFSET: Final = 1 << 20
"""Block coordinates are smaller than this, so that three of them make one number of 64 bits."""


@dataclass
class Voxels:
    """Voxels of blocks as in `tsdf.BlockVoxels`, [n, 512] (color [n, 512, 3]), as int32 (value, weight, label, votes,
    hits, octants) and uint8 (color)."""

    value: Tensor
    weight: Tensor
    color: Tensor
    label: Tensor
    votes: Tensor
    hits: Tensor
    octants: Tensor

    @staticmethod
    def free(weight: Tensor) -> Voxels:
        """Blocks that are free throughout, with weights [n]."""
        value = torch.full((len(weight), VOXELS), FREE_VALUE, dtype=torch.int32, device=weight.device)
        nothing = torch.zeros_like(value)
        color = torch.zeros((*value.shape, 3), dtype=torch.uint8, device=weight.device)
        weights = weight[:, None].expand_as(value).int().clone()
        hits = torch.where(weights > 0, _LEAST_HITS, 0).int()
        return Voxels(value, weights, color, nothing, nothing.clone(), hits, nothing.clone())

    def __getitem__(self, rows: Tensor) -> Voxels:
        return Voxels(*(a[rows] for a in vars(self).values()))

    def put(self, rows: Tensor, other: Voxels) -> None:
        """Overwrites blocks."""
        for name, array in vars(self).items():
            array[rows] = getattr(other, name)

    def join(self, other: Voxels) -> Voxels:
        """Both, one after the other."""
        return Voxels(*(torch.cat([a, getattr(other, name)]) for name, a in vars(self).items()))


class TorchTsdf:
    """The map on a device.

    Its blocks are those of a `TsdfMap` that fused the same views: dense where a surface was seen within the truncation,
    free throughout between it and the camera. Values agree up to rounding.

    Args:
        settings: of the fusion.
        device: to work on.
        points: whether measured points are counted, as of a `TsdfMap`.

    Raises:
        InputError: the settings ask for another integrator than projection.
    """

    def __init__(
        self, settings: TsdfSettings | None = None, device: str | torch.device = "cpu", points: bool = True
    ) -> None:
        self.settings, self.points = settings or TsdfSettings(), points
        if self.settings.integrator != "projection":
            raise InputError(f"integrator: a device looks depth up by projection, not by {self.settings.integrator}")
        self.origin: np.ndarray | None = None
        """Where in the world blocks are counted from, as of a `TsdfMap`; None until the first view."""
        self.device = torch.device(device)
        none = torch.zeros(0, dtype=torch.int64, device=self.device)
        self._dense, self._voxels = none, Voxels.free(none)
        self._free, self._free_weight = none, none

    @property
    def dense_blocks(self) -> int:
        """Blocks with voxels."""
        return len(self._dense)

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self._dense) + len(self._free)

    def integrate(
        self,
        depth: np.ndarray,
        camera: Camera,
        T_world_camera: np.ndarray,
        color: np.ndarray | None = None,
        labels: np.ndarray | None = None,
    ) -> None:
        """Fuses a view; arguments and errors of `TsdfMap.integrate`."""
        s = self.settings
        limit = min(MOST_VOXELS, 0.5 * _OFFSET * SIDE) * s.voxel
        pose = np.asarray(T_world_camera, np.float64)
        if pose.shape == (4, 4) and np.isfinite(pose).all():  # else it is refused
            self.origin = local_origin(pose[:3, 3]) if self.origin is None else self.origin
            pose = moved_pose(pose, -self.origin)
        checked = FusionView(depth, camera, pose, color, labels, limit)
        T = torch.from_numpy(checked.T_camera_world).to(self.device)
        depth_image = torch.tensor(checked.depth).to(self.device)
        told = torch.where(depth_image >= s.min_depth, depth_image.clamp(max=s.max_depth + 2 * s.truncation), 0)
        view = DeviceView(told, camera, T[:3, :3], T[:3, 3], s.max_depth)
        found = find_candidates(view, SIDE * s.voxel, s.truncation, s.free_share)
        keys = _keys(found.coordinates)
        dense_row, free_row = _rows(self._dense, keys), _rows(self._free, keys)
        self._note_free(found, keys, dense_row, free_row)

        old = dense_row >= 0
        # A block that is not known yet gets voxels also if parts of it alone are seen as free, except where the range
        # ends.
        new = ~old & (found.surface | (~found.free & ~found.passed & (free_row < 0)))
        weight = torch.zeros_like(keys)
        known = free_row >= 0
        weight[known] = self._free_weight[free_row[known]]
        voxels = self._voxels[dense_row[old]].join(Voxels.free(weight[new]))
        color_image = None if checked.color is None else torch.tensor(checked.color).to(self.device)
        label_image = None if checked.labels is None else torch.from_numpy(checked.labels.astype(np.int32))
        at = torch.cat([found.coordinates[old], found.coordinates[new]])
        in_band = _fuse(voxels, at, view, s, color_image, None if label_image is None else label_image.to(self.device))
        if self.points:
            in_band |= _count_points(voxels, at, view, s)
        seen = ((voxels.weight > 0) | (voxels.hits >= OCCUPIED_HITS)).any(1)
        told = torch.where(free_row[new] < 0, seen[int(old.sum()) :], in_band[int(old.sum()) :])
        self._keep(voxels, dense_row[old], keys[new], told)

    def _note_free(self, found: BlockCandidates, keys: Tensor, dense_row: Tensor, free_row: Tensor) -> None:
        free = found.free & (dense_row < 0)
        scale = FULL_WEIGHT / self.settings.max_weight
        measured = (scale / found.z[free] ** 2 + 0.5).floor().long()
        known = free_row[free] >= 0
        rows = free_row[free][known]
        before = torch.zeros_like(measured)
        before[known] = self._free_weight[rows]
        most = before.clamp(min=int(self.settings.max_free_weight * scale))
        weight = torch.minimum(before + measured, most)
        self._free_weight[rows] = weight[known]
        self._free = torch.cat([self._free, keys[free][~known]])
        self._free_weight = torch.cat([self._free_weight, weight[~known]])

    def _keep(self, voxels: Voxels, rows: Tensor, new_keys: Tensor, told: Tensor) -> None:
        """Takes over updated blocks: those at `rows`, then of the new ones those that the view told something about.
        Blocks free throughout give their voxels back."""
        n = len(rows)
        empty = voxels.hits < OCCUPIED_HITS
        all_free = ((voxels.value == FREE_VALUE) & (voxels.weight > 0) & empty).all(1)
        self._voxels.put(rows, voxels[torch.arange(n, device=self.device)])
        freed, freed_new = rows[all_free[:n]], new_keys[all_free[n:]]
        least = voxels.weight.amin(1).long()[all_free]
        made = torch.nonzero(told & ~all_free[n:])[:, 0]
        gone = torch.isin(self._free, torch.cat([new_keys[made], freed_new]))
        self._free = torch.cat([self._free[~gone], self._dense[freed], freed_new])
        self._free_weight = torch.cat([self._free_weight[~gone], least])
        if len(freed):
            stays = torch.ones_like(self._dense, dtype=torch.bool)
            stays[freed] = False
            self._dense, self._voxels = self._dense[stays], self._voxels[stays]
        if len(made):
            self._dense = torch.cat([self._dense, new_keys[made]])
            self._voxels = self._voxels.join(voxels[made + n])

    def to_native(self, context: NativeContext | None = None) -> TsdfMap:
        """The same map for mesh, distance field and files."""
        tsdf = TsdfMap(self.settings, context, self.origin, self.points)
        arrays = {name: array.cpu().numpy() for name, array in vars(self._voxels).items()}
        tsdf.write(_coordinates(self._dense), **arrays)
        tsdf.write_free(_coordinates(self._free), self._free_weight.cpu().numpy())
        return tsdf


def _keys(coordinates: Tensor) -> Tensor:
    x, y, z = (coordinates + _OFFSET).unbind(1)
    return (x << 42) + (y << 21) + z


def _coordinates(keys: Tensor) -> np.ndarray:
    mask = 2 * _OFFSET - 1
    return (torch.stack([keys >> 42, keys >> 21 & mask, keys & mask], 1) - _OFFSET).cpu().numpy()


def _rows(table: Tensor, keys: Tensor) -> Tensor:
    """Where `keys` stand in `table`; -1: nowhere."""
    if len(table) == 0:
        return torch.full_like(keys, -1)
    ordered, order = table.sort()
    place = torch.searchsorted(ordered, keys).clamp(max=len(table) - 1)
    return torch.where(ordered[place] == keys, order[place], -1)


# --- voxels ----------------------------------------------------------------------------------------------------------


def _fuse(
    voxels: Voxels, at: Tensor, view: DeviceView, s: TsdfSettings, color: Tensor | None, labels: Tensor | None
) -> Tensor:
    """Updates the voxels of blocks at coordinates [n, 3]; returns whether any came within the truncation, [n]."""
    distance, z, pixel = _distances(at, view, s)
    scale = FULL_WEIGHT / s.max_weight
    drop = ((distance + s.truncation) / (s.truncation - s.voxel)).clamp(max=1)
    measured = _round(scale / z**2 * drop).clamp(max=FULL_WEIGHT)
    value, weight = voxels.value.float(), voxels.weight.float()
    # Depth beyond the range makes known what is free up to the range. What a surface in range left nearer to it, or
    # behind the range, goes with that surface.
    in_range = distance + z <= _RANGE_SLACK * s.max_depth
    told = (weight > 0) | in_range | ((distance >= s.truncation) & (z <= s.max_depth))
    valid = told & (distance >= -s.truncation) & (measured >= 1)
    behind = valid & (distance >= s.truncation)
    scaled = FREE_VALUE / s.truncation * distance
    if s.clearing > 0:
        through = behind & (weight > 0) & (value < _FREE_FROM) & (scaled - value > _SURPRISE * FREE_VALUE)
        sure = through & (_erode(view.depth).flatten()[pixel] >= z * (1 + _DOUBT) + s.truncation)
        little = torch.minimum(measured, _round(weight * _DOUBTFUL_SHARE).clamp(min=1))
        measured = torch.where(through & ~sure, little, measured)
        weight = torch.where(sure, _round(weight * (1 - s.clearing)), weight)
    total = weight + measured
    share = measured / total
    mean = value + share * (scaled.clamp(max=FREE_VALUE) - value)
    mean = torch.where(behind & (mean >= _FREE_FROM), FREE_VALUE, mean)
    most = torch.where(mean >= FREE_VALUE, s.max_free_weight * scale, float(FULL_WEIGHT))
    grown = torch.minimum(total, torch.maximum(most, weight - measured))
    voxels.value = torch.where(valid, _round(mean).int(), voxels.value)
    voxels.weight = torch.where(valid, grown.int(), voxels.weight)
    band = valid & ~behind
    if color is not None:
        bare = (voxels.color == 0).all(-1)
        part = torch.where(bare, 1.0, share.clamp(min=_COLOR_SHARE))[..., None]
        before = voxels.color.float()
        after = before + part * (color.reshape(-1, 3)[pixel].float() - before)
        voxels.color = torch.where(band[..., None], (after + 0.5).to(torch.uint8), voxels.color)
    if labels is not None:
        _vote(voxels, band & (distance.abs() <= _LABEL_VOXELS * s.voxel), labels.flatten()[pixel])
    return band.any(1)


def _octants(at: Tensor, view: DeviceView, s: TsdfSettings) -> Tensor:
    """Octants of the voxels of blocks at coordinates [n, 3] that the view has points in, bits, int32 [n, 512]."""
    c, device = view.camera, at.device
    v, u = torch.nonzero((view.depth > 0) & (view.depth <= view.max_depth), as_tuple=True)
    z = view.depth[v, u].double()
    points = torch.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], 1) - view.translation
    octant = ((points @ view.rotation) * (2 / s.voxel)).floor().long()
    row = _rows(_keys(at), _keys(octant >> 4))
    within, bit = octant >> 1 & 7, octant & 1
    place = (row * VOXELS + within[:, 0] + SIDE * within[:, 1] + SIDE**2 * within[:, 2]) * 8
    marks = torch.zeros(len(at) * VOXELS * 8, dtype=torch.int32, device=device)
    marks[(place + bit[:, 0] + 2 * bit[:, 1] + 4 * bit[:, 2])[row >= 0]] = 1
    return (marks.view(len(at), VOXELS, 8) << torch.arange(8, device=device, dtype=torch.int32)).sum(2).int()


def _count_points(voxels: Voxels, at: Tensor, view: DeviceView, s: TsdfSettings) -> Tensor:
    """Counts hits and misses; returns whether the view has points in blocks at coordinates [n, 3], [n]."""
    octants, missed, before = _octants(at, view, s), _distances(at, view, s)[0] >= s.voxel, voxels.hits
    start = torch.where(before > 0, before, OCCUPIED_HITS)
    down = torch.where(missed, (start - _MISS).clamp(min=_LEAST_HITS), before)
    voxels.hits = torch.where(octants > 0, (start + _HIT).clamp(max=_MOST_HITS), down).int()
    kept = (octants > 0) | (voxels.hits >= OCCUPIED_HITS)
    voxels.octants = torch.where(kept, voxels.octants | octants, 0)
    return (octants > 0).any(1)


def _round(values: Tensor) -> Tensor:
    return (values + 0.5).floor()


def _distances(at: Tensor, view: DeviceView, s: TsdfSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Distance of voxels along the optical axis (-inf: unknown), their z, and the nearest pixel (0: none); [n, 512]."""
    device, c = at.device, view.camera
    side = torch.arange(SIDE, device=device, dtype=torch.float64)
    within = torch.cartesian_prod(side, side, side).flip(1) + 0.5
    origin = (at.double() * SIDE * s.voxel) @ view.rotation.T + view.translation
    points = (origin[:, None] + (within * s.voxel) @ view.rotation.T).float()
    x, y, z = points.unbind(-1)
    safe = z.clamp(min=NEAR)
    u, v = c.fx * x / safe + c.cx, c.fy * y / safe + c.cy
    inside = (z > NEAR) & (u >= -0.5) & (u < c.width - 0.5) & (v >= -0.5) & (v < c.height - 0.5)
    pixel = torch.where(inside, (v + 0.5).long() * c.width + (u + 0.5).long(), 0)
    nearest = view.depth.flatten()[pixel]
    depth = _interpolate(view, inside, u, v, nearest, s)
    # Depth beyond the range is no surface's: it tells of what lies before it alone.
    told = (nearest > 0) & ((nearest <= s.max_depth) | (nearest >= z))
    return torch.where(inside & told, depth - z, -torch.inf), safe, pixel


def _interpolate(view: DeviceView, inside: Tensor, u: Tensor, v: Tensor, nearest: Tensor, s: TsdfSettings) -> Tensor:
    """Depth between the four pixels around (u, v), where they are all there, in range, and differ little; else the
    nearest."""
    height, width = view.depth.shape
    inside = inside & (u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1)
    u0, v0 = torch.where(inside, u, 0).long(), torch.where(inside, v, 0).long()
    right, below = min(1, width - 1), width if height > 1 else 0
    flat, at = view.depth.flatten(), v0 * width + u0
    a, b, c, d = flat[at], flat[at + right], flat[at + below], flat[at + below + right]
    low, high = a.minimum(b).minimum(c.minimum(d)), a.maximum(b).maximum(c.maximum(d))
    smooth = inside & (low > 0) & (high <= s.max_depth)
    smooth &= high - low <= (0.02 * low).clamp(min=s.edge_voxels * s.voxel)
    x, y = u - u0, v - v0
    top, bottom = a + x * (b - a), c + x * (d - c)
    return torch.where(smooth, top + y * (bottom - top), nearest)


def _erode(depth: Tensor) -> Tensor:
    """Smallest depth around each pixel; infinite where there is none."""
    known = torch.where(depth > 0, depth, torch.inf)
    return -max_pool2d(-known[None, None], 2 * _EROSION + 1, stride=1, padding=_EROSION)[0, 0]


def _vote(voxels: Voxels, near: Tensor, seen: Tensor) -> None:
    near = near & (seen > 0)
    same = near & (seen == voxels.label)
    taken = near & ~same & (voxels.votes == 0)
    against = near & ~same & ~taken
    voxels.votes = torch.where(same | taken, (voxels.votes + 1).clamp(max=255), voxels.votes - against.int())
    voxels.label = torch.where(taken, seen, voxels.label)
