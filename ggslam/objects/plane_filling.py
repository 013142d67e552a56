# SPDX-License-Identifier: Apache-2.0
"""Continues a plane into a hole: the plane's picture seen from the front, with the hole painted in from its rim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.objects.hole_views import HoleView, could_be_hidden, is_open
from ggslam.objects.rim_planes import RimPlane
from ggslam.objects.texture import fill_gap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import rgb_to_sh
from ggslam.scene.poses import inverse, matrix_to_quaternion
from ggslam.system.tuning import Tuning


class PlaneFillingTuning(Tuning):
    """How a plane is continued into a hole."""

    max_chart = 360
    """Most cells along a side of a plane's picture."""
    enclosed = 6
    """Fewest of eight directions along the plane that meet known surface or another plane."""
    known = 5
    """Fewest of them that meet known surface."""
    occupied = 0.7
    """Alpha from which a cell is known."""
    below = 0.4
    """Cells by which the new surface lies under the old one, which covers it where they overlap."""
    margin = 4
    """Cells along the rim of the hole that are not copied from."""
    outline = 9
    """Width of the square that the object's pixels grow by, in pixels."""
    rare = 4.0
    """Distance of a rare colour from the median colour, in median distances..."""
    min_rare = 0.08
    """...and at least this, in [0, 1]."""


@dataclass(frozen=True)
class Chart:
    """Square cells on a plane; rows run along `axes[1]`, columns along `axes[0]`.

    Attributes:
        origin: centre of cell (0, 0), [3].
        axes: unit vectors [3, 3]: along columns, along rows, and the plane's normal.
        cell: metres.
        color: float32 [H, W, 3] of the known surface.
        clean: bool [H, W], cells whose colour is the surface's own.
        known: bool [H, W], cells that the map's surface covers, or something that stands on it or juts out of it.
    """

    origin: np.ndarray
    axes: np.ndarray
    cell: float
    color: np.ndarray
    clean: np.ndarray
    known: np.ndarray

    def centres(self) -> np.ndarray:
        """World points [H * W, 3]."""
        rows, columns = self.known.shape
        u, v = np.meshgrid(np.arange(columns) * self.cell, np.arange(rows) * self.cell)
        return self.origin + u.reshape(-1, 1) * self.axes[0] + v.reshape(-1, 1) * self.axes[1]


def make_chart(plane: RimPlane, kept: Gaussians, cell: float) -> Chart | None:
    """The plane's surface around the hole as the map has it; None if the map has none there."""
    helper = np.eye(3)[np.abs(plane.normal).argmin()]
    first = np.cross(helper, plane.normal)
    first /= np.linalg.norm(first)
    second = np.cross(first, plane.normal)  # first x second = -normal, the direction a camera in front looks in
    flat = plane.points @ np.stack([first, second], 1)
    low, high = np.percentile(flat, [0.5, 99.5], axis=0)
    cell = max(cell, float((high - low).max()) / PlaneFillingTuning.max_chart)
    columns, rows = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    means = kept.means.numpy()
    flat = means @ np.stack([first, second], 1)
    inside = ((flat > low - 3 * cell) & (flat < high + 3 * cell)).all(1)
    distance = np.abs(plane.distance(means))
    on, around = inside & (distance <= plane.tolerance), inside & (distance <= 2 * plane.tolerance)
    if not on.any():
        return None
    axes = np.stack([first, second, plane.normal])
    origin = low[0] * first + low[1] * second + plane.offset * plane.normal
    color, alpha = _front_view(kept, on, origin, axes, cell, rows, columns)
    _, covered = _front_view(kept, around, origin, axes, cell, rows, columns)
    return Chart(origin, axes, cell, color, alpha > PlaneFillingTuning.occupied, covered > PlaneFillingTuning.occupied)


def _front_view(
    kept: Gaussians, on: np.ndarray, origin: np.ndarray, axes: np.ndarray, cell: float, rows: int, columns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Colour [H, W, 3] and alpha [H, W] of some Gaussians seen from far in front of a plane, a pixel a cell."""
    height = 8 * cell * max(rows, columns)  # so far away that rays are nearly parallel
    camera = Camera(columns, rows, height / cell, height / cell, (columns - 1) / 2, (rows - 1) / 2)
    centre = origin + cell * ((columns - 1) / 2 * axes[0] + (rows - 1) / 2 * axes[1])
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([axes[0], axes[1], -axes[2]], 1)
    T_world_camera[:3, 3] = centre + height * axes[2]
    index = torch.from_numpy(np.flatnonzero(on))
    part = GaussianTensors(**{name: getattr(kept, name)[index] for name in PARAMETERS})
    out = CpuRasterizer().forward(part, camera, inverse(T_world_camera), features=False)
    alpha = out.alpha.numpy()
    return (out.image.numpy() / np.maximum(alpha, 1e-3)).transpose(1, 2, 0).clip(0, 1), alpha.copy()


def find_hole(chart: Chart, views: Sequence[HoleView], others: Sequence[RimPlane]) -> np.ndarray:
    """Cells to fill, bool [H, W]: not known, possibly surface that was never seen, and enclosed by known surface or by
    the planes that this one runs into. Each connected part of them is open in some view: elsewhere the map has surface
    that is merely thin seen from the front.

    Args:
        chart: the plane.
        views: of the hole.
        others: the other planes of the rim.
    """
    centres = chart.centres()
    ends = np.zeros(len(centres), bool)
    for other in others:
        ends |= other.is_met(centres, 4 * chart.cell)
    stops = chart.known | ends.reshape(chart.known.shape)
    gaps = could_be_hidden(centres, views).reshape(chart.known.shape) & ~chart.known
    gaps &= (_directions(stops, gaps) >= PlaneFillingTuning.enclosed) & (
        _directions(chart.known, gaps) >= PlaneFillingTuning.known
    )
    part = cv2.connectedComponents(gaps.astype(np.uint8))[1]
    return gaps & np.isin(part, part[gaps & is_open(centres, views).reshape(gaps.shape)])


def _directions(stops: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """In how many of eight directions each gap cell meets a stop across gap cells alone, int [H, W]."""
    hits = np.zeros(stops.shape, int)
    for turn in range(4):
        for diagonal in (False, True):
            hits += np.rot90(_meets(np.rot90(stops, turn), np.rot90(gaps, turn), diagonal), -turn)
    return hits


def _meets(stops: np.ndarray, gap: np.ndarray, diagonal: bool) -> np.ndarray:
    """Whether going up (or up and left) from each gap cell through gap cells meets a stop, bool [H, W]."""
    met = stops.copy()
    for row in range(1, len(stops)):
        above = met[row - 1]
        if diagonal:
            above = np.concatenate([[False], above[:-1]])
        met[row] |= gap[row] & above
    return met


def paint(chart: Chart, hole: np.ndarray, margin: int = PlaneFillingTuning.margin) -> np.ndarray:
    """Colours of the hole's cells [M, 3], from the known cells around it.

    Args:
        chart: the plane.
        hole: bool [H, W].
        margin: cells along the hole's rim that may still bear traces of the object and are not copied from.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    beside = chart.clean & ~(cv2.dilate(hole.astype(np.uint8), disc) > 0)
    usual = beside & usual_colors(chart.color, beside)
    source = next((cells for cells in (usual, beside) if cells.any()), chart.clean)
    return fill_gap(chart.color, source, hole)


def usual_colors(color: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Where a picture [H, W, 3] has no colour that is rare `among` some of its pixels (bool [H, W]): shadows, and
    outlines of things that stand there, are rare. bool [H, W]"""
    if not among.any():
        return among
    middle = np.median(color[among], axis=0)
    spread = np.median(np.abs(color[among] - middle), axis=0)
    return (np.abs(color - middle) <= np.maximum(PlaneFillingTuning.rare * spread, PlaneFillingTuning.min_rare)).all(2)


def as_seen(chart: Chart, views: Sequence[HoleView]) -> Chart:
    """The chart with its colours as the views show them, each cell's from the view that shows it largest. Clean are
    then the cells that some view shows, a few pixels off the object: there pixels mix with those of its outline.

    From the front, from where nobody looked while the map was trained, Gaussians that are thin and half transparent
    add up to other colours.
    """
    centres, color = chart.centres(), chart.color.reshape(-1, 3).copy()
    largest = np.zeros(len(centres))
    for v in views:
        now = v.sight_now.classify_points(centres)
        covered = (
            cv2.dilate(
                v.covered.astype(np.uint8), np.ones((PlaneFillingTuning.outline, PlaneFillingTuning.outline), np.uint8)
            )
            > 0
        )
        shown = now.same & ~now.at(covered)
        slant = np.abs((centres - v.view.position) @ chart.axes[2]) / np.maximum(now.z, 1e-3) ** 3
        better = shown & (slant > largest)
        color[better], largest[better] = now.at(v.picture)[better], slant[better]
    seen = cv2.erode((largest > 0).reshape(chart.known.shape).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return replace(chart, color=color.reshape(chart.color.shape), clean=seen if seen.any() else chart.clean)


def widen_hole(hole: np.ndarray) -> np.ndarray:
    """The hole and one cell around it, so that no gap stays along its rim. bool [H, W]."""
    return cv2.dilate(hole.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def cover(chart: Chart, hole: np.ndarray, colors: np.ndarray, plane: RimPlane) -> GaussianTensors:
    """Opaque discs over the hole's cells, at the height over the plane that its surroundings have."""
    centres = chart.centres()[hole.reshape(-1)]
    distance, index = cKDTree(plane.points).query(centres, k=min(16, len(plane.points)))
    weights = 1 / np.maximum(distance.reshape(len(centres), -1), chart.cell)
    heights = plane.distance(plane.points)[index].reshape(weights.shape)
    height = (weights * heights).sum(1) / weights.sum(1) - PlaneFillingTuning.below * chart.cell
    return discs(centres + height[:, None] * chart.axes[2], chart.axes, np.full(len(centres), chart.cell), colors)


def discs(means: np.ndarray, axes: np.ndarray, spacing: np.ndarray, colors: np.ndarray) -> GaussianTensors:
    """Flat opaque Gaussians that close a surface sampled at `spacing` [M]; without features.

    Args:
        means: [M, 3].
        axes: unit vectors [3, 3] as rows, the last one across the surface.
        spacing: metres.
        colors: [M, 3] in [0, 1].
    """
    rotation = axes.T if np.linalg.det(axes) > 0 else np.stack([axes[0], -axes[1], axes[2]], 1)
    scales = np.log(np.asarray(spacing)[:, None] * np.array([0.65, 0.65, 0.2]))
    count = len(means)
    return GaussianTensors(
        means=torch.from_numpy(means.astype(np.float32)),
        quaternions=torch.from_numpy(matrix_to_quaternion(rotation).astype(np.float32)).repeat(count, 1),
        log_scales=torch.from_numpy(scales.astype(np.float32)),
        opacity_logits=torch.full((count,), 3.0),
        sh=rgb_to_sh(torch.from_numpy(np.asarray(colors, np.float32)))[:, None],
        features=torch.zeros(count, 0),
    )
