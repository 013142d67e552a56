# SPDX-License-Identifier: Apache-2.0
"""What earlier views say of a frame, by the CUDA kernels, held against the compiled core."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from device_watch import DeviceWatch

from ggslam.abi.cuda import MoverEvidenceJob
from ggslam.cuda.library import library_and_device
from ggslam.movers.cuda.evidence import CudaEvidence
from ggslam.movers.cuda.views import CudaView
from ggslam.movers.detector import DetectorTuning, MoverDetector
from ggslam.movers.evidence import Evidence
from ggslam.movers.settings import MoverSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView

if TYPE_CHECKING:
    from ggslam.cuda.library import CudaLibrary

CAMERA = Camera(161, 123, 130.0, 131.0, 80.5, 60.5)  # places do not fill it
CONTEXT = NativeContext(1)
NOISE = 0.002
MARGIN = Margin(0.004, 0.0, 5.0, NOISE)
SETTINGS = MoverSettings(enabled=True, columns=54)
IMAGES = ("depth", "near", "far", "whole", "smooth")


def pose(n: int) -> np.ndarray:
    return se3_exp(0.1 * np.sin(np.array([0.05, 0.02, 0.03, 0.04, 0.06, 0.02]) * n))


def frame(n: int, box_at: float | None) -> Frame:
    """A slanted wall, noise, a hole in what is known, and the front of a box whose middle is at `box_at` (world x)."""
    drawn, T = np.random.default_rng(n), pose(n)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], 2) @ T[:3, :3].T
    depth = (2.5 - np.array([0.3, -0.1, 1]) @ T[:3, 3]) / (rays @ np.array([0.3, -0.1, 1]))
    if box_at is not None:
        front = (1.4 - T[2, 3]) / rays[..., 2]
        x, y = (T[i, 3] + front * rays[..., i] for i in (0, 1))
        depth = np.where((np.abs(x - box_at) < 0.2) & (np.abs(y) < 0.25), front, depth)
    depth = (depth + drawn.normal(0, NOISE, depth.shape)).astype(np.float32)
    depth[20:30, 10 : 30 + n % 40] = 0
    depth[drawn.random(depth.shape) < 0.01] = 0
    return Frame(n, n, n / 30, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)


class Tracking:
    """Has the depth of no frame."""

    wanted = False

    def __init__(self) -> None:
        self.evidence = MoverEvidenceJob()

    def depth_address(self, depth: np.ndarray) -> int | None:
        return None

    def bring_evidence(self, wanted: bool) -> None:
        self.wanted = wanted


class Aligning(Tracking):
    """Has the depth, and makes the evidence at some pose."""

    def __init__(self, library: CudaLibrary) -> None:
        super().__init__()
        self._library = library

    def locate(self, frame: Frame, T: np.ndarray) -> None:
        device = self._library.whole_device(None)
        self.depth, self.on_device = frame.depth, torch.from_numpy(frame.depth.copy()).to(device)
        self.pose = torch.from_numpy(np.concatenate([T[:3, :3].ravel(), T[:3, 3]])).to(device)
        if self.wanted:
            self.evidence.depth, self.evidence.pose = self.on_device.data_ptr(), self.pose.data_ptr()
            self._library.functions.ggslam_cuda_mover_evidence_wait(self.evidence)

    def depth_address(self, depth: np.ndarray) -> int | None:
        return self.on_device.data_ptr() if depth is self.depth else None


class Recorded:
    """Keeps what a source of evidence says."""

    def __init__(self, detector: MoverDetector) -> None:
        self.found: list[Evidence | None] = []
        self._source, detector.source = detector.source, self
        self.prepare = self._source.prepare

    def look(self, *arguments: object) -> object:
        view, evidence = self._source.look(*arguments)  # type: ignore[arg-type]
        self.found.append(evidence)
        return view, evidence


def detector_of(library: CudaLibrary | None, tracking: Tracking | None = None) -> MoverDetector:
    detector = MoverDetector(SETTINGS)
    if library is not None:
        detector.source = CudaEvidence(tracking or Tracking(), library, library.whole_device(None))
    return detector


def check_view(found: object, expected: object) -> None:
    assert isinstance(found, CudaView)
    for name in IMAGES:
        one, two = getattr(found, name), getattr(expected, name)
        assert one.dtype == two.dtype and np.array_equal(one, two), name
    assert found.camera == expected.camera  # type: ignore[attr-defined]


def check_evidence(found: Evidence | None, expected: Evidence | None) -> None:
    """Places on the edge between two pixels or of a margin may differ by the rounding of a sum: none of 2,091 does, in
    any of these frames, where the core joins products and sums as this compiler does."""
    assert (found is None) == (expected is None)
    if found is None or expected is None:
        return
    for field in fields(Evidence):
        one, two = getattr(found, field.name), getattr(expected, field.name)
        assert one.dtype == two.dtype and one.shape == two.shape
        assert (one != two).mean() <= 0.002, field.name


def test_a_scene_with_a_mover_is_seen_as_by_the_core(cuda_library: CudaLibrary) -> None:
    """Also after a correction of the world, a swift frame, one that is lost, and more frames than views are kept."""
    mine, core = detector_of(cuda_library), detector_of(None)
    said = [Recorded(detector) for detector in (mine, core)]
    late = DetectorTuning.ages[-1] + 4
    world, masks = np.eye(4), 0
    for n in range(late + 12):
        box_at = None if n < 9 or 20 < n < late else -0.3 + 0.03 * ((n - 9) % 40)
        if n == 14:
            world = se3_exp(np.array([0.3, -0.2, 0.1, 0.02, 0.01, 0.4]))
            for detector in (mine, core):
                detector.move(world)
        for detector in (mine, core):
            T = None if n == 3 else world @ pose(n)
            detector.prepare(frame(n, box_at), MARGIN)
            detector.look(frame(n, box_at), T, MARGIN, CONTEXT, swift=n == 6)
        if n != 3:
            check_evidence(said[0].found[-1], said[1].found[-1])
            check_view(mine.views[-1], core.views[-1])
        assert len(mine.views) == len(core.views) and mine.segments == core.segments
        assert (mine.mask is None) == (core.mask is None)
        if mine.mask is not None and core.mask is not None:
            assert (mine.mask != core.mask).mean() < 0.002
            masks += 1
    assert masks > 10 and said[0].found.count(None) > 20
    assert np.array_equal(mine.trail.keys, core.trail.keys)
    for view, other in zip(mine.views, core.views, strict=True):
        assert np.array_equal(view.T_world_camera, other.T_world_camera)
        check_view(view, other)


def test_evidence_of_the_alignment_is_taken_if_it_is_of_this_frame(
    cuda_library: CudaLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At another pose, of another depth, with another margin or after a correction it is made anew."""
    tracking, core = Aligning(cuda_library), detector_of(None)
    mine = detector_of(cuda_library, tracking)
    made, make = [], CudaEvidence._make

    def note(self: CudaEvidence, *arguments: object) -> None:
        made.append(1)
        make(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(CudaEvidence, "_make", note)
    for n in range(20):
        now, margin, T = frame(n, None if n < 14 else 0.0), MARGIN, pose(n)
        shown = now
        made.clear()
        mine.prepare(now, margin)
        moved = np.array([[1, 0, 0, 0.02 * (n == 5)], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        tracking.locate(now, T @ moved)
        if n == 7:
            shown = frame(n + 100, None)
        if n == 9:
            margin = Margin(0.005, 0.0, 5.0, NOISE)
        if n == 11:
            mine.move(np.eye(4)), core.move(np.eye(4))
        mine.look(shown, T, margin, CONTEXT)
        core.look(shown, T, margin, CONTEXT)
        check_view(mine.views[-1], core.views[-1])
        assert (mine.found is None) == (core.found is None)
        assert bool(made) == (n in (5, 7, 9, 11) or n > 14), n
    assert mine.found is not None


def test_an_ordinary_frame_costs_nothing_of_its_own() -> None:
    """No wait, upload or call: what is found comes with the alignment. Views are read when asked
    for."""
    with DeviceWatch() as watch:
        library, device = library_and_device()
        tracking, detector = Aligning(library), MoverDetector(SETTINGS)
        detector.source = CudaEvidence(tracking, library, device)
        for n in range(5):
            now = frame(n, None)
            detector.prepare(now, MARGIN)
            tracking.locate(now, pose(n))
            watch.forget()
            detector.look(now, pose(n), MARGIN, CONTEXT)
            assert not watch.waits and not watch.uploads and not watch.calls, n
        view = detector.views[-1]
        assert len(detector.views) == 5 and view.T_world_camera.shape == (4, 4) and not watch.waits
        assert view.fits() and view.smooth.any() and len(watch.waits) == 1


def test_a_run_saves_what_the_host_would(cuda_library: CudaLibrary) -> None:
    """Views that were read hold what `CoarseView` does; a detector goes on from views of the host."""
    mine, core = detector_of(cuda_library), detector_of(None)
    for n in range(4):
        for detector in (mine, core):
            detector.look(frame(n, None), pose(n), MARGIN, CONTEXT)
    kept = [CoarseView(v.camera, v.T_world_camera, *(getattr(v, name) for name in IMAGES)) for v in mine.views]
    again = detector_of(cuda_library)
    again.views = kept
    for n in range(4, 8):
        for detector in (again, core):
            detector.prepare(frame(n, 0.0), MARGIN)
            detector.look(frame(n, 0.0), pose(n), MARGIN, CONTEXT)
        assert (again.mask is None) == (core.mask is None)
        assert again.mask is None or np.array_equal(again.mask, core.mask)  # by the core
    assert core.mask is not None
