# SPDX-License-Identifier: Apache-2.0
# Written by scripts/tools/make_native_mirrors.py from objects.hpp; changes are lost.
"""The compiled core's passes over the pixels of a depth image that falls into segments."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int, c_int32, c_int64, c_void_p
from typing import Any

HEADER = "core/objects.hpp"
HEADER_SHA256 = "9f7aa22e17201c8b20ed8c6a8721b7ffc7d788987048e966b775419e76220900"


class SegmentedSurface(Structure):
    """A depth image prepared for segmentation, [H, W] with H = height, W = width. A gap of more than gap_m +
    gap_sigmas * sigma * depth^2 metres separates surfaces."""

    _fields_ = [
        ("valid", c_void_p), ("depth", c_void_p), ("inverse", c_void_p), ("points", c_void_p), ("normals", c_void_p),
        ("height", c_int32), ("width", c_int32), ("step", c_int32), ("sigma", c_float), ("gap_m", c_float),
        ("gap_sigmas", c_float),
    ]


class PixelLinks(Structure):
    """Links between a pixel and its right neighbour, [H, W - 1], and its lower one, [H - 1, W]; 0 or 1."""

    _fields_ = [("right", c_void_p), ("below", c_void_p)]


class NormalsJob(Structure):
    """Normals from differences of inverse depth over `step` pixels, on one side only where the other is beyond a
    jump."""

    _fields_ = [
        ("inverse", c_void_p), ("rays", c_void_p), ("height", c_int32), ("width", c_int32), ("step", c_int32),
        ("fx", c_float), ("fy", c_float), ("jump", c_float), ("normals", c_void_p),
    ]


class AlikeColorsJob(Structure):
    """How many colours are like the mean one of a piece, outside of the piece."""

    _fields_ = [
        ("colors", c_void_p), ("pieces", c_void_p), ("pixels", c_int64), ("asked", c_void_p), ("means", c_void_p),
        ("count", c_int64), ("limit", c_float), ("alike", c_void_p),
    ]


class StrangeColorsJob(Structure):
    """Which colours of a plane occur in few places of it."""

    _fields_ = [
        ("lab", c_void_p), ("inside", c_void_p), ("pieces", c_void_p), ("height", c_int32), ("width", c_int32),
        ("pieces_end", c_int32), ("light", c_double * 3), ("bins", c_float * 3), ("cell", c_int32),
        ("least_cell", c_double), ("occurs", c_double), ("usual", c_double), ("base", c_double), ("same_hue", c_double),
        ("darkest", c_double), ("brightest", c_double), ("kind", c_void_p),
    ]


class SurfaceLinksJob(Structure):
    """Where surfaces go on from pixel to pixel."""

    _fields_ = [
        ("surface", SegmentedSurface), ("rest", c_void_p), ("least_cosine", c_double), ("closed", PixelLinks),
        ("smooth", PixelLinks),
    ]


class PiecesJob(Structure):
    """Pieces of pixels that hang together."""

    _fields_ = [("ids", c_void_p), ("links", PixelLinks), ("height", c_int32), ("width", c_int32), ("pieces", c_void_p)]


class GrowthJob(Structure):
    """Regions [H, W] that grow over pixels without region, one pixel a pass, where a link leads."""

    _fields_ = [
        ("regions", c_void_p), ("valid", c_void_p), ("links", PixelLinks), ("height", c_int32), ("width", c_int32),
        ("passes", c_int32),
    ]


class PlaneClaimJob(Structure):
    """The nearest of some planes 1 / z = w . ray that a pixel lies on and has the normal of."""

    _fields_ = [
        ("surface", SegmentedSurface), ("rays_x", c_void_p), ("rays_y", c_void_p), ("planes", c_void_p),
        ("count", c_int32), ("tolerance", c_float), ("tolerance_m", c_float), ("least_cosine", c_double),
        ("label", c_void_p),
    ]


class BordersJob(Structure):
    """What lies between touching regions."""

    _fields_ = [
        ("surface", SegmentedSurface), ("plane_of", c_void_p), ("plane_normals", c_void_p), ("planes", c_int32),
        ("colors", c_void_p), ("regions", c_void_p), ("regions_end", c_int32), ("reach", c_int32),
        ("least_cosine", c_double), ("room", c_int64), ("pairs", c_void_p), ("counts", c_void_p),
        ("contrast", c_void_p),
    ]


class RegionOnPlane(Structure):
    """How near the points of a region are to a plane."""

    _fields_ = [("region", c_int32), ("plane", c_float * 3), ("points", c_int64), ("near_by", c_int64)]


class RegionsOnPlanesJob(Structure):
    """Regions that are asked how near to planes they are; one may be asked about several."""

    _fields_ = [
        ("points", c_void_p), ("regions", c_void_p), ("pixels", c_int64), ("regions_end", c_int32),
        ("limit_m", c_float), ("asked", c_void_p), ("count", c_int64),
    ]


class BodiesJob(Structure):
    """Places and directions of regions, a row a region; region 0 is left out."""

    _fields_ = [
        ("points", c_void_p), ("normals", c_void_p), ("regions", c_void_p), ("pixels", c_int64),
        ("regions_end", c_int32), ("counts", c_void_p), ("centres", c_void_p), ("squares", c_void_p),
        ("spreads", c_void_p), ("bends", c_void_p),
    ]


class ContactsJob(Structure):
    """What other regions lie around the pieces of an image, a row a pair of a piece and the region (`owner`) of a
    neighbour."""

    _fields_ = [
        ("pieces", c_void_p), ("depth", c_void_p), ("owner", c_void_p), ("height", c_int32), ("width", c_int32),
        ("pieces_end", c_int32), ("near_m", c_float), ("near_relative", c_float), ("before_m", c_float),
        ("before_relative", c_float), ("behind_relative", c_float), ("room", c_int64), ("pairs", c_void_p),
        ("counts", c_void_p),
    ]


STRUCTURES: tuple[type[Structure], ...] = (
    SegmentedSurface, PixelLinks, NormalsJob, AlikeColorsJob, StrangeColorsJob, SurfaceLinksJob, PiecesJob, GrowthJob,
    PlaneClaimJob, BordersJob, RegionOnPlane, RegionsOnPlanesJob, BodiesJob, ContactsJob,
)
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "ggslam_surface_links": (c_int, [POINTER(SurfaceLinksJob)]),
    "ggslam_connected_pieces": (c_int32, [POINTER(PiecesJob)]),
    "ggslam_grow_regions": (c_int, [POINTER(GrowthJob)]),
    "ggslam_claim_planes": (c_int, [POINTER(PlaneClaimJob)]),
    "ggslam_region_borders": (c_int64, [POINTER(BordersJob)]),
    "ggslam_piece_contacts": (c_int64, [POINTER(ContactsJob)]),
    "ggslam_regions_on_planes": (c_int, [POINTER(RegionsOnPlanesJob)]),
    "ggslam_region_bodies": (c_int, [POINTER(BodiesJob)]),
    "ggslam_surface_normals": (c_int, [POINTER(NormalsJob)]),
    "ggslam_alike_colors": (c_int, [POINTER(AlikeColorsJob)]),
    "ggslam_strange_colors": (c_int, [POINTER(StrangeColorsJob)]),
}
"""Result and arguments of each."""
