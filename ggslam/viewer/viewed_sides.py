# SPDX-License-Identifier: Apache-2.0
"""From where a recording saw each Gaussian: what a page needs to leave out what nobody ever saw.

Training never saw the back of a wall, nor how long a Gaussian is along the ray on which all views looked at it. A page
fades what is looked at from behind, and shortens what is looked at from aside.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gaussians
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, quaternion_to_matrix
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight, View
from ggslam.system.tuning import Tuning


class ViewedSidesTuning(Tuning):
    """How the views of Gaussians are found."""

    views = 64
    """Most views that are asked, evenly spread over the recording."""
    width = 160
    """Width of their depth images, in pixels."""
    margin = Margin(least=0.1, share=0.03)
    """A Gaussian so far behind the surface still belongs to it."""
    nearest_m = 0.05
    """Distance that byte 1 means, in metres."""
    step = 1.03
    """Each further byte means a distance so many times as far, so that 255 is 93 m."""
    reach = 2
    """Normals are taken from pixels so far to all sides."""
    gap = 0.15
    """A surface ends where depth about a pixel differs by this share."""
    flatness = 0.5
    """Largest ratio of the size of a Gaussian along the normal to its greatest size."""
    agreement = 0.85
    """Length of the mean normal above which it is what a Gaussian faces; else it is the mean direction of its views."""


def viewed_sides(gaussians: Gaussians, rows: np.ndarray, camera: Camera, poses: Sequence[np.ndarray]) -> np.ndarray:
    """The direction that each Gaussian faces, the cone about it that holds all views that saw it, and how near they
    came.

    Args:
        gaussians: the map.
        rows: int [N], which of them.
        camera: of the views.
        poses: T_world_camera [4, 4] of each view; some are chosen, see `ViewedSidesTuning`.

    Returns:
        uint8 [N, 4]: two of the direction on an octahedron (`octahedron_to_unit`), angle of the cone in 255ths of pi,
        and the distance (`ViewedSidesTuning.nearest_m`). What no view saw counts as seen from the nearest one. All
        are 0 if there are no views.
    """
    means = gaussians.means.numpy()[rows].astype(np.float64)
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), ViewedSidesTuning.views)).round().astype(int))
    found = np.zeros((len(means), 4), np.uint8)
    if not len(chosen) or not len(means):
        return found
    eyes = np.stack([poses[i][:3, 3] for i in chosen])
    seen, normals = _look_at(gaussians, means, camera, [poses[i] for i in chosen])
    _guess_unseen(seen, means, eyes)
    total, nearest, cosine = np.zeros_like(means), np.full(len(means), np.inf), np.ones(len(means))
    for eye, mask in zip(eyes, seen, strict=True):
        direction, distance = _towards(eye, means[mask])
        total[mask] += direction
        nearest[mask] = np.minimum(nearest[mask], distance)
    lies = (_length(normals) > ViewedSidesTuning.agreement) & _lies_along(gaussians, rows, _unit(normals))
    facing = _unit(np.where(lies, normals, total))
    for eye, mask in zip(eyes, seen, strict=True):
        direction, _ = _towards(eye, means[mask])
        cosine[mask] = np.minimum(cosine[mask], (direction * facing[mask]).sum(axis=1))
    found[:, :2] = unit_to_octahedron(facing)
    found[:, 2] = np.ceil(255 / np.pi * np.arccos(np.clip(cosine, -1, 1)))
    steps = np.log(nearest / ViewedSidesTuning.nearest_m) / np.log(ViewedSidesTuning.step)
    found[:, 3] = np.clip(np.floor(steps) + 1, 1, 255)
    return found


class KnownSides:
    """Sides of a map as it was recorded, for what is left of it after edits.

    Args:
        gaussians, camera, poses: as of `viewed_sides`.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, poses: Sequence[np.ndarray]) -> None:
        rows = np.arange(len(gaussians.means))
        keys = _place_keys(gaussians, rows)
        order = np.argsort(keys)
        self._keys, self._sides = keys[order], viewed_sides(gaussians, rows, camera, poses)[order]

    def find(self, gaussians: Gaussians, rows: np.ndarray) -> np.ndarray:
        """uint8 [N, 4] of rows of an edited map; 0 for what is where nothing was, which no view saw there."""
        keys = _place_keys(gaussians, rows)
        at = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        if not len(self._keys):
            return np.zeros((len(rows), 4), np.uint8)
        return np.where((self._keys[at] == keys)[:, None], self._sides[at], np.uint8(0))


def _place_keys(gaussians: Gaussians, rows: np.ndarray) -> np.ndarray:
    """uint64 [N] that differ where means do, to all that matters."""
    bits = np.ascontiguousarray(gaussians.means.numpy()[rows], np.float32).view(np.uint32).astype(np.uint64)
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    return np.asarray((bits * factors).sum(axis=1, dtype=np.uint64))


def _look_at(
    gaussians: Gaussians, means: np.ndarray, camera: Camera, poses: list[np.ndarray]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Which places [N, 3] each view sees, bool [N]: in its image, and not hidden by what it shows. And the mean normals
    [N, 3] of the surfaces that the views show there: shorter than 1 where they disagree, 0 where none is known."""
    small = camera.resize(
        ViewedSidesTuning.width, max(1, round(camera.height * ViewedSidesTuning.width / camera.width))
    )
    rasterizer, found = CpuRasterizer(), []
    normals, count = np.zeros_like(means), np.zeros((len(means), 1))
    for pose in poses:
        buffers = rasterizer.forward(gaussians, small, inverse(pose), features=False)
        depth = np.where(buffers.alpha.numpy() > 0.5, buffers.expected_depth.numpy(), 0).astype(np.float32)
        view = View.of(depth, small, pose, ViewedSidesTuning.margin, rasterizer.context)
        answers = view.classify_points(means)
        found.append((answers.codes != Sight.OUTSIDE) & (answers.codes != Sight.HIDDEN))
        shown = np.where(answers.same[:, None], answers.at(_normals_of(view)), 0)
        normals += shown
        count += np.any(shown != 0, axis=1, keepdims=True)
    return found, normals / np.maximum(count, 1)


def _normals_of(view: View) -> np.ndarray:
    """Unit normals [H, W, 3] of what a view shows, towards it; 0 beside outlines and where depth is unknown."""
    points, reach = view.points().reshape(*view.depth.shape, 3), ViewedSidesTuning.reach
    found = np.zeros_like(points)
    if min(view.depth.shape) <= 2 * reach:
        return found
    inner = (slice(reach, -reach), slice(reach, -reach))
    across = points[reach:-reach, 2 * reach :] - points[reach:-reach, : -2 * reach]
    down = points[2 * reach :, reach:-reach] - points[: -2 * reach, reach:-reach]
    normal = _unit(np.cross(across, down))
    normal *= np.where((normal * (view.T_world_camera[:3, 3] - points[inner])).sum(axis=2, keepdims=True) < 0, -1, 1)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    near, far = cv2.erode(view.depth, window), cv2.dilate(view.depth, window)
    whole = (near > 0) & (far - near < ViewedSidesTuning.gap * far)
    found[inner] = np.where(whole[inner][..., None], normal, 0)
    return found


def _lies_along(gaussians: Gaussians, rows: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """bool [N, 1]: a Gaussian does not stand out of the surface of that normal [N, 3]."""
    scales = np.exp(gaussians.log_scales.numpy()[rows].astype(np.float64))
    axes = quaternion_to_matrix(gaussians.quaternions.numpy()[rows].astype(np.float64))
    out = _length(np.einsum("nji,nj->ni", axes, normals) * scales)
    return out <= ViewedSidesTuning.flatness * scales.max(axis=1, keepdims=True)


def _guess_unseen(seen: list[np.ndarray], means: np.ndarray, eyes: np.ndarray) -> None:
    """Lets the nearest view see what none did: large Gaussians beside all images, and what surfaces hide."""
    unseen = np.flatnonzero(~np.any(seen, axis=0))
    nearest = cKDTree(eyes).query(means[unseen])[1]
    for view, mask in enumerate(seen):
        mask[unseen[nearest == view]] = True


def _towards(eye: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [N, 3] from points to a place [3], and distances [N]."""
    offsets = eye - points
    distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-6)
    return offsets / distance[:, None], distance


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(vectors, axis=-1, keepdims=True))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length 1, and 0 for those of none."""
    length = _length(vectors)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-9)


def unit_to_octahedron(directions: np.ndarray) -> np.ndarray:
    """uint8 [N, 2] of unit vectors [N, 3]: the sphere as an octahedron that is unfolded to a square (Cigolle et al.
    2014); off by 1.1 degrees at most."""
    x, y, z = (directions / np.maximum(np.abs(directions).sum(axis=1, keepdims=True), 1e-12)).T
    folded = [np.where(z < 0, (1 - np.abs(b)) * np.where(a < 0, -1, 1), a) for a, b in ((x, y), (y, x))]
    return np.rint(127.5 * (np.stack(folded, axis=1) + 1)).clip(0, 255).astype(np.uint8)


def octahedron_to_unit(codes: np.ndarray) -> np.ndarray:
    """Unit vectors float64 [N, 3] of `unit_to_octahedron`."""
    x, y = (codes.astype(np.float64) / 127.5 - 1).T
    z = 1 - np.abs(x) - np.abs(y)
    under = np.maximum(-z, 0)
    found = np.stack([x - np.copysign(under, x), y - np.copysign(under, y), z], axis=1)
    return found / np.linalg.norm(found, axis=1, keepdims=True)
