# SPDX-License-Identifier: Apache-2.0
"""Edges and planes of frames that stay on the device, and what the kernels that extract them are told."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from ctypes import sizeof
from typing import Final

import numpy as np
import torch

from ggslam.abi.cuda import FeatureArrays, FeatureHeader, FeatureScanJob, FeatureSettings, ScanSegmentsJob
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.transfers import download, upload
from ggslam.scene.camera import Camera
from ggslam.tracking.cuda.blocks import Block
from ggslam.tracking.edges_planes.extraction import HALF, ScanFeatures, dither
from ggslam.tracking.edges_planes.scans import DepthSegments, LineLayout, disc_per_depth
from ggslam.tracking.edges_planes.settings import ExtractionSettings
from ggslam.tracking.settings import DepthNoise

_BEGIN: Final = 64
"""Words before the arrays of a block. Its header takes the first five."""
_PLANE_WORDS: Final = (3, 3, 1, 1)
"""Words of a plane in each of the arrays: points, normals, discs, standard deviations."""
_EDGE_WORDS: Final = (3, 1)
"""Words of an edge: points, standard deviations."""


class CudaScan:
    """Features of one scan on the device: a `Scan`. Their numbers and medians come to the host with an alignment; asked
    for before, they are waited for.

    Args:
        rooms: planes and edges at most; their numbers are known to the device alone.
        block: see `words_for`.
        extract: has them extracted; None: they are there.
    """

    def __init__(self, rooms: tuple[int, int], block: Block, extract: Callable[[CudaScan], None] | None) -> None:
        self.rooms, self.block = rooms, block
        self.depth: np.ndarray | None = None
        """What they are extracted from, until the device was told to."""
        self._extract = extract
        self._header: tuple[int, int, float, float] | None = None

    @staticmethod
    def words_for(rooms: tuple[int, int]) -> int:
        """Words of a block with room for so many planes and edges."""
        return _BEGIN + rooms[0] * sum(_PLANE_WORDS) + rooms[1] * sum(_EDGE_WORDS)

    def arrays(self) -> FeatureArrays:
        """Addresses on the device; this object must stay alive."""
        begins = self._begins()
        return FeatureArrays(self.block.address, *(self.block.address + 4 * begin for begin in begins[:-1]))

    @property
    def is_extracted(self) -> bool:
        """Whether the device was told to extract them."""
        return self._extract is None

    def note_extracted(self) -> None:
        """The device was told to extract them."""
        self._extract = self.depth = None

    def set_header(self, planes: int, edges: int, median_depth: float, median_distance: float) -> None:
        """Takes what the device says of the features, once it is known."""
        self._header = planes, edges, median_depth, median_distance

    @property
    def plane_count(self) -> int:
        """See `Scan`."""
        return self._known_header()[0]

    @property
    def edge_count(self) -> int:
        """See `Scan`."""
        return self._known_header()[1]

    @property
    def median_depth(self) -> float:
        """See `Scan`."""
        return self._known_header()[2]

    @property
    def median_distance(self) -> float:
        """See `Scan`."""
        return self._known_header()[3]

    def __len__(self) -> int:
        return self.plane_count + self.edge_count

    def read(self) -> ScanFeatures:
        """The features on the host; waits for the device."""
        self._ensure()
        (words,) = download(self.block.memory[: self.words_for(self.rooms)])
        planes, edges = (int(number) for number in words[:2].view(np.int32))
        widths, counts = (*_PLANE_WORDS, *_EDGE_WORDS), (planes,) * 4 + (edges,) * 2
        arrays = [
            torch.from_numpy(words[begin : begin + width * count].copy()).reshape(count, width)
            for begin, width, count in zip(self._begins(), widths, counts, strict=False)
        ]
        return ScanFeatures(*(a if a.shape[1] > 1 else a[:, 0] for a in arrays))

    def _begins(self) -> list[int]:
        """Word at which each array begins, and the one behind the last."""
        planes, edges = self.rooms
        sizes = [_BEGIN, *(planes * width for width in _PLANE_WORDS), *(edges * width for width in _EDGE_WORDS)]
        return np.cumsum(sizes).tolist()

    def _ensure(self) -> None:
        if self._extract is not None:
            self._extract(self)

    def _known_header(self) -> tuple[int, int, float, float]:
        if self._header is None:
            self._ensure()
            (words,) = download(self.block.memory[: sizeof(FeatureHeader) // 4])
            planes, edges = words[:2].view(np.int32).tolist()
            self.set_header(planes, edges, float(words[2]), float(words[3]))
        assert self._header is not None
        return self._header


class FeatureScanJobs:
    """Fills what the kernels are told to extract features from depth images of one camera.

    Args:
        camera: of the images.
        settings: limits.
        library: the kernels.
        device: where.
        job: that is filled; its depth image is the caller's to set.
    """

    def __init__(
        self, camera: Camera, settings: ExtractionSettings, library: CudaLibrary, device: torch.device,
        job: FeatureScanJob,
    ) -> None:  # fmt: skip
        self._job, self._noise = job, DepthNoise()
        layout = LineLayout.of(camera, settings)
        if layout.length < 2 * HALF + 1:
            raise ValueError(f"lines of {layout.length} points, at least {2 * HALF + 1} needed")
        job.settings = _settings_for(camera, settings, layout)
        chance = dither(layout.lines, layout.length - 2 * HALF)[: layout.rows]
        self._kept = [upload(chance.numpy(), device)]
        job.dither, job.device = self._kept[0].data_ptr(), device.index or 0
        if settings.segment_angle_deg:
            job.small = self._segments_for(camera, settings, layout, device)
        functions, reference = library.functions, ctypes.byref(job)
        room = functions.ggslam_cuda_feature_room
        self.rooms: tuple[int, int] = (room(reference, 0), room(reference, 1))
        """Planes and edges that a scan has at most."""
        self._workspace = torch.zeros(
            functions.ggslam_cuda_feature_scan_bytes(reference), dtype=torch.uint8, device=device
        )
        job.workspace = self._workspace.data_ptr()
        self.set_noise(self._noise)

    def set_noise(self, noise: DepthNoise) -> None:
        """The noise of the next images."""
        if noise is not self._noise:
            self._job.settings.noise_constant, self._job.settings.noise_square = noise.constant, noise.square
            self._noise = noise

    def _segments_for(
        self, camera: Camera, settings: ExtractionSettings, layout: LineLayout, device: torch.device
    ) -> ScanSegmentsJob:
        """What tells small segments."""
        parts = DepthSegments(camera, settings, layout.pitch)
        (down_sine, down_versine), (across_sine, across_versine) = parts.segments.trigonometry
        tables = (across_sine, across_versine, down_sine, down_versine, parts.lengths)
        self._kept += [upload(np.ascontiguousarray(table), device) for table in tables]
        self._kept.append(torch.zeros(camera.height, camera.width, device=device))
        height, width = parts.lengths.shape
        return ScanSegmentsJob(
            *(tensor.data_ptr() for tensor in self._kept[1:]), parts.segments.tangent, settings.segment_sigmas, width,
            height, settings.segment_pixels,
        )  # fmt: skip


def _settings_for(camera: Camera, settings: ExtractionSettings, layout: LineLayout) -> FeatureSettings:
    """The kernels' form of the settings, without noise."""
    s, usual = settings, DepthNoise()
    segment = math.ceil((layout.length - 2 * HALF) / s.segments)
    return FeatureSettings(
        camera.fx, camera.fy, camera.cx, camera.cy, usual.constant, usual.square, s.min_depth, s.max_depth,
        s.roughness**2, s.edge_sigmas**2, s.plane_sigmas**2, math.cos(math.radians(s.edge_angle_deg)), s.gap,
        s.plane_sigmas, s.roughness, s.min_cosine, disc_per_depth(camera, s, layout.pitch), camera.width, camera.height,
        layout.pitch, layout.lines, layout.rows, layout.row_step // 2, layout.row_step, layout.column_step // 2,
        layout.column_step, layout.length, s.segments, segment, s.edges_per_segment, s.planes_per_segment,
        s.occluding_edges, s.patch_step * layout.pitch,
    )  # fmt: skip
