# SPDX-License-Identifier: Apache-2.0
"""Tracking by edges and planes on an NVIDIA GPU: the work of `DepthImageFeatures` and `TorchFeatureEngine` by kernels,
in one call and one wait per frame.

A frame's depth is sent once. Its features, the local map and the whole alignment stay on the device; the host gets the
result in one copy, and waits for that alone. A scan that is added to the map is added by the call of the next frame,
before that is aligned. There is no limit of time: results repeat bit for bit.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from typing import Final

import numpy as np
import torch

from ggslam.abi.cuda import (
    FeatureAlignJob,
    FeatureAlignLimits,
    FeatureResult,
    FeatureTable,
    FeatureTrackJob,
    MoverEvidenceJob,
)
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import upload
from ggslam.tracking.cuda.blocks import BlockPool
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.cuda.feature_scans import CudaScan, FeatureScanJobs
from ggslam.tracking.cuda.results import symmetric6
from ggslam.tracking.edges_planes.alignment import FeatureAlignment
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.settings import FeatureAlignSettings, FeatureMapSettings, FeatureTrackerSettings
from ggslam.tracking.observability import PointSpread, observability
from ggslam.tracking.settings import DepthNoise

_ALIGN: Final = FeatureTrackJob.align.offset
_CENTROID = slice(FeatureResult.FEATURE_CENTROID, FeatureResult.FEATURE_RADIUS)
_POSE = slice(FeatureResult.FEATURE_POSE, FeatureResult.FEATURE_INFORMATION)


class CudaFeatures:
    """Extracts, gathers and aligns edges and planes on torch's current stream: `DeviceFeatures`. One serves one thread
    at a time.

    Args:
        settings: see `FeatureTrackerSettings`.
        tracking: has the frames' depth on the device, and G-ICP's work.
    """

    def __init__(self, settings: FeatureTrackerSettings, tracking: CudaTrackingEngine) -> None:
        self.gicp_engine, self.library, self.device = tracking, tracking.library, tracking.device
        self._settings = settings
        self._job = job = FeatureTrackJob()
        self._scans = FeatureScanJobs(tracking.camera, settings.extraction, self.library, self.device, job.scan)
        self._blocks = BlockPool(self.device)
        self._memory = GrowingMemory(self.device)
        job.scan.most_planes, job.scan.most_edges = settings.align.planes, settings.align.edges
        self.table, job.add.table = _make_table(settings.map, self.device)
        """Keys, weights, surfaces and scatters of the voxels, as of `FeatureMap`; the last scan is in it after the next
        alignment, or `flush`."""
        job.align.table, job.align.limits = job.add.table, _limits(settings.align, settings.map)
        results = (FeatureResult.FEATURE_RESULTS,)
        self._results = torch.zeros(results, dtype=torch.float64, device=self.device)
        pinned = self.device.type == "cuda"
        self._arrived = torch.zeros(results, dtype=torch.float64, pin_memory=pinned)
        self._found = self._arrived.numpy()
        job.results, job.align.results = self._arrived.data_ptr(), self._results.data_ptr()
        job.add.device = job.align.device = self.device.index or 0
        self._guess = np.frombuffer(job, np.float64, 12, _ALIGN + FeatureAlignJob.guess.offset)
        self._world = np.frombuffer(job, np.float64, 12, _ALIGN + FeatureAlignJob.T_world_map.offset)
        self._reference = ctypes.byref(job)
        self._matches_room = 0
        self._pending: weakref.ref[CudaScan] | None = None
        self._added: CudaScan | None = None
        """What the next call adds first of all."""
        job.clears = True
        self.evidence: MoverEvidenceJob = job.evidence
        """What is asked of an alignment that brings evidence of what moves, but for depth and pose."""

    def extract(self, depth: np.ndarray, noise: DepthNoise) -> CudaScan:
        """As `DepthImageFeatures.extract`; sends the depth image, and the first alignment or reader starts the rest.

        Args:
            depth: float32 [H, W], metres, 0 where unknown.
            noise: of the depth camera.

        Raises:
            ValueError: another size than the camera's.
        """
        before = None if self._pending is None else self._pending()
        if before is not None:
            self._start(before)
        self.gicp_engine.send_depth(depth)
        self._scans.set_noise(noise)
        scan = CudaScan(self._scans.rooms, self._blocks.take(CudaScan.words_for(self._scans.rooms)), self._start)
        scan.depth = depth
        self._pending = weakref.ref(scan)
        return scan

    def take(self, features: ScanFeatures) -> CudaScan:
        """Features that the host has, on the device; waits for nothing."""
        rooms = len(features.planes), len(features.edges)
        scan = CudaScan(rooms, self._blocks.take(CudaScan.words_for(rooms)), None)
        arrays = (getattr(features, name) for name in features.__dataclass_fields__)
        words = np.concatenate([np.zeros(CudaScan.words_for((0, 0)), np.float32), *(a.numpy().ravel() for a in arrays)])
        words[:2].view(np.int32)[:] = rooms
        scan.block.memory[: len(words)].copy_(upload(words.astype(np.float32), self.device))
        job = type(self._job.scan).from_buffer_copy(self._job.scan)
        job.out, job.stream = scan.arrays(), self.library.stream(self.device)
        self.library.call("feature_medians", ctypes.byref(job))
        return scan

    def clear(self) -> None:
        """See `FeatureEngine`."""
        self._added, self._job.adds, self._job.clears = None, False, True

    def add(self, scan: CudaScan, T_map_sensor: np.ndarray) -> None:
        """See `FeatureEngine`; the next call does it."""
        if self._added is not None:
            self.flush()
        job = self._job
        job.add.scan, room = scan.arrays(), sum(scan.rooms)
        job.add.pose[:9], job.add.pose[9:] = T_map_sensor[:3, :3].ravel().tolist(), T_map_sensor[:3, 3].tolist()
        if job.add.room < room:
            job.add.room = room
            size = self.library.functions.ggslam_cuda_feature_add_bytes(ctypes.byref(job.add))
            job.add.workspace = self._memory.block("adding", size).data_ptr()
        self._added, job.adds = scan, True

    def align(self, scan: CudaScan, T_map_sensor_guess: np.ndarray, T_world_map: np.ndarray) -> FeatureAlignment:
        """See `FeatureEngine`; waits for the result."""
        job, align = self._job, self._job.align
        if self._added is not None:
            self._start(self._added)
        align.scan = scan.arrays()
        self._make_room(scan.rooms)
        for place, T in ((self._guess, T_map_sensor_guess), (self._world, T_world_map)):
            place[:9], place[9:] = T[:3, :3].ravel(), T[:3, 3]
        job.scans = not scan.is_extracted
        if job.scans:
            self._prepare(scan)
        align.stream = self.library.stream(self.device)
        self.library.call("feature_track_wait", self._reference)
        self.gicp_engine.note_depth_arrival()
        scan.note_extracted()
        self._note_updated()
        return self._read_result(scan, self._found.copy())

    def flush(self) -> None:
        """Starts what the next alignment would do first: clearing the map, adding the last scan."""
        if self._added is not None:
            self._start(self._added)
        self._job.add.stream = self.library.stream(self.device)
        self.library.call("feature_update", self._reference)
        self._note_updated()

    def world_pose(self) -> np.ndarray:
        """The pose [4, 4] that the last alignment found, in the world, as it is on the device."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._found[:9].reshape(3, 3), self._found[9:12]
        return T

    def depth_address(self, depth: np.ndarray) -> int | None:
        """Where a frame's depth is on the device, if this very array was sent last."""
        return self.gicp_engine.depth_address(depth)

    def bring_evidence(self, wanted: bool) -> None:
        """See `CudaTrackingEngine.bring_evidence`."""
        if wanted:
            self.evidence.depth, self.evidence.pose = self.gicp_engine.depth_on_device, self._results.data_ptr()
        self._job.makes_evidence = wanted

    # --- parts -------------------------------------------------------------------------------------------------------

    def _prepare(self, scan: CudaScan) -> None:
        """Sets what extracts a scan; its depth is on the device, or sent anew."""
        assert scan.depth is not None
        if self.gicp_engine.depth_address(scan.depth) is None:
            self.gicp_engine.send_depth(scan.depth)
        self._job.scan.depth, self._job.scan.out = self.gicp_engine.depth_on_device, scan.arrays()

    def _start(self, scan: CudaScan) -> None:
        """Starts to extract features, if that was not done yet."""
        if not scan.is_extracted:
            self._prepare(scan)
            self._job.scan.stream = self.library.stream(self.device)
            self.library.call("feature_scan", ctypes.byref(self._job.scan))
            scan.note_extracted()

    def _note_updated(self) -> None:
        self._added = None
        self._job.clears = self._job.adds = False

    def _make_room(self, rooms: tuple[int, int]) -> None:
        room = min(rooms[0], self._settings.align.planes) + min(rooms[1], self._settings.align.edges)
        if self._matches_room < room:
            self._matches_room = room
            self._job.align.matches = self._memory.block("matches", 4 * room).data_ptr()

    def _read_result(self, scan: CudaScan, found: np.ndarray) -> FeatureAlignment:
        """An alignment from what the kernels say, float64 [FEATURE_RESULTS]."""
        value, place, s = found.tolist(), FeatureResult, self._settings.align
        scan.set_header(
            int(value[place.FEATURE_PLANES]), int(value[place.FEATURE_EDGES]), value[place.FEATURE_MEDIAN_DEPTH],
            value[place.FEATURE_MEDIAN_DISTANCE],
        )  # fmt: skip
        pose, T = found[_POSE], np.eye(4)
        T[:3, :3], T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
        information = symmetric6(found[place.FEATURE_INFORMATION :])
        spread = PointSpread(value[place.FEATURE_WEIGHT], found[_CENTROID], value[place.FEATURE_RADIUS])
        visibility, weak = observability(information, T[:3, :3], spread, s.degenerate_below)
        inliers = value[place.FEATURE_INLIERS]
        return FeatureAlignment(
            T, value[place.FEATURE_ROWS] >= s.min_matches, value[place.FEATURE_SETTLED] != 0,
            int(value[place.FEATURE_MATCHINGS]), int(value[place.FEATURE_STEPS]),
            inliers / max(value[place.FEATURE_ALIGNED], 1),
            math.sqrt(value[place.FEATURE_SQUARED] / max(inliers, 1)), information, visibility, weak,
        )  # fmt: skip


def _make_table(settings: FeatureMapSettings, device: torch.device) -> tuple[list[torch.Tensor], FeatureTable]:
    """An empty table once it is cleared, its memory and what the kernels are told of it."""
    s, slots = settings, settings.slots
    arrays = [torch.zeros(slots, dtype=torch.int64, device=device)]
    arrays += [torch.zeros(slots, width, device=device) for width in (1, 8, 6)]
    return arrays, FeatureTable(
        *(array.data_ptr() for array in arrays), slots, 64 - int(math.log2(slots)), s.plane_voxel, s.edge_voxel,
        1.0 / s.plane_voxel, 1.0 / s.edge_voxel, s.match_voxels, s.min_normal_dot, s.max_weight, s.min_plane_points,
        s.min_edge_points, s.plane_ratio, s.edge_ratio,
    )  # fmt: skip


def _limits(settings: FeatureAlignSettings, voxels: FeatureMapSettings) -> FeatureAlignLimits:
    """The kernels' form of the settings."""
    s = settings
    return FeatureAlignLimits(
        s.rematch_share * voxels.plane_voxel, s.translation_tolerance, s.rotation_tolerance, s.huber_sigmas,
        s.gate_constant, s.gate_sigmas, s.edge_weight, s.overlap_constant, s.overlap_sigmas, s.planes, s.edges,
        s.outer_iterations, s.inner_iterations, s.min_matches,
    )  # fmt: skip
