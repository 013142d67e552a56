#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Compares the two front-ends, G-ICP and edges and planes, without a mapper: error, time, and whether the maps agree.

    python scripts/benchmarks/bench_frontends.py ../shared/data
    python scripts/benchmarks/bench_frontends.py ../shared/data --recordings livingroom --stop 100 --budget-ms 5

Time is that of `track`: from the image to the pose and, for edges and planes, to the grown local map; what G-ICP's
target costs at keyframes is shown apart. "in cap" is the share of frames within the budget by the wall clock, which on
a busy machine other programs spoil; the processor time beside it does not include waiting. "per 100" is the mean time
of frames 0-99, 100-199, ...: whether tracking slows down as the map grows. With --device cuda both front-ends run on a
GPU as well, where nothing limits their time, and the share of it that this saves is printed.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "tracking"))

import numpy as np
import torch
from feature_odometry import FeatureOdometry, LidarFeatures, split_features
from worlds.pose_graph import read_pose_graph

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.formats.raw_points import read_raw_points
from ggslam.geometry.icp import register
from ggslam.geometry.normals import estimate_normals
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, so3_log
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.cuda.features import CudaFeatures
from ggslam.tracking.edges_planes.extraction import ScanFeatures
from ggslam.tracking.edges_planes.settings import LIDAR, ExtractionSettings, FeatureTrackerSettings
from ggslam.tracking.edges_planes.tracker import FeatureTracker
from ggslam.tracking.gicp import GicpTarget, align
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise, TargetSettings, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface, quaternions_from_normals
from ggslam.tracking.tracker import Tracker, TrackingStatus

LIDAR_NOISE = DepthNoise(0.02, 0.0)
LIDAR_VOXEL = 0.5
LIDAR_ALIGN = dataclasses.replace(TrackerSettings().align, coarse_iterations=30, fine_iterations=30)
WINDOW = 100
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
MAP_SPACING = 0.02


@dataclasses.dataclass
class Run:
    """What was measured, frame by frame: poses, milliseconds of wall clock and processor, status, points of the map."""

    poses: list[np.ndarray] = dataclasses.field(default_factory=list)
    truth: list[np.ndarray] = dataclasses.field(default_factory=list)
    wall_ms: list[float] = dataclasses.field(default_factory=list)
    cpu_ms: list[float] = dataclasses.field(default_factory=list)
    target_ms: list[float] = dataclasses.field(default_factory=list)
    lost: int = 0
    cloud: list[np.ndarray] = dataclasses.field(default_factory=list)

    def timed(self, call: Callable[[Item], Outcome], item: Item) -> Outcome:
        """Notes how long a call takes."""
        wall, cpu = time.perf_counter(), time.process_time()
        result = call(item)
        self.wall_ms.append(1e3 * (time.perf_counter() - wall))
        self.cpu_ms.append(1e3 * (time.process_time() - cpu))
        return result


# --- depth cameras ---------------------------------------------------------------------------------------------------


def track_frames(frames: Iterable[Frame], tracker: Tracker, context: NativeContext) -> Run:
    """Tracks every frame; keyframes extend the target of G-ICP."""
    run, policy, surface = Run(), KeyframePolicy(), MeasuredSurface(TargetSettings(), context)
    # A device makes the voxels' shapes itself.
    surface.finish = not (isinstance(tracker, GicpTracker) and isinstance(tracker.engine, CudaTrackingEngine))
    for frame in frames:
        result = run.timed(tracker.track, frame)
        run.poses.append(result.T_world_camera)
        run.truth.append(np.full((4, 4), np.nan) if frame.T_world_camera is None else frame.T_world_camera)
        if result.status is TrackingStatus.LOST:
            run.lost += 1
        elif policy.decide(frame.index, result):
            T = result.T_world_camera
            run.cloud.append(result.points.read().points @ T[:3, :3].T + T[:3, 3])
            if not isinstance(tracker, FeatureTracker):
                start = time.perf_counter()
                tracker.set_target(surface.add(result.points, T))
                run.target_ms.append(1e3 * (time.perf_counter() - start))
    return run


def run_recording(path: Path, arguments: argparse.Namespace) -> None:
    """Both front-ends on one recording of a depth camera."""
    sequence, context = open_sequence(path, scale=arguments.scale), NativeContext(arguments.threads)
    frames = []  # read first, so that decoding does not take the cores
    for frame in sequence.stream():
        if arguments.stop and frame.index >= arguments.stop:
            break
        frames.append(frame)
    extraction = ExtractionSettings(segment_angle_deg=arguments.segments)
    features = with_budget(FeatureTrackerSettings(extraction=extraction), arguments.budget_ms)
    runs = []
    for name, tracker in make_trackers(sequence.camera, features, context, arguments.device).items():
        run = track_frames(frames, tracker, context)
        scores = score_trajectory(run.poses, run.truth)
        error = f"{100 * scores.ate_rmse_m:9.3f}" if scores else "        -"
        report(path.name, name, error, run, 0.0 if "GPU" in name else arguments.budget_ms)
        runs.append(run)
    print(f"    maps: {map_agreement(runs[1], runs[0])}", flush=True)
    for name, host, device in zip(("gicp", "features"), runs, runs[2:], strict=False):
        saved = 1 - np.mean(device.wall_ms[1:]) / np.mean(host.wall_ms[1:])
        apart = max(float(np.linalg.norm(p[:3, 3] - q[:3, 3])) for p, q in zip(device.poses, host.poses, strict=True))
        print(f"    {name}: {saved:.0%} less time on the GPU, poses within {1e3 * apart:.3f} mm of the CPU's")


def make_trackers(
    camera: Camera, features: FeatureTrackerSettings, context: NativeContext, device: str
) -> dict[str, Tracker]:
    """Both front-ends by name, on the CPU and, if that is the device, on the GPU."""
    trackers: dict[str, Tracker] = {
        "gicp": GicpTracker(camera, context=context),
        "features": FeatureTracker(camera, features=features, context=context),
    }
    if device == "cuda":
        trackers["gicp, GPU"] = GicpTracker(camera, context=context, engine=CudaTrackingEngine(camera))
        engine = CudaFeatures(features, CudaTrackingEngine(camera))
        trackers["feat., GPU"] = FeatureTracker(camera, features=features, context=context, engine=engine)
    return trackers


def map_agreement(run: Run, reference: Run) -> str:
    """How the map of one run lies upon that of another, after the best rigid motion."""
    found = register(thin(np.concatenate(run.cloud)), thin(np.concatenate(reference.cloud)))
    return (
        f"fitness {found.overlap.fitness:.3f}, inlier RMSE {1e3 * found.overlap.inlier_rmse_m:.1f} mm, "
        f"moved {1e3 * found.moved_m:.1f} mm and {found.turned_deg:.2f} degrees"
    )


def thin(points: np.ndarray) -> np.ndarray:
    """One point per voxel."""
    _, first = np.unique(np.floor(points / MAP_SPACING).astype(np.int64), axis=0, return_index=True)
    return points[first]


# --- LiDAR -----------------------------------------------------------------------------------------------------------


class LidarGicp:
    """G-ICP for LiDAR scans: points with normals from their neighbours, target grown scan by scan."""

    def __init__(self, context: NativeContext, T_world_sensor: np.ndarray) -> None:
        self.context, self.pose, self.velocity = context, T_world_sensor, np.eye(4)
        self.target: GicpTarget | None = None

    def locate(self, cloud: FramePoints) -> None:
        """Locates a scan and adds it."""
        if self.target is not None:
            guess = self.pose @ self.velocity
            found = align(cloud, self.target, guess, LIDAR_ALIGN, LIDAR_NOISE, self.context)
            self.velocity, self.pose = inverse(self.pose) @ found.T_world_camera, found.T_world_camera
        R, t = self.pose[:3, :3], self.pose[:3, 3]
        scales = np.log(np.full((len(cloud), 3), LIDAR_VOXEL / 5) * [1.0, 1.0, 0.1])
        arrays = (cloud.points @ R.T + t, quaternions_from_normals(cloud.normals @ R.T), scales, np.full(len(cloud), 3))
        means, quaternions, log_scales, logits = (np.ascontiguousarray(a, np.float32) for a in arrays)
        self.target = GicpTarget.from_arrays(
            means, quaternions, log_scales, logits, TargetSettings(voxel=LIDAR_VOXEL), self.context, base=self.target
        )


def cloud_points(points: np.ndarray) -> FramePoints:
    """Points with normals and regularised covariances (equation 1 of GS-ICP: a disc)."""
    normals = estimate_normals(points)
    normals *= -np.sign((normals * points).sum(1, keepdims=True))
    n = normals[:, :, None] * normals[:, None, :]
    shape = np.eye(3) - 0.99 * n
    six = np.stack([shape[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)
    p, normals, six = (np.ascontiguousarray(a, np.float32) for a in (points, normals, six))
    return FramePoints(p, normals, six, np.zeros((len(p), 2), np.int32), np.ones(len(p), np.float32))


def run_lidar(
    name: str, scans: list[ScanFeatures], clouds: list[np.ndarray], truth: list[np.ndarray], budget_ms: float,
    arguments: argparse.Namespace,
) -> None:  # fmt: skip
    """Both front-ends on LiDAR scans whose first pose is known."""
    gicp, run = LidarGicp(NativeContext(arguments.threads), truth[0]), Run(truth=truth)
    for points in [cloud_points(cloud) for cloud in clouds]:
        run.timed(gicp.locate, points)
        run.poses.append(gicp.pose)
    report(name, "gicp", pose_error(run), run, budget_ms)
    odometry = FeatureOdometry(with_budget(LIDAR, budget_ms), truth[0])
    run = Run(truth=truth)
    for scan in scans:
        odometry.map.clock.start()
        found = run.timed(odometry.locate, scan)
        run.lost += found is not None and not odometry.map.is_convincing(found)
        run.poses.append(odometry.T_world_sensor)
    report(name, "features", pose_error(run), run, budget_ms)


def run_college(folder: Path, budget_ms: float, arguments: argparse.Namespace) -> None:
    """Five scans a metre apart, already split in edges and planes."""
    truth = list(read_pose_graph(folder / "graph.txt").values())
    names = [f"{10 * i:06d}.bin" for i in range(len(truth))]
    pairs = [(read_raw_points(folder / f"planes_{n}", 3), read_raw_points(folder / f"edges_{n}", 3)) for n in names]
    scans = [split_features(planes, edges, LIDAR_NOISE) for planes, edges in pairs]
    run_lidar(folder.name, scans, [np.concatenate(pair) for pair in pairs], truth, budget_ms, arguments)


def run_pair(folder: Path, budget_ms: float, arguments: argparse.Namespace) -> None:
    """Two scans of a sensor with 32 rings."""
    T = np.loadtxt(folder / "T_target_source.txt")
    clouds = [read_point_cloud(folder / f"{name}.ply").points for name in ("target", "source")]
    clouds = [cloud[np.abs(cloud).sum(1) > 0] for cloud in clouds]
    extractor = LidarFeatures(32, 2160, LIDAR.extraction, LIDAR_NOISE)
    scans = [extractor.extract(cloud) for cloud in clouds]
    run_lidar(folder.name, scans, [cloud[::4] for cloud in clouds], [np.eye(4), T], budget_ms, arguments)


def pose_error(run: Run) -> str:
    """Root mean square error of the later positions, and the greatest of the angles."""
    errors = [inverse(Q) @ P for P, Q in zip(run.poses[1:], run.truth[1:], strict=True)]
    centimetres = 100 * np.sqrt(np.mean([np.sum(E[:3, 3] ** 2) for E in errors]))
    return f"{centimetres:9.3f}" + f" ({max(np.degrees(np.linalg.norm(so3_log(E[:3, :3]))) for E in errors):.2f} deg)"


# --- table -----------------------------------------------------------------------------------------------------------


def with_budget(settings: FeatureTrackerSettings, budget_ms: float) -> FeatureTrackerSettings:
    """Settings with another budget."""
    return dataclasses.replace(settings, align=dataclasses.replace(settings.align, budget_ms=budget_ms))


def report(recording: str, front_end: str, error: str, run: Run, budget_ms: float) -> None:
    """Prints one row; the first frame, which is not located, does not count for the times."""
    wall, cpu = np.array(run.wall_ms[1:]), np.array(run.cpu_ms[1:])
    windows = [np.array(run.wall_ms[i : i + WINDOW]) for i in range(0, len(run.wall_ms), WINDOW)]
    growth = " ".join(f"{w.mean():.1f}" for w in windows) if len(windows) > 1 else "-"
    in_cap = f"{(wall <= budget_ms).mean():6.1%}" if budget_ms else "     -"
    target = f"{np.mean(run.target_ms):6.1f}" if run.target_ms else "     -"
    print(
        f"{recording[:22]:22s} {front_end:10s} {len(run.poses):6d} {run.lost:4d} {error:22s} {wall.mean():7.1f} "
        f"{np.percentile(wall, 95):7.1f} {cpu.mean():7.1f} {in_cap} {target}  {growth}",
        flush=True,
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the recordings, with clouds/ for the LiDAR ones")
    parser.add_argument("--recordings", nargs="*", default=["redkitchen", "livingroom"], help="of depth cameras")
    parser.add_argument("--no-lidar", action="store_true", help="leave out the LiDAR scans")
    parser.add_argument("--scale", type=float, default=0.5, help="image size (default 0.5)")
    parser.add_argument("--stop", type=int, default=0, help="frames of each recording; 0: all")
    parser.add_argument("--budget-ms", type=float, default=10.0, help="of edges and planes per frame (0: no limit)")
    parser.add_argument("--segments", type=float, default=0.0, help="angle of scan segments, degrees (0: none)")
    parser.add_argument("--threads", type=int, default=None, help="of G-ICP")
    parser.add_argument("--torch-threads", type=int, default=1, help="of edges and planes (default 1)")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"], help="cuda: depth cameras on a GPU, too")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.torch_threads)
    print(
        "recording              front      frames lost  error cm               ms mean    95 %  cpu ms in cap target  "
        "per 100"
    )
    for name in arguments.recordings:
        run_recording(arguments.data / name, arguments)
    if not arguments.no_lidar:
        for budget in dict.fromkeys((arguments.budget_ms, 0.0)):
            print(f"LiDAR, edges and planes with {f'{budget:g} ms' if budget else 'unlimited time'}")
            run_college(arguments.data / "clouds" / "newer_college_features", budget, arguments)
            run_pair(arguments.data / "clouds" / "scan_pair", budget, arguments)


if __name__ == "__main__":
    main()
