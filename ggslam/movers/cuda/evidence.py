# SPDX-License-Identifier: Apache-2.0
"""What earlier views say of the latest one, on an NVIDIA GPU: the work of `HostEvidence` by kernels.

The views stay on the device. Where nothing is expected to move, a frame's evidence is made in the same call as its
alignment, of the same depth and at the pose that the device found; the host has the number of novel places when it has
the pose, and reads more only if there are some. If the frame's pose becomes another one, or its depth is another, the
evidence is made anew, for which the host waits.
"""

from __future__ import annotations

import ctypes
from bisect import bisect_right
from typing import Any, Protocol

import numpy as np
import torch

from ggslam.abi.cuda import EVIDENCE_PLANES, MOST_EARLIER, EvidencePart, MoverEvidenceFound, MoverEvidenceJob
from ggslam.cuda.library import CudaLibrary
from ggslam.cuda.memory import GrowingMemory
from ggslam.cuda.transfers import Upload, download
from ggslam.movers.cuda.views import CudaView, ViewRing
from ggslam.movers.evidence import Evidence, EvidenceRequest, HostEvidence, ages_and_parts
from ggslam.movers.settings import MoverSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, PlaceTuning, small_camera, window_of
from ggslam.system.tuning import Tuning


class CudaEvidenceTuning(Tuning):
    """Evidence that is made with a frame's alignment."""

    same_pose = 1e-9
    """Largest difference of a number of two poses (metres, or of a rotation) that count as one: rounding."""


class FrameOnDevice(Protocol):
    """Tracking, which has a frame's depth on the device and finds its pose there."""

    evidence: MoverEvidenceJob
    """Of its alignments, see `bring_evidence`."""

    def depth_address(self, depth: np.ndarray) -> int | None:
        """Where this very array is on the device; None: another one is there."""

    def bring_evidence(self, wanted: bool) -> None:
        """Whether each alignment from now on makes `evidence`, of its depth at its pose."""


class CudaEvidence:
    """Compares frames on torch's current stream.

    Args:
        tracking: see there.
        library: the compiled kernels.
        device: where.
    """

    def __init__(self, tracking: FrameOnDevice, library: CudaLibrary, device: torch.device) -> None:
        self._tracking, self._library, self._device = tracking, library, device
        self._memory, self._host = GrowingMemory(device), HostEvidence()
        self._upload = Upload(device)
        self._ring: ViewRing | None = None
        self._found = torch.zeros(ctypes.sizeof(MoverEvidenceFound), dtype=torch.uint8, device=device)
        pinned = torch.zeros(self._found.numel(), dtype=torch.uint8, pin_memory=device.type == "cuda")
        self._arrived = pinned
        self._pose = pinned.numpy()[:96].view(np.float64)
        self._apart = np.zeros(12)
        self._novel = pinned.numpy()[96:100].view(np.int32)
        self._job = job = tracking.evidence
        job.found, job.arrived, job.device = self._found.data_ptr(), pinned.data_ptr(), device.index or 0
        self._T_earlier = self._of_job("T_camera_world", np.float64).reshape(MOST_EARLIER, 12)
        self._slots, self._parts = self._of_job("slots", np.int32), self._of_job("parts", np.int32)
        self._given = self._of_job("given_pose", np.float64)
        self._margin: Margin | None = None
        self._asks, self._settings = -1, MoverSettings()  # ages, and settings, that `_parts` are of
        self._prepared: EvidenceRequest | None = None

    def prepare(self, request: EvidenceRequest) -> None:
        """See `EvidenceSource`."""
        self._prepared = None
        if self._is_for_the_host(request):
            self._tracking.bring_evidence(False)
            return
        self._fill(request)
        self._job.moved = None
        self._pose[0] = np.nan
        self._prepared = request
        self._tracking.bring_evidence(True)

    def look(
        self, request: EvidenceRequest, T_world_camera: np.ndarray, moved: np.ndarray | None, context: NativeContext
    ) -> tuple[CoarseView, Evidence | None]:
        """See `EvidenceSource`."""
        prepared, self._prepared = self._prepared, None
        self._tracking.bring_evidence(False)
        if request is not prepared and self._is_for_the_host(request):
            return self._host.look(request, T_world_camera, moved, context)
        job, address = self._job, self._tracking.depth_address(request.depth)
        if moved is not None or address is None or not self._is_made(request, prepared, T_world_camera):
            self._fill(request)
            self._make(request, address, T_world_camera, moved)
        assert self._ring is not None
        view = CudaView(self._ring, job.slot, T_world_camera)
        if moved is None and self._novel[0] < request.fewest:
            return view, None
        planes, images, flags = download(self._planes, self._ring.images[job.slot], self._ring.flags[job.slot])
        view.take(images, flags)
        counts, known = planes[:4].view(np.int8), planes[4:].view(bool)
        return view, Evidence(*counts, *known)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _of_job(self, name: str, dtype: type[np.generic]) -> Any:
        field = getattr(MoverEvidenceJob, name)
        count = field.size // np.dtype(dtype).itemsize
        return np.frombuffer(self._job, dtype, count, field.offset)

    def _is_for_the_host(self, request: EvidenceRequest) -> bool:
        """Whether there are views that are not in the ring, or more of them than one is compared with."""
        if len(request.ages) > MOST_EARLIER:
            return True
        if not request.earlier:
            return False
        newest = request.earlier[-1]
        return not (isinstance(newest, CudaView) and newest.ring is self._ring and self._has_room(request))

    def _has_room(self, request: EvidenceRequest) -> bool:
        """Whether memory is for frames of this size."""
        job, camera = self._job, request.camera
        return (job.width, job.height, job.factor) == (camera.width, camera.height, request.factor)

    def _is_made(self, request: EvidenceRequest, prepared: EvidenceRequest | None, T: np.ndarray) -> bool:
        """Whether the last alignment made what is asked for."""
        if prepared is None or prepared.depth is not request.depth or prepared.earlier is not request.earlier:
            return False
        if prepared is not request and prepared.margin != request.margin:
            return False
        self._apart[:9], self._apart[9:] = T[:3, :3].ravel(), T[:3, 3]
        self._apart -= self._pose
        most = CudaEvidenceTuning.same_pose
        return bool(np.maximum.reduce(np.abs(self._apart)) <= most)  # what is not a number is not

    def _fill(self, request: EvidenceRequest) -> None:
        """Sets what is asked of the kernels but for depth and pose. Earlier views, if any, are in the ring."""
        job = self._job
        if self._ring is None or not (request.earlier or self._has_room(request)):
            self._make_room(request.camera, request.factor, request.ages[-1] + 2)
        assert self._ring is not None
        if self._margin is not request.margin and self._margin != request.margin:
            self._margin, job.margin = request.margin, request.margin.native()
        earlier = request.earlier
        n = job.count = bisect_right(request.ages, len(earlier))
        if n != self._asks or request.settings is not self._settings:
            ages = ages_and_parts(request)
            self._parts[:n] = [EvidencePart.LEFT * left + EvidencePart.STAYED * stayed for _, left, stayed in ages]
            self._asks, self._settings = n, request.settings
        job.slot, job.fewest_passed = self._ring.next_slot(earlier), request.settings.min_passed
        # The newest is in the slot before: views lie one after the other.
        slots = (job.slot - np.array(request.ages[:n], int)) % self._ring.slots
        self._slots[:n], self._T_earlier[:n] = slots, self._ring.T_camera_world[slots]

    def _make_room(self, camera: Camera, factor: int, slots: int) -> None:
        """Memory for frames of a camera."""
        job, small, t = self._job, small_camera(camera, factor), PlaceTuning
        ring = self._ring = ViewRing(small, slots, self._device)
        shape = (EVIDENCE_PLANES, small.height, small.width)
        self._planes = torch.zeros(shape, dtype=torch.uint8, device=self._device)
        job.width, job.height, job.factor, job.reach = camera.width, camera.height, factor, window_of(factor) // 2
        job.fx, job.fy, job.cx, job.cy = small.fx, small.fy, small.cx, small.cy
        job.least_known, job.smooth_sigmas = t.min_known * window_of(factor) ** 2, t.smooth_sigmas
        job.rough, job.least_share, job.nearest = t.rough_sigmas, t.min_noise_share, t.nearest_factor
        job.every, job.fewest = t.stride, t.min_places
        job.images, job.flags, job.planes = (x.data_ptr() for x in (ring.images, ring.flags, self._planes))
        size = self._library.functions.ggslam_cuda_mover_evidence_bytes(ctypes.byref(job))
        job.workspace = self._memory.block("work", size).data_ptr()

    def _make(
        self, request: EvidenceRequest, address: int | None, T_world_camera: np.ndarray, moved: np.ndarray | None
    ) -> None:  # fmt: skip
        """Makes the evidence at a pose, and waits for it."""
        job = self._job
        pieces = [] if address is not None else [np.ascontiguousarray(request.depth, np.float32).view(np.uint8).ravel()]
        pieces += [] if moved is None else [np.ascontiguousarray(moved, np.uint8).ravel()]
        sent = None
        if pieces:
            sent = self._memory.block("sent", sum(len(piece) for piece in pieces))
            size = sum(len(piece) for piece in pieces)
            np.concatenate(pieces, out=self._upload.begin(size))
            self._upload.send(sent[:size])
        job.depth = sent.data_ptr() if address is None and sent is not None else address
        job.moved = None if moved is None or sent is None else sent.data_ptr() + sum(len(p) for p in pieces[:-1])
        job.pose = None
        self._given[:9], self._given[9:] = T_world_camera[:3, :3].ravel(), T_world_camera[:3, 3]
        job.stream = self._library.stream(self._device)
        self._library.call("mover_evidence_wait", ctypes.byref(job))
        job.depth = job.moved = None
