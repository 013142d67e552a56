#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Tracks recordings without a mapper and prints how well and how fast.

    python scripts/benchmarks/bench_tracking.py ../shared/data/livingroom ../shared/data/redkitchen
    python scripts/benchmarks/bench_tracking.py ../shared/data/livingroom --target trained --photometric always
    python scripts/benchmarks/bench_tracking.py ../shared/data/livingroom --device cuda

What frames are aligned to (--target):
    surface  the keyframes' points as measured (`MeasuredSurface`), gathered keyframe by keyframe
    birth    a map of discs put in where the map does not yet explain a keyframe, as the mapper inserts them
    trained  the same with means moved by 1.5 mm in the plane and 0.5 mm along the normal, axes turned by 3 degrees and
             sizes changed by 30 %, a stand-in for the changes of training (real training moves Gaussians farther)
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))

import cv2
import numpy as np
import torch

from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import fit_similarity, inverse, transform_points
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.gicp import GicpTarget
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.photometric import GreyDepth, PhotometricReference, textured_points
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface, quaternions_from_normals
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

HELD_OUT_EVERY, HELD_OUT_OFFSET = 8, 4


# --- a stand-in for the mapper ---------------------------------------------------------------------------------------


class DiscMap:
    """Discs where the map does not yet explain a keyframe: one per pixel, 0.6 pixels wide, a fifth as thick."""

    def __init__(self, settings: TrackerSettings, noise: DepthNoise, context: NativeContext, trained: bool) -> None:
        self.settings, self.noise, self.context, self.trained = settings, noise, context, trained
        self.gaussians = GaussianMap(with_moments=False)
        self.camera_positions: list[np.ndarray] = []
        self.random = np.random.default_rng(0)

    def add(self, frame: Frame, T: np.ndarray) -> None:
        """Adds a keyframe at pose T_world_camera."""
        camera = frame.camera
        dense = dataclasses.replace(self.settings.points, count=camera.width * camera.height)
        found = extract_points(frame.depth, camera, dense, self.noise, self.context)
        u, v = found.pixels.T
        z = found.points[:, 2]
        known = explained_depth(self.gaussians, frame, T)[v, u]
        new = z < np.minimum(known - 0.05, known * 0.97)
        R = T[:3, :3]
        normals, scale = found.normals[new] @ R.T, 0.6 * z[new] / camera.fx
        means, quaternions = found.points[new] @ R.T + T[:3, 3], quaternions_from_normals(normals)
        log_scales = np.log(np.stack([scale, scale, 0.2 * scale], 1))
        if self.trained:
            means, quaternions, log_scales = perturbed(means, quaternions, log_scales, normals, self.random)
        self.gaussians.insert(
            *(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (means, quaternions, log_scales)),
            torch.full((len(means),), 2.0), torch.from_numpy(frame.color[v, u][new].astype(np.float32) / 255),
            birth_keyframe=len(self.camera_positions),
        )  # fmt: skip
        self.camera_positions.append(T[:3, 3])

    def target(self) -> GicpTarget:
        """What the tracker aligns to."""
        positions = np.array(self.camera_positions)
        return GicpTarget.from_gaussians(self.gaussians, self.settings.target, self.context, positions)


def explained_depth(gaussians: GaussianMap, frame: Frame, T_world_camera: np.ndarray) -> np.ndarray:
    """Depth of the nearest Gaussian about each pixel, infinite where the map has none, [H, W]."""
    camera = frame.camera
    T = inverse(T_world_camera).astype(np.float32)
    p = gaussians.means.numpy() @ T[:3, :3].T + T[:3, 3]
    p = p[p[:, 2] > 0.05]
    u = np.rint(camera.fx * p[:, 0] / p[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * p[:, 1] / p[:, 2] + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(depth, (v[inside], u[inside]), p[inside, 2])
    return cv2.erode(depth, np.ones((3, 3)))


def perturbed(
    means: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Discs moved, turned and resized a little."""
    move = rng.normal(0, 0.0015, means.shape)
    move -= (move * normals).sum(1, keepdims=True) * normals
    move += rng.normal(0, 0.0005, (len(means), 1)) * normals
    turned = quaternions + rng.normal(0, np.radians(3) / 2, quaternions.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return means + move, turned, log_scales + rng.normal(0, 0.3, log_scales.shape)


# --- one recording ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Run:
    """What was measured, frame by frame."""

    results: list[TrackingResult] = dataclasses.field(default_factory=list)
    truth: list[np.ndarray] = dataclasses.field(default_factory=list)
    track_ms: list[float] = dataclasses.field(default_factory=list)
    target_ms: list[float] = dataclasses.field(default_factory=list)
    extract_ms: list[float] = dataclasses.field(default_factory=list)
    align_ms: list[float] = dataclasses.field(default_factory=list)
    grey_residuals: list[float] = dataclasses.field(default_factory=list)
    kinds: Counter = dataclasses.field(default_factory=Counter)


def track_recording(
    path: Path, scale: float, target_kind: str, settings: TrackerSettings, threads: int | None, device: str = "cpu"
) -> Run:
    """Tracks every frame; keyframes (never the held-out frames) extend the target."""
    sequence, context = open_sequence(path, scale=scale), NativeContext(threads)
    engine = CudaTrackingEngine(sequence.camera) if device == "cuda" else None
    tracker, policy, run = GicpTracker(sequence.camera, settings, context, engine=engine), KeyframePolicy(), Run()
    surface, discs = MeasuredSurface(settings.target, context), None
    surface.finish = engine is None
    previous: PhotometricReference | None = None
    frames = list(sequence.stream())  # read first, so that decoding does not take the cores
    for frame in frames:
        target = tracker.target
        start = time.perf_counter()
        result = tracker.track(frame)
        run.track_ms.append(1e3 * (time.perf_counter() - start))
        run.results.append(result)
        if frame.T_world_camera is not None:
            run.truth.append(frame.T_world_camera)
        if target is not None and result.status is not TrackingStatus.LOST:
            time_parts(run, frame, tracker, target, result)
        previous = grey_residual(run, frame, result, previous, settings)
        lost = result.status is TrackingStatus.LOST
        if not lost and frame.index % HELD_OUT_EVERY != HELD_OUT_OFFSET and policy.decide(frame.index, result):
            run.kinds[policy.kind.value if policy.kind else ""] += 1
            if target_kind != "surface":
                assert tracker.noise is not None
                discs = discs or DiscMap(settings, tracker.noise, context, target_kind == "trained")
                discs.add(frame, result.T_world_camera)
            start = time.perf_counter()
            tracker.set_target(discs.target() if discs else surface.add(result.points, result.T_world_camera))
            run.target_ms.append(1e3 * (time.perf_counter() - start))
    return run


def time_parts(run: Run, frame: Frame, tracker: GicpTracker, target: GicpTarget, result: TrackingResult) -> None:
    """Times point extraction and one alignment by themselves (from the pose found, moved by half a centimetre)."""
    assert tracker.noise is not None
    s = tracker.settings
    start = time.perf_counter()
    points = tracker.engine.points(frame.depth, s.points, tracker.noise)
    len(points)  # a GPU's number is known when it is done
    middle = time.perf_counter()
    guess = result.T_world_camera.copy()
    guess[:3, 3] += 0.003
    tracker.engine.align(points, target, guess, s.align, tracker.noise)
    run.extract_ms.append(1e3 * (middle - start))
    run.align_ms.append(1e3 * (time.perf_counter() - middle))


def grey_residual(
    run: Run, frame: Frame, result: TrackingResult, reference: PhotometricReference | None, settings: TrackerSettings
) -> PhotometricReference:
    """Notes the mean absolute grey difference to a frame up to 10 frames earlier; returns the reference from now on."""
    view = GreyDepth.from_images(frame.color, frame.depth, frame.camera, 2)
    if reference is not None:
        points = textured_points(view, settings.photometric)
        residual = mean_difference(points.points, points.intensity, reference, result.T_world_camera)
        if np.isfinite(residual):
            run.grey_residuals.append(residual)
    if reference is None or frame.index % 10 == 0:
        return PhotometricReference.from_view(view, result.T_world_camera)
    return reference


def mean_difference(points: np.ndarray, grey: np.ndarray, reference: PhotometricReference, T: np.ndarray) -> float:
    """Mean absolute grey difference of points seen by the reference, after an offset between the images."""
    M, camera = inverse(reference.T_world_camera) @ T, reference.camera
    p = points @ M[:3, :3].T + M[:3, 3]
    z = np.where(p[:, 2] > 0.05, p[:, 2], np.inf)
    u = (camera.fx * p[:, 0] / z + camera.cx).astype(np.float32)
    v = (camera.fy * p[:, 1] / z + camera.cy).astype(np.float32)
    inside = np.isfinite(z) & (u > 0) & (v > 0) & (u < camera.width - 1) & (v < camera.height - 1)
    if inside.sum() < 100:
        return float("nan")
    seen = cv2.remap(np.ascontiguousarray(reference.pixels[..., 0]), u[None], v[None], cv2.INTER_LINEAR)[0]
    depth = reference.pixels[np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int), 3]
    visible = (depth > 0) & (np.abs(depth - z[inside]) < 0.05 * z[inside])
    difference = (seen - grey)[inside][visible]
    return float(np.abs(difference - np.median(difference)).mean()) if visible.sum() >= 100 else float("nan")


def ate_rmse(estimated: np.ndarray, true: np.ndarray) -> float:
    """Root mean square distance of camera centres [n, 4, 4] after the best rigid alignment, metres."""
    x, y = estimated[:, :3, 3], true[:, :3, 3]
    return float(np.sqrt(((transform_points(x, fit_similarity(x, y)[0]) - y) ** 2).sum(1).mean()))


# --- table -----------------------------------------------------------------------------------------------------------


def report(name: str, target_kind: str, run: Run) -> None:
    """Prints one row of the table and, under it, where the tracker was lost."""
    estimated = np.stack([r.T_world_camera for r in run.results])
    ate = f"{100 * ate_rmse(estimated, np.stack(run.truth)):8.3f}" if len(run.truth) == len(estimated) else "       -"
    aligned = [r.alignment for r in run.results if r.alignment is not None]
    statuses = Counter(r.status.value for r in run.results)
    print(
        f"{name[:14]:14s} {target_kind:8s} {len(estimated):5d} {ate} {np.median(run.track_ms):7.1f} "
        f"{np.median(run.extract_ms):7.1f} {np.median(run.align_ms):7.1f} {np.median(run.target_ms):7.1f} "
        f"{np.mean([a.iterations for a in aligned]):6.1f} {np.mean([a.overlap for a in aligned]):7.3f} "
        f"{min(a.overlap for a in aligned):5.2f} {1e3 * np.mean([a.rmse for a in aligned]):6.2f} "
        f"{255 * np.mean(run.grey_residuals) if run.grey_residuals else 0:6.2f}  "
        f"{sum(run.kinds.values())} keyframes, {', '.join(f'{n} {k}' for k, n in sorted(statuses.items()))}",
        flush=True,
    )
    for i, result in enumerate(run.results):
        if result.status is TrackingStatus.LOST:
            print(f"    frame {i} lost: {result.reason}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--scale", type=float, default=0.5, help="image size (default 0.5)")
    parser.add_argument("--target", nargs="+", default=["surface"], choices=["surface", "birth", "trained"])
    parser.add_argument("--photometric", nargs="+", default=["auto"], choices=["never", "degenerate", "auto", "always"])
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where points are taken and aligned")
    arguments = parser.parse_args()
    print("recording      target   frames  ATE cm   track extract   align  target   iter overlap   min   rmse   grey")
    print("                               RMSE     ms med. ms med. ms med. ms med.                       mm /255")
    for mode in arguments.photometric:
        base = TrackerSettings()
        settings = dataclasses.replace(base, photometric=dataclasses.replace(base.photometric, mode=mode))
        print(f"grey values: {mode}")
        for path in arguments.recordings:
            for kind in arguments.target:
                run = track_recording(path, arguments.scale, kind, settings, arguments.threads, arguments.device)
                report(path.name, kind, run)


if __name__ == "__main__":
    main()
