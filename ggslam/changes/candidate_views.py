# SPDX-License-Identifier: Apache-2.0
"""How a thing, moved, agrees with the pictures that the other visit took of it: its faces lie where they were measured,
nobody saw them from behind, and nothing of it reaches beyond its outline."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.sightings import AROUND, Picture, back_project
from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.scene.poses import transform_points
from ggslam.sight.margin import Margin
from ggslam.system.tuning import Tuning


class CandidateViewTuning(Tuning):
    """Which pixels of a candidate are compared."""

    min_pixels = 12
    """Fewest pixels of the candidate in a picture."""
    max_views = 24
    """Most pictures that are compared."""
    own_m = 0.015
    """Largest distance of a pixel from the candidate's points, in metres."""
    window = 3
    """Pixels that are searched on each side of its points."""
    min_facing = 0.35
    """Smallest cosine between a face's normal and the direction to the camera: maps err at grazing angles."""
    near_m = 0.1
    """Depth from which points are looked up, in metres."""
    min_thickness_m = 0.01
    """Smallest distance between the two faces of a board, in metres."""
    edge_px = 0.75
    """Pixels beyond the outermost pixel's centre that still belong to the candidate."""


_HIDDEN = Margin(0.015, 0.008)
"""What was measured nearer than a point by more hides it."""


@dataclass(frozen=True)
class Residuals:
    """How far points are from where pictures have them.

    Attributes:
        off: float64 [m], metres.
        along: float64 [m, 3], which way a point has to go for that to grow fastest; world.
        points: float64 [m, 3], world.
    """

    off: np.ndarray
    along: np.ndarray
    points: np.ndarray


class CandidateViews:
    """A thing in the pictures of a visit.

    Args:
        pictures: of the visit.
        tree: of all points that the visit's pictures show.
        rows: int [n], those that are the thing's.
        ids: of the thing, if it is an object of the visit's map.
    """

    def __init__(self, pictures: list[Picture], tree: cKDTree, rows: np.ndarray, ids: tuple[int, ...]) -> None:
        is_own = np.zeros(tree.n, bool)
        is_own[rows] = True
        points = tree.data[rows]
        masks = [_own_pixels(picture, tree, is_own, points, ids) for picture in pictures]
        shown = np.flatnonzero([mask.sum() >= CandidateViewTuning.min_pixels for mask in masks])
        some = np.unique(np.linspace(0, max(0, len(shown) - 1), CandidateViewTuning.max_views).round().astype(int))
        chosen = [(pictures[k], masks[k]) for k in shown[some[some < len(shown)]]]
        self._poses = np.array([picture.T_camera_world for picture, _ in chosen]).reshape(-1, 4, 4)
        cameras = [picture.camera for picture, _ in chosen]
        self._lens = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras]).reshape(-1, 4)
        self._sizes = np.array([[c.width, c.height] for c in cameras], int).reshape(-1, 2)
        self._first = np.cumsum(self._sizes.prod(1)) - self._sizes.prod(1)
        """Where each picture's pixels begin in the arrays that follow."""
        outlines = [_outline(mask) for _, mask in chosen]
        self._depth = _row([picture.depth for picture, _ in chosen])
        self._own = _row([mask for _, mask in chosen])
        self._beyond = _row([beyond for beyond, _ in outlines])
        self._outward = np.concatenate([way.reshape(-1, 2) for _, way in outlines] or [np.zeros((0, 2))])

    def __len__(self) -> int:
        return len(self._poses)

    def residuals(self, shape: ColoredSurface) -> Residuals:
        """Of a surface, in the world of the pictures: each of its points in each of them that tells anything of it."""
        R, t = self._poses[:, :3, :3], self._poses[:, :3, 3]
        p, n = shape.points @ R.transpose(0, 2, 1) + t[:, None], shape.normals @ R.transpose(0, 2, 1)
        fx, fy, cx, cy = (self._lens[:, k, None] for k in range(4))
        ahead = np.where(p[..., 2] > CandidateViewTuning.near_m, p[..., 2], np.inf)
        u, v = p[..., 0] / ahead * fx + cx, p[..., 1] / ahead * fy + cy
        column, row = np.rint(u), np.rint(v)
        width, height = self._sizes[:, :1], self._sizes[:, 1:]
        view, point = np.nonzero(
            np.isfinite(ahead) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        )  # fmt: skip
        pixel = (self._first[:, None] + row * width + column)[view, point].astype(np.int64)
        p, n, u, v, column, row = (values[view, point] for values in (p, n, u, v, column, row))
        depth, own, lens = self._depth[pixel], self._own[pixel], self._lens[view]
        seen = np.stack([(column - lens[:, 2]) / lens[:, 0], (row - lens[:, 3]) / lens[:, 1], np.ones(len(row))], 1)
        before = (n * (p - depth[:, None] * seen)).sum(1)  # of the surface that was measured, along the point's normal
        facing = -(n * p).sum(1) / np.linalg.norm(p, axis=1)
        hidden = depth <= p[:, 2] - _HIDDEN(p[:, 2])
        front, back = own & (facing > CandidateViewTuning.min_facing), own & (facing < -CandidateViewTuning.min_facing)
        outside = (depth > 0) & ~own & ~hidden
        out = self._outward[pixel]
        beyond = self._beyond[pixel] + out[:, 0] * (u - column) + out[:, 1] * (v - row) - CandidateViewTuning.edge_px
        off = np.where(front, before, np.where(back, np.maximum(0, CandidateViewTuning.min_thickness_m - before), 0.0))
        off[outside] = (np.maximum(0, beyond) * p[:, 2] / lens[:, 0])[outside]
        sideways = np.concatenate([out, -(out * p[:, :2]).sum(1, keepdims=True) / p[:, 2:]], 1)
        along = np.where(front[:, None], n, np.where(back[:, None], -n, sideways))
        told = front | back | outside
        along = np.einsum("ni,nij->nj", along[told], R[view[told]])
        return Residuals(off[told], along, shape.points[point[told]])


def _own_pixels(
    picture: Picture, tree: cKDTree, is_own: np.ndarray, points: np.ndarray, ids: tuple[int, ...]
) -> np.ndarray:
    """bool [H, W], where a picture shows a thing with these points."""
    own, shape = np.zeros(picture.depth.shape, bool), picture.depth.shape
    row, column, inside = picture.camera.project(transform_points(points, picture.T_camera_world))
    row, column = row[inside], column[inside]
    if not len(row):
        return own
    window = tuple(
        slice(max(0, k.min() - CandidateViewTuning.window), k.max() + CandidateViewTuning.window + 1)
        for k in (row, column)
    )
    where = np.zeros(shape, bool)
    where[window] = picture.depth[window] > 0
    around = back_project(picture, where)
    near = (
        (around > points.min(0) - CandidateViewTuning.own_m) & (around < points.max(0) + CandidateViewTuning.own_m)
    ).all(1)
    apart, nearest = tree.query(around[near], distance_upper_bound=CandidateViewTuning.own_m)
    same = np.isfinite(apart)
    same[same] = is_own[nearest[same]]
    at = np.flatnonzero(where)[near][same]
    own.reshape(-1)[at] = True
    # Surfaces have no points where pictures have outlines: what belongs to the object there is added.
    return own | ((cv2.dilate(own.astype(np.uint8), AROUND) > 0) & np.isin(picture.labels, ids))


def _outline(own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [H, W] that each pixel lies beyond the thing's nearest, and how they grow along columns and rows
    [H, W, 2]."""
    beyond = cv2.distanceTransform((~own).astype(np.uint8), cv2.DIST_L2, 5)
    ways = [cv2.Sobel(beyond, cv2.CV_32F, x, 1 - x, ksize=3) / 8 for x in (1, 0)]
    return beyond, np.stack(ways, 2)


def _row(pictures: list[np.ndarray]) -> np.ndarray:
    """All pixels of pictures [H, W], one after the other."""
    return np.concatenate([picture.reshape(-1) for picture in pictures] or [np.zeros(0)])
