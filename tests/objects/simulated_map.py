# SPDX-License-Identifier: Apache-2.0
"""A labelled map without Gaussians, for tests of association: voxels with votes, rendered with a z-buffer."""

from __future__ import annotations

import numpy as np

from ggslam.objects.association import MapView
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame

_OFFSET = 1 << 20


class LabelledVoxels:
    """Votes of object ids in voxels of `size` metres."""

    def __init__(self, size: float = 0.02) -> None:
        self.size = size
        self._keys = np.zeros(0, np.int64)
        self._points = np.zeros((0, 3))
        self._votes = np.zeros(0, np.int64)  # voxel number * 65536 + id
        self._weights: np.ndarray = np.zeros(0)

    def add(self, frame: Frame, ids: np.ndarray) -> None:
        """Adds the points of a frame and votes for their ids (0: no vote)."""
        seen = frame.depth > 0
        points = world_points(frame)
        keys = self._keys_of(points)
        new, first = np.unique(keys, return_index=True)
        first = first[~np.isin(new, self._keys)]
        order = np.argsort(np.concatenate([self._keys, keys[first]]), kind="stable")
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        self._votes = place[self._votes >> 16] << 16 | self._votes & 0xFFFF
        self._keys = np.concatenate([self._keys, keys[first]])[order]
        self._points = np.concatenate([self._points, points[first]])[order]
        labels = ids[seen].astype(np.int64)
        voted = labels > 0
        self._vote(np.searchsorted(self._keys, keys[voted]) << 16 | labels[voted], np.ones(voted.sum()))

    def _keys_of(self, points: np.ndarray) -> np.ndarray:
        cells = np.floor(points / self.size).astype(np.int64) + _OFFSET
        return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]

    def merge(self, kept: int, dropped: int) -> None:
        ids = self._votes & 0xFFFF
        votes, weights = self._votes - ids + np.where(ids == dropped, kept, ids), self._weights
        self._votes, self._weights = np.zeros(0, np.int64), np.zeros(0)
        self._vote(votes, weights)

    def split(self, frame: Frame, ids: np.ndarray, whole: int, part: int) -> None:
        """Takes back the votes for `whole` where `ids` has `part`."""
        points = world_points(frame)[(ids == part)[frame.depth > 0]]
        voxels = np.searchsorted(self._keys, np.intersect1d(self._keys_of(points), self._keys))
        void = np.isin(self._votes, voxels << 16 | whole)
        self._votes, self._weights = self._votes[~void], self._weights[~void]

    def _vote(self, votes: np.ndarray, weights: np.ndarray) -> None:
        self._votes, place = np.unique(np.concatenate([self._votes, votes]), return_inverse=True)
        self._weights = np.bincount(place, np.concatenate([self._weights, weights]), len(self._votes))

    def labels(self) -> tuple[np.ndarray, np.ndarray]:
        """Heaviest id of each voxel (0: no vote) and its share of the votes."""
        ids, share = np.zeros(len(self._keys), np.uint16), np.zeros(len(self._keys), np.float32)
        voxels = self._votes >> 16
        total = np.bincount(voxels, self._weights, len(self._keys))
        order = np.argsort(self._weights, kind="stable")
        ids[voxels[order]] = self._votes[order] & 0xFFFF
        share[voxels[order]] = self._weights[order] / total[voxels[order]]
        return ids, share

    def look_up(self, frame: Frame) -> np.ndarray:
        """Labels of the voxels that a frame's pixels fall into, uint16 [H, W]; 0 where there is none."""
        keys = self._keys_of(world_points(frame))
        place = np.searchsorted(self._keys, keys).clip(0, max(len(self._keys) - 1, 0))
        image = np.zeros(frame.depth.shape, np.uint16)
        image[frame.depth > 0] = np.where(self._keys[place] == keys, self.labels()[0][place], 0)
        return image

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> MapView:
        """What the map shows, nearest voxel first, each drawn as a square of its size."""
        ids, share = self.labels()
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        p = (self._points - t) @ R
        p, ids, share = p[p[:, 2] > 0.05], ids[p[:, 2] > 0.05], share[p[:, 2] > 0.05]
        order = np.argsort(-p[:, 2])  # far to near
        p, ids, share = p[order], ids[order], share[order]
        u = np.rint(camera.fx * p[:, 0] / p[:, 2] + camera.cx).astype(int)
        v = np.rint(camera.fy * p[:, 1] / p[:, 2] + camera.cy).astype(int)
        radius = np.minimum(np.ceil(0.55 * self.size * camera.fx / p[:, 2]), 8).astype(int)
        number = np.full((camera.height, camera.width), -1)
        depth = np.full((camera.height, camera.width), np.inf)
        reach = range(-radius.max(initial=0), radius.max(initial=0) + 1)
        for dy, dx in sorted(((dy, dx) for dy in reach for dx in reach), key=lambda d: d[0] ** 2 + d[1] ** 2):
            x, y = u + dx, v + dy
            drawn = (max(abs(dx), abs(dy)) <= radius) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
            k = np.flatnonzero(drawn)
            layer = np.full(number.shape, -1)
            layer[y[k], x[k]] = k  # far to near: the nearest is written last
            # Squares close gaps; they do not widen an object over the surface that it stands on.
            closer = (layer >= 0) & (p[layer, 2] < depth - (2 * self.size if dx or dy else 0))
            number[closer], depth[closer] = layer[closer], p[layer[closer], 2]
        shown = number >= 0
        view = MapView(*(np.zeros(number.shape, kind) for kind in (np.uint16, np.float32, np.float32)))
        for image, values in ((view.ids, ids), (view.confidence, share), (view.depth, p[:, 2])):
            image[shown] = values[number[shown]]
        return view


def world_points(frame: Frame) -> np.ndarray:
    """The pixels with depth as points in the world, float64 [n, 3]."""
    T = frame.T_world_camera
    assert T is not None
    return frame.camera.back_project(frame.depth)[frame.depth > 0] @ T[:3, :3].T + T[:3, 3]


def scramble(mask: np.ndarray, rng: np.random.Generator, split: float = 0.2, drop: float = 0.05,
             dots: float = 0.01, merge: bool = False, max_id: int = 400) -> np.ndarray:  # fmt: skip
    """A mask as a segmenter without memory might give it: new ids, segments split by a line through their centroid or
    dropped, dots of noise; with `merge` all segments are joined in random pairs."""
    out = np.zeros_like(mask)
    ids = np.unique(mask[mask > 0])
    fresh: list[int] = (1 + rng.permutation(max_id + 2 * len(ids))[: 2 * len(ids)]).tolist()
    rows, columns = np.arange(mask.shape[0])[:, None], np.arange(mask.shape[1])[None, :]
    groups = np.array_split(rng.permutation(ids), max(1, (len(ids) + 1) // 2 if merge else len(ids)))
    for group in groups:
        inside = np.isin(mask, group)
        if rng.random() < drop:
            fresh.pop()
            continue
        out[inside] = fresh.pop()
        if rng.random() < split:
            angle = rng.uniform(0, np.pi)
            along = columns * np.cos(angle) + rows * np.sin(angle)
            side = along > along[inside].mean()
            out[inside & side] = fresh.pop()
    noisy = rng.random(mask.shape) < dots
    out[noisy] = rng.integers(0, max_id, noisy.sum())
    return out


def assigned_iou(predicted: np.ndarray, true: np.ndarray) -> dict[int, float]:
    """IoU of each true id after the best one-to-one assignment of predicted ids; 0 for what is missing."""
    from scipy.optimize import linear_sum_assignment

    true_ids, t = np.unique(true, return_inverse=True)
    ids, p = np.unique(predicted, return_inverse=True)
    n = np.bincount(t.ravel() * len(ids) + p.ravel(), minlength=len(ids) * len(true_ids)).reshape(len(true_ids), -1)
    iou = n / (n.sum(1, keepdims=True) + n.sum(0) - n)
    iou[:, ids == 0], iou[true_ids == 0] = 0, 0
    rows, columns = linear_sum_assignment(-iou)
    found = dict(zip(rows, columns, strict=True))
    return {int(i): float(iou[k, found[k]]) if k in found else 0.0 for k, i in enumerate(true_ids) if i > 0}
