#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How far a run's points lie from the surface: those of its keyframes' rendered depth beside discs of its Gaussians.

    ggslam run livingroom --scale 0.5 --out runs/livingroom
    python scripts/benchmarks/bench_points.py runs/livingroom                        # its recording has exact depth
    ggslam synth room_exact --no-noise                                    # the room of the demo without noise
    python scripts/benchmarks/bench_points.py demo/run --exact room_exact
    python scripts/benchmarks/bench_points.py runs/redkitchen --fused                # against measured depth, fused

Exact: the surface is the depth of every second frame at its full size and true pose, thinned to voxels of 2.5 mm.
--fused: it is that of a TSDF of all frames at the run's poses, in voxels of 1 cm; points whose depth no frame measured
are left out, as `ggslam eval` does. Both kinds of points come from the run's folder alone, in voxels of 1 cm. Distances
of exact depth are those to the nearest sample, of fused depth those to the tangent plane there. Bytes are those of a
G-PCC stream, lossless in geometry, with colours. Seconds and memory (beyond that of the process with the map) are each
measured in a process of its own.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

import ggslam
from ggslam.coding import CodecSettings
from ggslam.evaluation.surface import SurfaceScores, score_surface
from ggslam.formats.point_ply import GRID_FILE, write_points_in_parts
from ggslam.formats.voxel_cloud import VoxelCloud, join_clouds
from ggslam.geometry.voxels import voxel_keys
from ggslam.jobs.encode.coding import encode_file
from ggslam.jobs.eval.surface import SurfaceScorer
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_points import map_points
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.process_memory import peak_memory_mb

VOXEL = 0.01
FINE = 0.0025
"""Edge of the voxels that exact depth is thinned to, metres."""
EVERY = 2
TITLES = ("points", "number", "median cm", "95 % cm", "P 1 cm", "R 1 cm", "F1 1 cm", "P 2 cm", "R 2 cm", "F1 2 cm",
          "KB coded", "seconds", "MB")  # fmt: skip


@dataclass(frozen=True)
class Sampled:
    """A cloud, and what it took: seconds, and MB beyond those that were in use with the map."""

    cloud: VoxelCloud
    seconds: float
    megabytes: float


def sample(run: Path, discs: bool, answer: multiprocessing.connection.Connection) -> None:
    """Samples a run's points in a process of its own."""
    RunFolder(run).gaussians()
    before = peak_memory_mb()
    started = time.perf_counter()
    clouds = list(map_points(run, VOXEL, discs))
    seconds = time.perf_counter() - started
    answer.send(Sampled(join_clouds(clouds), seconds, peak_memory_mb() - before))


def sampled(run: Path, discs: bool) -> Sampled:
    """See `sample`."""
    ours, theirs = multiprocessing.Pipe()
    worker = multiprocessing.get_context("spawn").Process(target=sample, args=(run, discs, theirs))
    worker.start()
    found: Sampled = ours.recv()
    worker.join()
    return found


def exact_surface(run: RunFolder, recording: Path) -> np.ndarray:
    """Exact depth of the run's frames in its world, [n, 3] metres."""
    sequence = ggslam.open_sequence(recording)
    truth, record = sequence.ground_truth, run.keyframes()
    if truth is None:
        sys.exit(f"{recording}: has no true poses")
    sources = {frame.frame: frame.source for frame in record.frames if not frame.is_lost and frame.source is not None}
    T_run_world = inverse(np.asarray(truth[sources[record.keyframes[0].frame]]))
    points = np.empty((0, 3))
    for source in sorted(sources.values())[::EVERY]:
        frame = sequence.frame(source, masks=False)
        seen = frame.camera.back_project(frame.depth)[frame.depth > 0].astype(np.float64)
        points = np.concatenate([points, transform_points(seen, T_run_world @ truth[source])])
        points = points[np.unique(voxel_keys(points, FINE), return_index=True)[1]]
    return points


def against_exact(cloud: VoxelCloud, surface: np.ndarray) -> SurfaceScores:
    """Scores, by distances to the nearest sample; the surface's samples count once a voxel of 1 cm."""
    thin = surface[np.unique(voxel_keys(surface, VOXEL), return_index=True)[1]]
    to_surface = score_surface(cloud.points, surface, np.zeros_like(surface), spacing=-1.0)
    back = score_surface(cloud.points, thin, np.zeros_like(thin), spacing=-1.0)
    joint = []
    for near, far in zip(to_surface.thresholds, back.thresholds, strict=True):
        f1 = 2 * near.precision * far.recall / max(near.precision + far.recall, 1e-9)
        joint.append(type(near)(near.threshold_m, near.precision, far.recall, f1))
    return SurfaceScores(to_surface.median_m, to_surface.p95_m, tuple(joint), len(cloud))


def coded_bytes(cloud: VoxelCloud) -> int:
    """Of the cloud as a G-PCC stream."""
    with tempfile.TemporaryDirectory() as folder:
        write_points_in_parts(folder, [cloud])
        encode_file(Path(folder) / GRID_FILE, Path(folder) / "points.bin", CodecSettings())
        return (Path(folder) / "points.bin").stat().st_size


def row(name: str, found: Sampled, scores: SurfaceScores) -> list[str]:
    """Of the table."""
    shares = [f"{100 * share:.1f}" for t in scores.thresholds for share in (t.precision, t.recall, t.f1)]
    return [name, str(len(found.cloud)), f"{100 * scores.median_m:.2f}", f"{100 * scores.p95_m:.2f}", *shares,
            f"{coded_bytes(found.cloud) / 1e3:.0f}", f"{found.seconds:.1f}", f"{found.megabytes:.0f}"]  # fmt: skip


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--exact", type=Path, help="recording with exact depth (default: the run's own)")
    parser.add_argument("--fused", action="store_true", help="against the run's own recording, fused")
    given = parser.parse_args()
    run = RunFolder.open(given.run)
    print(" | ".join(TITLES))
    surface = None if given.fused else exact_surface(run, given.exact or Path(run.sequence().open.path))
    for name, discs in (("discs", True), ("surface", False)):
        found = sampled(run.path, discs)
        if surface is not None:
            scores = against_exact(found.cloud, surface)
        else:
            scorer, poses = SurfaceScorer(run, found.cloud), run.keyframes().poses()
            for frame in open_recording_of(run).stream(masks=False):
                if frame.index in poses:
                    scorer.add(frame, poses[frame.index])
            scores = scorer.surface_scores()
        print(" | ".join(row(name, found, scores)), flush=True)


if __name__ == "__main__":
    main()
