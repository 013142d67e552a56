# SPDX-License-Identifier: Apache-2.0
"""Passes over the pixels of a depth image that falls into segments, done by the compiled core in the calling thread."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.abi import core
from ggslam.abi.arrays import address
from ggslam.errors import InputError
from ggslam.native.loader import load_library
from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.settings import GeometricSettings

Links = tuple[np.ndarray, np.ndarray]
"""bool [H, W-1] and [H-1, W], of each pixel and its right and its lower neighbour."""


def link_surfaces(surface: DepthSurface, rest: np.ndarray, settings: GeometricSettings) -> tuple[Links, Links]:
    """Which neighbours are on one surface, and which of the pixels `rest` (bool [H, W]) also smoothly.

    Neighbours are on one surface if their depths differ by less than the gap that separates surfaces, or if either,
    continued from the pixel beyond it, meets the other: seen at a flat angle, a table top or a floor falls off by
    centimetres from row to row, but straight in inverse depth. Smooth are those of them without a concave edge, which
    is looked at across a few pixels, where the edge itself does not blur the normals.
    """
    rest = np.ascontiguousarray(rest, bool)
    closed, smooth = _empty_links(rest.shape), _empty_links(rest.shape)
    job = core.SurfaceLinksJob(
        _surface(surface, settings), address(rest), _edge_cosine(settings), _links(closed), _links(smooth)
    )
    load_library().ggslam_surface_links(ctypes.byref(job))
    return closed, smooth


def connected_pieces(segments: np.ndarray, connected: Links | None = None) -> np.ndarray:
    """Numbers the 4-connected pieces of equal id, int32 [H, W] from 1 on in raster order; id 0 is an id like others.

    Args:
        segments: [H, W] of any integer type.
        connected: whether a pixel belongs with its right and its lower neighbour; default: if their ids are equal.
    """
    height, width = segments.shape
    pieces = np.empty((height, width), np.int32)
    ids = np.ascontiguousarray(segments, np.int32) if connected is None else None
    kept = _empty_links(segments.shape) if connected is None else _contiguous(connected)
    job = core.PiecesJob(address(ids), _links(kept), height, width, address(pieces))
    load_library().ggslam_connected_pieces(ctypes.byref(job))
    return pieces


def grow_regions(regions: np.ndarray, valid: np.ndarray, closed: Links, passes: int) -> np.ndarray:
    """Regions (int32 [H, W], 0 = none) grown over valid pixels without region, one pixel a pass, where neighbours are
    on one surface (`closed`)."""
    grown, free, kept = np.array(regions, np.int32, order="C"), np.ascontiguousarray(valid, bool), _contiguous(closed)
    job = core.GrowthJob(address(grown), address(free), _links(kept), *regions.shape, passes)
    load_library().ggslam_grow_regions(ctypes.byref(job))
    return grown


def claim_planes(
    surface: DepthSurface, rays: np.ndarray, planes: np.ndarray, least_cosine: float, settings: GeometricSettings
) -> np.ndarray:
    """The nearest plane that each pixel lies on and has the normal of: int32 [H, W], from 1 on, 0 = none.

    Args:
        rays: float32 [H, W, 3], of the camera.
        planes: float32 [P, 3], vectors w with 1/z = w . ray.
        least_cosine: between the normals of pixel and plane.
    """
    label = np.empty(surface.valid.shape, np.int32)
    x, y = (np.ascontiguousarray(values) for values in (rays[0, :, 0], rays[:, 0, 1]))
    planes = np.ascontiguousarray(planes, np.float32)
    job = core.PlaneClaimJob(
        _surface(surface, settings), address(x), address(y), address(planes), len(planes),
        settings.tolerance_sigmas * surface.sigma, settings.tolerance_m, least_cosine, address(label),
    )  # fmt: skip
    load_library().ggslam_claim_planes(ctypes.byref(job))
    return label


def share_near_planes(
    points: np.ndarray, regions: np.ndarray, asked: list[tuple[int, np.ndarray]], limit: float
) -> np.ndarray:
    """Share of a region's points that lie nearer than `limit` metres to a plane: float64 [n], one for each that is
    asked: number of the region and n / d of the plane n . x = d.

    Args:
        points: float32 [H, W, 3], metres.
        regions: int32 [H, W], from 0 on.
    """
    rows = (core.RegionOnPlane * len(asked))()
    for row, (region, plane) in zip(rows, asked, strict=True):
        row.region, row.plane[:] = region, plane.tolist()
    points, regions = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(regions, np.int32)
    job = core.RegionsOnPlanesJob(
        address(points), address(regions), regions.size, int(regions.max(initial=0)) + 1, limit,
        ctypes.addressof(rows), len(asked),
    )  # fmt: skip
    load_library().ggslam_regions_on_planes(ctypes.byref(job))
    return np.array([row.near_by / max(row.points, 1) for row in rows])


@dataclass(frozen=True)
class Bodies:
    """Per region: pixels, centre float64 [n, 3], radius (root mean square, metres) and how concave it is, -1 to 1."""

    count: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    bend: np.ndarray


def find_bodies(regions: np.ndarray, surface: DepthSurface) -> Bodies:
    """Where regions are (int32 [H, W], 0 = none) and how they are bent: the correlation of their points and normals
    about the means, -1 of the inside of a ball, 1 of its outside."""
    regions = np.ascontiguousarray(regions, np.int32)
    n = int(regions.max(initial=0)) + 1
    count, centre = np.empty(n, np.int64), np.empty((n, 3))
    square, spread, bend = np.empty(n), np.empty(n), np.empty(n)
    job = core.BodiesJob(
        address(surface.points), address(surface.normals), address(regions), regions.size, n, address(count),
        address(centre), address(square), address(spread), address(bend),
    )  # fmt: skip
    load_library().ggslam_region_bodies(ctypes.byref(job))
    correlation = bend / np.sqrt(np.maximum(square * spread, 1e-12))
    return Bodies(np.maximum(count, 1), centre, np.sqrt(square), correlation)


def count_borders(
    regions: np.ndarray, surface: DepthSurface, plane_of: np.ndarray, planes: np.ndarray, colors: np.ndarray,
    reach: int, settings: GeometricSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The borders between regions, see `regions.find_borders`: pairs int64 [n, 2]; int64 [n, 5], links and those of
    them closed, judged, concave and bent; float64 [n], median contrast."""
    colors, plane_of = np.ascontiguousarray(colors, np.float32), np.ascontiguousarray(plane_of, np.int32)
    normals = plane_normals(planes)
    regions = np.ascontiguousarray(regions, np.int32)
    room = 1024
    while True:
        pairs, counts, contrast = np.empty((room, 2), np.int64), np.empty((room, 5), np.int64), np.empty(room)
        job = core.BordersJob(
            _surface(surface, settings), address(plane_of), address(normals), len(normals), address(colors),
            address(regions), int(regions.max(initial=0)) + 1, reach, _edge_cosine(settings), room,
            address(pairs), address(counts), address(contrast),
        )  # fmt: skip
        found = load_library().ggslam_region_borders(ctypes.byref(job))
        if found <= room:
            return pairs[:found], counts[:found], contrast[:found]
        room = found


def count_contacts(
    pieces: np.ndarray, owner: np.ndarray, depth: np.ndarray, near: tuple[float, float], before: tuple[float, float],
    behind: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """What other regions touch the pieces of an image.

    Args:
        pieces: int32 [H, W], from 0 on.
        owner: int [n], the region of each piece.
        depth: float32 [H, W], metres.
        near: steps are small below near[0] metres + near[1] times the depth.
        before: from such a step on, given alike, the neighbour is far before the piece.
        behind: share of the depth by which a piece that is not before its neighbour may be so.

    Returns:
        int64 [m, 2], piece and region of a neighbour, ascending; int64 [m, 4], links, those with a small step, those
        where the piece is not before the neighbour, those where the neighbour is far before it.
    """
    pieces, owner = np.ascontiguousarray(pieces, np.int32), np.ascontiguousarray(owner, np.int32)
    depth = np.ascontiguousarray(depth, np.float32)
    room = 4 * len(owner)
    while True:
        pairs, counts = np.empty((room, 2), np.int64), np.empty((room, 4), np.int64)
        job = core.ContactsJob(
            address(pieces), address(depth), address(owner), *pieces.shape, len(owner), *near, *before, behind,
            room, address(pairs), address(counts),
        )  # fmt: skip
        found = load_library().ggslam_piece_contacts(ctypes.byref(job))
        if found <= room:
            return pairs[:found], counts[:found]
        room = found


def count_alike(
    colors: np.ndarray, pieces: np.ndarray, asked: np.ndarray, means: np.ndarray, limit: float
) -> np.ndarray:
    """Pixels outside of pieces whose colour is like the piece's: int64 [n].

    Args:
        colors: float32 [m, 3]; pieces: int [m], number of the piece of each.
        asked: int [n], numbers of pieces; means: float32 [n, 3], their mean colours.
        limit: distance below which colours are alike.
    """
    colors, means = np.ascontiguousarray(colors, np.float32), np.ascontiguousarray(means, np.float32)
    pieces, asked = np.ascontiguousarray(pieces, np.int32), np.ascontiguousarray(asked, np.int32)
    alike = np.empty(len(asked), np.int64)
    job = core.AlikeColorsJob(
        address(colors), address(pieces), len(pieces), address(asked), address(means), len(asked), limit, address(alike)
    )
    load_library().ggslam_alike_colors(ctypes.byref(job))
    return alike


def outlier_colors(
    lab: np.ndarray, inside: np.ndarray, pieces: np.ndarray, *, light: np.ndarray, bins: tuple[float, float, float],
    cell: int, least_cell: float, occurs: float, usual: float, base: float, same_hue: float,
    shade: tuple[float, float],
) -> np.ndarray:  # fmt: skip
    """Pixels of a plane whose colour occurs in few places of it, uint8 [H, W], see `find_outlier_colors`; what the
    numbers are, tells `OutlierColorsJob` in abi/core/objects.hpp."""
    lab, inside = np.ascontiguousarray(lab, np.float32), np.ascontiguousarray(inside, bool)
    pieces, kind = np.ascontiguousarray(pieces, np.int32), np.empty(inside.shape, np.uint8)
    job = core.OutlierColorsJob(
        address(lab), address(inside), address(pieces), *inside.shape, int(pieces.max(initial=0)) + 1, cell=cell,
        least_cell=least_cell, occurs=occurs, usual=usual, base=base, same_hue=same_hue, darkest=shade[0],
        brightest=shade[1], kind=address(kind),
    )  # fmt: skip
    job.light[:], job.bins[:] = light.tolist(), bins
    load_library().ggslam_outlier_colors(ctypes.byref(job))
    return kind


def plane_normals(planes: np.ndarray) -> np.ndarray:
    """Unit normals towards the camera, float32 [P, 3], of planes w with 1/z = w . ray."""
    return np.ascontiguousarray(-planes / np.linalg.norm(planes, axis=1, keepdims=True), np.float32)


def _edge_cosine(settings: GeometricSettings) -> float:
    return float(np.cos(np.radians(settings.concave_degrees)))


def _surface(surface: DepthSurface, settings: GeometricSettings) -> core.SegmentedSurface:
    height, width = surface.valid.shape
    for name, channels, kind in (("valid", (), np.bool_), ("depth", (), np.float32), ("inverse", (), np.float32),
                                 ("points", (3,), np.float32), ("normals", (3,), np.float32)):  # fmt: skip
        array = getattr(surface, name)
        if array.dtype != kind or array.shape != (height, width, *channels) or not array.flags.c_contiguous:
            expected = f"contiguous {np.dtype(kind)} {[height, width, *channels]}"
            raise InputError(f"surface: {name}: expected {expected}, found {array.dtype} {list(array.shape)}")
    return core.SegmentedSurface(
        address(surface.valid), address(surface.depth), address(surface.inverse), address(surface.points),
        address(surface.normals), height, width, surface.step, surface.sigma, settings.jump_m, settings.jump_sigmas,
    )  # fmt: skip


def _empty_links(shape: tuple[int, ...]) -> Links:
    height, width = shape
    return np.empty((height, width - 1), bool), np.empty((height - 1, width), bool)


def _contiguous(links: Links) -> Links:
    return np.ascontiguousarray(links[0], bool), np.ascontiguousarray(links[1], bool)


def _links(links: Links) -> core.PixelLinks:
    """To be kept alive by the caller."""
    return core.PixelLinks(address(links[0]), address(links[1]))
