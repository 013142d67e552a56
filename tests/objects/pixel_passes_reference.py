# SPDX-License-Identifier: Apache-2.0
"""What `ggslam.objects.pixel_passes` has the compiled core do, in numpy: the tests' reference, by the same names."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.pixel_passes import Bodies, Links
from ggslam.objects.settings import GeometricSettings
from ggslam.scene.camera import Camera


def gap_tolerance(surface: DepthSurface, settings: GeometricSettings) -> np.ndarray:
    """Depth of a step that separates surfaces, float32 [H, W], metres."""
    noise = np.float32(surface.sigma) * surface.depth**2
    return np.float32(settings.jump_m) + np.float32(settings.jump_sigmas) * noise


def link_surfaces(surface: DepthSurface, rest: np.ndarray, settings: GeometricSettings) -> tuple[Links, Links]:
    tolerance = gap_tolerance(surface, settings)
    closed = (
        _unbroken(surface.depth, surface.inverse, surface.valid, tolerance),
        _unbroken(surface.depth.T, surface.inverse.T, surface.valid.T, tolerance.T).T,
    )
    right, below = (_smooth(surface, rest, axis, closed[1 - axis], settings) for axis in (1, 0))
    return closed, (right, below)


def _unbroken(z: np.ndarray, inverse: np.ndarray, valid: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    step = np.abs(z[:, 1:] - z[:, :-1])
    near = step < tolerance[:, :-1]
    bend = np.abs(inverse[:, 2:] - 2 * inverse[:, 1:-1] + inverse[:, :-2])
    miss = np.full(z.shape, np.inf, np.float32)
    miss[:, 1:-1] = bend
    miss *= z * z
    straight = np.minimum(miss[:, :-1], miss[:, 1:]) < tolerance[:, :-1]
    near |= straight & (step < 4 * tolerance[:, :-1] + 0.02 * z[:, :-1])
    return near & valid[:, 1:] & valid[:, :-1]


def _smooth(
    surface: DepthSurface, rest: np.ndarray, axis: int, closed: np.ndarray, settings: GeometricSettings
) -> np.ndarray:
    first, second = _ends(axis, 1)
    connected = rest[first] & rest[second] & closed
    before, after = _ends(axis, 2 * surface.step + 1)
    middle = np.s_[:, surface.step : -surface.step] if axis else np.s_[surface.step : -surface.step, :]
    rows, columns = np.nonzero(rest[before] & rest[after] & connected[middle])
    width = rest.shape[1]
    start = rows * width + columns
    end = start + (2 * surface.step + 1) * (1 if axis else width)
    points, normals = surface.points.reshape(-1, 3), surface.normals.reshape(-1, 3)
    way = points.take(end, 0) - points.take(start, 0)
    n, m = normals.take(start, 0), normals.take(end, 0)
    concave = ((n * m).sum(1) < np.cos(np.radians(settings.concave_degrees))) & (((m - n) * way).sum(1) < 0)
    concave &= np.abs(way[:, 2]) < 0.05 * surface.depth.ravel()[start]
    connected[middle][rows[concave], columns[concave]] = False
    return connected


def _ends(axis: int, distance: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Index of all pixels, and of those `distance` further along `axis`."""
    if axis:
        return np.s_[:, :-distance], np.s_[:, distance:]
    return np.s_[:-distance, :], np.s_[distance:, :]


def connected_pieces(segments: np.ndarray, connected: Links | None = None) -> np.ndarray:
    """The image is drawn at twice its size with the links between pixels as pixels of their own, so that one pass of a
    binary labelling does for all ids."""
    height, width = segments.shape
    if connected is None:
        connected = segments[:, :-1] == segments[:, 1:], segments[:-1] == segments[1:]
    links = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    links[::2, ::2] = 1
    links[::2, 1::2], links[1::2, ::2] = connected
    _, pieces = cv2.connectedComponents(links, connectivity=4, ltype=cv2.CV_32S)
    return np.ascontiguousarray(pieces[::2, ::2])


def grow_regions(regions: np.ndarray, valid: np.ndarray, closed: Links, passes: int) -> np.ndarray:
    width = regions.shape[1] + 2
    label = np.pad(regions, 1).ravel()
    right = np.pad(closed[0], ((1, 1), (1, 2))).ravel()
    below = np.pad(closed[1], ((1, 2), (1, 1))).ravel()
    free = np.flatnonzero(np.pad((regions == 0) & valid, 1).ravel())
    for _ in range(passes):
        found = np.zeros(len(free), label.dtype)
        for offset, link in ((-1, right), (1, right), (-width, below), (width, below)):
            near = link[free + min(offset, 0)]
            found = np.where((found == 0) & near, label[free + offset], found)
        label[free] = found
        free = free[found == 0]
    return label.reshape(-1, width)[1:-1, 1:-1]


def claim_planes(
    surface: DepthSurface, rays: np.ndarray, planes: np.ndarray, least_cosine: float, settings: GeometricSettings
) -> np.ndarray:
    x, y = rays[:1, :, 0], rays[:, :1, 1]
    label = np.zeros(surface.valid.shape, np.int32)
    nearest = settings.tolerance_sigmas * surface.sigma + settings.tolerance_m * surface.inverse**2
    nearest[~surface.valid] = 0
    normals = surface.normals.reshape(-1, 3)
    for number, plane in enumerate(planes, 1):
        away = np.abs(surface.inverse - (plane[0] * x + (plane[1] * y + plane[2])))
        chosen = np.flatnonzero(away < nearest)
        chosen = chosen[normals.take(chosen, 0) @ (-plane / np.linalg.norm(plane)) > least_cosine]
        label.ravel()[chosen] = number
        nearest.ravel()[chosen] = away.ravel()[chosen]
    return label


def share_near_planes(
    points: np.ndarray, regions: np.ndarray, asked: list[tuple[int, np.ndarray]], limit: float
) -> np.ndarray:
    shares = []
    for region, plane in asked:
        away = np.abs(points[regions == region] @ plane - 1) / np.linalg.norm(plane)
        shares.append(np.count_nonzero(away < limit) / max(len(away), 1))
    return np.array(shares)


def find_bodies(regions: np.ndarray, surface: DepthSurface) -> Bodies:
    inside = np.flatnonzero(regions)
    which, n = regions.ravel()[inside], int(regions.max(initial=0)) + 1
    p = surface.points.reshape(-1, 3)[inside].astype(np.float64)
    q = surface.normals.reshape(-1, 3)[inside].astype(np.float64)
    count = np.maximum(np.bincount(which, minlength=n), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(which, values, n) / count

    centre = np.stack([mean(p[:, k]) for k in range(3)], 1)
    facing = np.stack([mean(q[:, k]) for k in range(3)], 1)
    p, q = p - centre[which], q - facing[which]
    square = mean((p * p).sum(1))
    spread = mean((q * q).sum(1))
    bend = mean((p * q).sum(1)) / np.sqrt(np.maximum(square * spread, 1e-12))
    return Bodies(count, centre, np.sqrt(square), bend)


def count_borders(
    regions: np.ndarray, surface: DepthSurface, plane_of: np.ndarray, planes: np.ndarray, colors: np.ndarray,
    reach: int, settings: GeometricSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    normals = surface.normals.copy()
    unit = -planes / np.linalg.norm(planes, axis=1, keepdims=True)
    normals[plane_of > 0] = unit[plane_of[plane_of > 0] - 1]
    found = [_links_between(regions, surface, normals, colors, reach, axis, settings) for axis in (1, 0)]
    codes, place = np.unique(np.concatenate([codes for codes, _ in found]), return_inverse=True)
    values = np.concatenate([values for _, values in found])
    counts = [np.bincount(place, values[:, k], len(codes)).astype(np.int64) for k in range(5)]
    order = np.lexsort((values[:, -1], place))
    middle = np.cumsum(counts[0]) - (counts[0] + 1) // 2
    pairs = np.stack([codes >> 32, codes & 0xFFFFFFFF], 1)
    return pairs, np.stack(counts, 1), values[order[middle], -1]


def _links_between(
    regions: np.ndarray, surface: DepthSurface, normals: np.ndarray, colors: np.ndarray, reach: int, axis: int,
    settings: GeometricSettings,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Code of the pair, int64 [n], and float64 [n, 6], of the links between regions along an axis."""
    limit = np.cos(np.radians(settings.concave_degrees))
    first, second = _ends(axis, 1)
    x, y = regions[first], regions[second]
    rows, columns = np.nonzero((x != y) & (x > 0) & (y > 0))
    a = rows * regions.shape[1] + columns
    b = a + (1 if axis else regions.shape[1])
    p, q = _shift(a, regions.shape, axis, -reach), _shift(b, regions.shape, axis, reach)
    points, normal, color = (image.reshape(-1, 3) for image in (surface.points, normals, colors))
    flat = regions.ravel()
    judged = (flat[p] == flat[a]) & (flat[q] == flat[b])
    p, q = np.where(judged, p, a), np.where(judged, q, b)
    step, tolerance = points[b] - points[a], gap_tolerance(surface, settings).ravel()[a]
    miss = np.minimum(np.abs((normal[p] * step).sum(1)), np.abs((normal[q] * step).sum(1)))
    closed = (miss < tolerance) & (np.abs(step[:, 2]) < 4 * tolerance + 0.02 * points[a, 2])
    opening = ((normal[q] - normal[p]) * (points[q] - points[p])).sum(1)
    judged &= closed
    bent = judged & ((normal[p] * normal[q]).sum(1) < limit)
    contrast = np.linalg.norm(color[p] - color[q], axis=1)
    low, high = np.minimum(flat[a], flat[b]).astype(np.int64), np.maximum(flat[a], flat[b])
    return low << 32 | high, np.stack([np.ones(len(a)), closed, judged, bent & (opening < 0), bent, contrast], 1)


def _shift(index: np.ndarray, shape: tuple[int, ...], axis: int, by: int) -> np.ndarray:
    rows, columns = np.divmod(index, shape[1])
    if axis:
        columns = (columns + by).clip(0, shape[1] - 1)
    else:
        rows = (rows + by).clip(0, shape[0] - 1)
    return rows * shape[1] + columns


def count_contacts(
    pieces: np.ndarray, owner: np.ndarray, depth: np.ndarray, near: tuple[float, float], before: tuple[float, float],
    behind: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    codes, steps, depths = [], [], []
    for first, second in (_ends(1, 1), _ends(0, 1)):
        rows, columns = np.nonzero(pieces[first] != pieces[second])
        p, q = pieces[first][rows, columns].astype(np.int64), pieces[second][rows, columns].astype(np.int64)
        z, w = depth[first][rows, columns], depth[second][rows, columns]
        codes += [p << 32 | owner[q], q << 32 | owner[p]]
        steps += [z - w, w - z]
        depths += [z, w]
    step, z = np.concatenate(steps), np.concatenate(depths)
    found, place = np.unique(np.concatenate(codes), return_inverse=True)
    limit = near[0] + near[1] * z
    kinds = np.abs(step) < limit, step > -behind * z, step >= before[0] + before[1] * z
    counts = [np.bincount(place, kind, len(found)).astype(np.int64) for kind in (np.ones(len(z)), *kinds)]
    return np.stack([found >> 32, found & 0xFFFFFFFF], 1), np.stack(counts, 1)


def normals_of_inverse(inverse: np.ndarray, camera: Camera, step: int, jump: float) -> np.ndarray:
    gx = _slope(inverse, step, jump) * np.float32(camera.fx)
    gy = _slope(inverse.T, step, jump).T * np.float32(camera.fy)
    rays = camera.rays()
    # n . ray = 1/z (times a constant) on a plane, so its gradient holds the first two components.
    normals = np.dstack([gx, gy, inverse - gx * rays[..., 0] - gy * rays[..., 1]])
    normals /= -np.maximum(np.sqrt(np.einsum("ijk,ijk->ij", normals, normals)), 1e-9)[..., None]
    return normals


def _slope(values: np.ndarray, step: int, jump: float) -> np.ndarray:
    """Difference per pixel along the rows of float32 [H, W]."""
    padded = cv2.copyMakeBorder(np.ascontiguousarray(values), 0, 0, step, step, cv2.BORDER_REPLICATE)
    left, right = values - padded[:, : -2 * step], padded[:, 2 * step :] - values
    smaller = np.where(np.abs(left) < np.abs(right), left, right)
    slope = np.where(np.abs(left - right) < jump, (left + right) / 2, smaller)
    slope[:, :step], slope[:, -step:] = right[:, :step], left[:, -step:]
    return slope / np.float32(step)


def count_alike(
    colors: np.ndarray, pieces: np.ndarray, asked: np.ndarray, means: np.ndarray, limit: float
) -> np.ndarray:
    away = colors[None] - means[:, None]
    return np.count_nonzero(((away * away).sum(2) < limit**2) & (pieces[None] != asked[:, None]), 1)


def outlier_colors(
    lab: np.ndarray, inside: np.ndarray, pieces: np.ndarray, *, light: np.ndarray, bins: tuple[float, float, float],
    cell: int, least_cell: float, occurs: float, usual: float, base: float, same_hue: float,
    shade: tuple[float, float],
) -> np.ndarray:  # fmt: skip
    rows, columns = np.nonzero(inside)
    number, _, pixels = _number(rows // cell * inside.shape[1] + columns // cell)
    colors = lab[rows, columns].copy()
    colors[:, 0] -= (np.stack([rows, columns, np.ones(len(rows))], 1) @ light).astype(np.float32)
    place = np.floor(colors / np.array(bins, np.float32)).astype(np.int32)
    place -= place.min(0)
    sides = place.max(0) + 1
    which, code, size = _number((place[:, 0] * sides[1] + place[:, 1]) * sides[2] + place[:, 2])
    place = np.stack(np.unravel_index(code, sides), 1)
    table = np.bincount(which * len(pixels) + number, minlength=len(code) * len(pixels)).reshape(len(code), -1)
    near = (np.abs(place[:, None] - place[None]) <= 1).all(2)
    share = (near.astype(np.int64) @ table) / pixels
    common = (share[:, pixels >= least_cell] >= occurs).mean(1) >= usual
    mean = np.stack([np.bincount(which, lab[rows, columns, k]) / size for k in range(3)], 1)
    ratio = mean[:, None, 0] / np.maximum(mean[None, common, 0], 1)
    hue = np.hypot(*(mean[:, None, k] - mean[None, common, k] for k in (1, 2)))
    shaded = ((hue < same_hue) & (ratio > shade[0]) & (ratio < shade[1])).any(1)
    kind = np.where(common, 0, np.where(shaded, 1, 2))
    number = pieces[rows, columns]
    out = np.zeros(inside.shape, np.uint8)
    out[rows, columns] = np.where((np.bincount(number) >= base * len(rows))[number], 0, kind[which])
    return out


def _number(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Small whole numbers [n] numbered through: each one's number [n], the values in order, how often each occurs."""
    count = np.bincount(values)
    there = np.flatnonzero(count)
    number = np.zeros(len(count), np.int32)
    number[there] = np.arange(len(there))
    return number[values], there, count[there]
