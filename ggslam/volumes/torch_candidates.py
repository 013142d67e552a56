# SPDX-License-Identifier: Apache-2.0
"""Which blocks a view tells about, in plain torch: the rules of the compiled core (native/src/volumes/
tsdf_candidates.cpp), for all blocks of the frustum at once instead of from large cubes to small ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import pad

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning

TILE: Final = 4
"""Pixels along the edge of the compiled core's tiles of depth."""
NEAR: Final = 0.02
"""Depth from which the compiled core updates blocks, in metres."""


class CandidateTuning(Tuning):
    """How blocks are searched."""

    pairs_at_once = 1 << 22
    """Pairs of a block and a tile that are checked at a time."""


@dataclass(frozen=True)
class DeviceView:
    """A view on the device: depth float32 [H, W] with 0 for none, camera, rotation [3, 3] and translation [3] of
    T_camera_world (float64), and the range: depth beyond it is no surface's, but what lies before it is free."""

    depth: Tensor
    camera: Camera
    rotation: Tensor
    translation: Tensor
    max_depth: float


@dataclass(frozen=True)
class BlockCandidates:
    """Blocks in view: coordinates int64 [n, 3], z [n] of their centres, and what is seen of each: a surface within the
    truncation, or free space throughout; or whether the range ends in it."""

    coordinates: Tensor
    z: Tensor
    surface: Tensor
    free: Tensor
    passed: Tensor


@dataclass(frozen=True)
class _Tiles:
    """Smallest and largest depth by tile, level after level in one row; pixels with depth, summed from the top left."""

    low: Tensor
    high: Tensor
    widths: Tensor
    starts: Tensor
    sums: Tensor


def find_candidates(view: DeviceView, block: float, truncation: float, free_share: float) -> BlockCandidates:
    """Blocks of edge `block` metres that show a surface, are free throughout, or are in view otherwise."""
    device = view.depth.device
    if not bool((view.depth > 0).any()):
        none = torch.zeros(0, device=device)
        return BlockCandidates(none.long().reshape(0, 3), none, *[none.bool()] * 3)
    tiles = _tiles(view.depth)
    at = _frustum_blocks(view, block, min(float(view.depth.max()), view.max_depth) + truncation)
    centre = ((at.double() + 0.5) * block) @ view.rotation.T + view.translation
    extent = 0.5 * block * view.rotation.abs().sum(1)
    area, whole, visible = _footprints(view.camera, centre.float(), extent.float())
    at, centre, area, whole = at[visible], centre[visible].float(), area[visible], whole[visible]
    near, far = centre[:, 2] - extent[2].float(), centre[:, 2] + extent[2].float()

    low, high = _range_over(tiles, area)
    some = (high > 0) & (high >= near - truncation)
    at, centre, area, whole, low, near, far = (a[some] for a in (at, centre, area, whole, low, near, far))
    behind = low > far + truncation
    surface, hidden, passed = (torch.zeros_like(behind) for _ in range(3))
    unsure = torch.nonzero(~behind)[:, 0]
    position = -view.rotation.T @ view.translation
    offset = ((at[unsure].double() + 0.5) * block - position).float()
    seen = _look(view, tiles, area[unsure], offset, near[unsure], far[unsure], 0.5 * block, truncation)
    behind[unsure], hidden[unsure], surface[unsure], passed[unsure] = seen
    keep = behind | surface | passed
    passed = ~surface & (passed | (far > view.max_depth))
    whole &= _valid_share(tiles, area, view.camera) >= free_share
    free = behind & ~hidden & ~surface & ~passed & whole
    return BlockCandidates(at[keep], centre[keep, 2], surface[keep], free[keep], passed[keep])


def _tiles(depth: Tensor) -> _Tiles:
    height, width = depth.shape
    padded = pad(depth, (0, -width % TILE, 0, -height % TILE))
    blocks = padded.unfold(0, TILE, TILE).unfold(1, TILE, TILE).flatten(2)
    low, high = torch.where(blocks > 0, blocks, torch.inf).amin(2), blocks.amax(2)
    counts = (blocks > 0).sum(2)
    sums = pad(counts.cumsum(0).cumsum(1), (1, 0, 1, 0))
    lows, highs, widths = [low], [high], [low.shape[1]]
    while max(low.shape) > 1:
        odd = (0, low.shape[1] % 2, 0, low.shape[0] % 2)
        low = pad(low, odd, value=torch.inf).unfold(0, 2, 2).unfold(1, 2, 2).flatten(2).amin(2)
        high = pad(high, odd).unfold(0, 2, 2).unfold(1, 2, 2).flatten(2).amax(2)
        lows.append(low)
        highs.append(high)
        widths.append(low.shape[1])
    sizes = torch.tensor([0, *(level.numel() for level in lows)], device=depth.device)
    return _Tiles(
        torch.cat([level.flatten() for level in lows]), torch.cat([level.flatten() for level in highs]),
        torch.tensor(widths, device=depth.device), sizes.cumsum(0), sums,
    )  # fmt: skip


def _frustum_blocks(view: DeviceView, block: float, far: float) -> Tensor:
    c, rotation, translation = view.camera, view.rotation, view.translation
    x = torch.tensor([-0.5 - c.cx, c.width - 0.5 - c.cx], dtype=torch.float64) / c.fx
    y = torch.tensor([-0.5 - c.cy, c.height - 0.5 - c.cy], dtype=torch.float64) / c.fy
    corners = torch.cartesian_prod(x, y, torch.ones(1, dtype=torch.float64)) * far
    corners = torch.cat([torch.zeros(1, 3, dtype=torch.float64), corners]).to(rotation.device)
    world = (corners - translation) @ rotation
    first, last = (world.amin(0) / block).floor().long(), (world.amax(0) / block).floor().long()
    axes = [torch.arange(int(a), int(b) + 1, device=rotation.device) for a, b in zip(first, last, strict=True)]
    return torch.cartesian_prod(*axes)


def _footprints(camera: Camera, centre: Tensor, extent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tiles u0, v0, u1, v1 (inclusive) of blocks, whether nothing is cut off, and whether there are any."""
    near, far = centre[:, 2] - extent[2], centre[:, 2] + extent[2]
    start = near.clamp(min=NEAR)
    whole, visible = near >= NEAR, far > NEAR
    low, high = [], []
    c = camera
    for a, (focal, middle, size) in enumerate(((c.fx, c.cx, c.width), (c.fy, c.cy, c.height))):
        left, right = centre[:, a] - extent[a], centre[:, a] + extent[a]
        p0 = focal * left / torch.where(left < 0, start, far) + middle + 0.5
        p1 = focal * right / torch.where(right > 0, start, far) + middle + 0.5
        visible = visible & (p1 >= 0) & (p0 < size)
        whole = whole & (p0 >= 0) & (p1 < size)
        low.append(p0.clamp(0, size - 1).long() // TILE)
        high.append(p1.clamp(0, size - 1).long() // TILE)
    return torch.stack([*low, *high], 1), whole, visible


def _range_over(tiles: _Tiles, area: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the depth in footprints, from the four tiles of a level that cover each."""
    span = torch.maximum(area[:, 2] - area[:, 0], area[:, 3] - area[:, 1])
    level = torch.ceil(torch.log2(span.clamp(min=1).double())).long()
    level = level.clamp(max=len(tiles.widths) - 1)
    low, high = torch.full_like(span, torch.inf, dtype=torch.float32), torch.zeros_like(span, dtype=torch.float32)
    for u in (area[:, 0], area[:, 2]):
        for v in (area[:, 1], area[:, 3]):
            at = tiles.starts[level] + (v >> level) * tiles.widths[level] + (u >> level)
            low, high = torch.minimum(low, tiles.low[at]), torch.maximum(high, tiles.high[at])
    return low, high


def _look(
    view: DeviceView, tiles: _Tiles, area: Tensor, offset: Tensor, near: Tensor, far: Tensor, half: float,
    truncation: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Whether depth lies behind, in front of, and at blocks, and whether depth beyond the range lies at them, tile by
    tile of their footprints; bool [n] each."""
    n, device = len(area), area.device
    found = torch.zeros(4, n, dtype=torch.bool, device=device)
    columns = area[:, 2] - area[:, 0] + 1
    counts = columns * (area[:, 3] - area[:, 1] + 1)
    ends = counts.cumsum(0)
    total = int(ends[-1]) if n else 0
    for begin in range(0, total, CandidateTuning.pairs_at_once):
        pair = torch.arange(begin, min(begin + CandidateTuning.pairs_at_once, total), device=device)
        b = torch.searchsorted(ends, pair, right=True)
        within = pair - (ends[b] - counts[b])
        u, v = area[b, 0] + within % columns[b], area[b, 1] + within // columns[b]
        tile = v * tiles.widths[0] + u
        met, z0, z1 = _intersect_rays(view, u, v, offset[b], near[b], far[b], half)
        low, high = z0 - truncation, z1 + truncation
        least, most = tiles.low[tile], tiles.high[tile]
        met &= most > 0
        behind, front = met & (least > high), met & (most < low)
        at = met & ~behind & ~front
        beyond, passed = at & (most > view.max_depth), torch.zeros_like(at)
        # Depth in front and behind: nothing may lie between.
        split = torch.nonzero(at & ~beyond & (least < low) & (most > high))[:, 0]
        z = _pixels(view.depth, u[split], v[split])
        between = ((z >= low[split, None]) & (z <= high[split, None])).any(1)
        at[split], behind[split], front[split] = between, ~between, ~between
        split = torch.nonzero(beyond)[:, 0]
        flags = _look_beyond(_pixels(view.depth, u[split], v[split]), low[split], high[split], view.max_depth)
        behind[split], front[split], at[split], passed[split] = flags
        for kind, met in zip(found, (behind, front, at, passed), strict=True):
            kind[b[met]] = True
    return found[0], found[1], found[2], found[3]


def _intersect_rays(
    view: DeviceView, u: Tensor, v: Tensor, offset: Tensor, near: Tensor, far: Tensor, half: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Whether rays through tiles (u, v) meet cubes, and the stretch of depth in which they do."""
    c = view.camera
    x = ((2 * u + 1) * (0.5 * TILE) - 0.5 - c.cx) / c.fx
    y = ((2 * v + 1) * (0.5 * TILE) - 0.5 - c.cy) / c.fy
    axes = view.rotation.T.float()
    z0, z1, met = near.clamp(min=NEAR), far, torch.ones_like(near, dtype=torch.bool)
    for a in range(3):
        direction = axes[a, 0] * x + axes[a, 1] * y + axes[a, 2]
        spread = 0.5 * TILE * (axes[a, 0].abs() / c.fx + axes[a, 1].abs() / c.fy)
        low, high = offset[:, a] - half, offset[:, a] + half
        most, least = direction + spread, direction - spread
        z0 = torch.where(most > 0, torch.maximum(z0, low / most), z0)
        z1 = torch.where(most < 0, torch.minimum(z1, low / most), z1)
        z1 = torch.where(least > 0, torch.minimum(z1, high / least), z1)
        z0 = torch.where(least < 0, torch.maximum(z0, high / least), z0)
        met &= ~((most == 0) & (low > 0)) & ~((least == 0) & (high < 0))
    return met & (z0 <= z1), z0, z1


def _look_beyond(z: Tensor, low: Tensor, high: Tensor, max_depth: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What `_look` tells of tiles with depth beyond the range, pixel by pixel z [n, 16]."""
    behind, front = z > high[:, None], (z > 0) & (z < low[:, None])
    at = (z > 0) & ~behind & ~front
    passed = at & (z > max_depth)
    return behind.any(1), front.any(1), (at & ~passed).any(1), passed.any(1)


def _pixels(depth: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Depth of tiles [n, 16]; beyond the border that of the last pixel."""
    step = torch.arange(TILE, device=depth.device)
    rows = (v[:, None] * TILE + step).clamp(max=depth.shape[0] - 1)
    columns = (u[:, None] * TILE + step).clamp(max=depth.shape[1] - 1)
    return depth[rows[:, :, None], columns[:, None, :]].flatten(1)


def _valid_share(tiles: _Tiles, area: Tensor, camera: Camera) -> Tensor:
    u0, v0, u1, v1 = area.T
    s = tiles.sums
    n = s[v1 + 1, u1 + 1] - s[v1 + 1, u0] - s[v0, u1 + 1] + s[v0, u0]
    columns = ((u1 + 1) * TILE).clamp(max=camera.width) - u0 * TILE
    rows = ((v1 + 1) * TILE).clamp(max=camera.height) - v0 * TILE
    return n / (columns * rows)
