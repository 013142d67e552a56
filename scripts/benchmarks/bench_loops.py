#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How well old keyframes are found again, how sure verification is, and what the pose graph takes.

    python scripts/benchmarks/bench_loops.py ../shared/data/redkitchen ../shared/data/livingroom
    python scripts/benchmarks/bench_loops.py ../shared/data/redkitchen --parts verification
    python scripts/benchmarks/bench_loops.py --parts graph
    ggslam synth demo/loop --scene loop && python scripts/benchmarks/bench_loops.py demo/loop --scale 1 --parts closing

Parts:
    retrieval     every keyframe asks an index of all recordings' earlier keyframes, its neighbours in time left out. A
                  hit sees the same place: both views' depth images show at least 40 % of each other's surface, by true
                  poses. Keyframes of another recording are never hits.
    growth        time of a query against the number of keyframes; what the recordings do not give is made of their
                  frames mirrored and inverted.
    verification  pairs of keyframes, with and without a common place, and errors of the closures that were accepted
    graph         circuits of 20 m with drift, true closures and three false ones
    closing       whole runs with loops and without: ATE, and what closing does to the first room's views
    localization  the first 120 frames are mapped; starts in that map from later frames, without a pose
    cut           a run without frames 100 to 159
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
from loop_runs import closing, cut, localization

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.features.orb import FeatureView
from ggslam.loops.places import Place, PlaceIndex
from ggslam.loops.pose_graph import GraphResult, PoseGraph
from ggslam.loops.settings import VerificationSettings
from ggslam.loops.verification import LocalMap, Verification, verify
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, so3_log
from ggslam.sequences.factory import open_sequence
from ggslam.tracking.gicp import align
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.points import FramePoints, extract_points
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface

SAME_PLACE = 0.4
NEIGHBOURS = 2
"""Keyframes before and after the old one whose points make its local map."""


@dataclass(frozen=True)
class Keyframes:
    """Every stride-th frame of a recording, and how much of each other's surface they see [n, n]."""

    name: str
    camera: Camera
    frames: list[Frame]
    overlap: np.ndarray
    gap: int
    """Keyframes nearer than this in time are neighbours."""


def read_keyframes(path: Path, scale: float, stride: int, gap_frames: int) -> Keyframes:
    """Raises SystemExit if the recording has no true poses."""
    sequence = open_sequence(path, scale=scale, stride=stride)
    frames = [f for f in sequence.stream() if f.T_world_camera is not None]
    if not frames:
        raise SystemExit(f"{path}: true poses are needed to know which frames see the same place")
    gap = max(2, round(gap_frames / stride))
    return Keyframes(sequence.name, sequence.camera, frames, mutual_overlap(frames, sequence.camera), gap)


def mutual_overlap(frames: Sequence[Frame], camera: Camera) -> np.ndarray:
    """The smaller share of two views' points that the other one sees at the same depth, float64 [n, n]."""
    step = max(1, camera.width // 40)
    clouds = []
    for frame in frames:
        points = camera.back_project(frame.depth)[::step, ::step].reshape(-1, 3).astype(float)
        clouds.append(points[points[:, 2] > 0])
    shares = np.zeros((len(frames), len(frames)))
    for i, cloud in enumerate(clouds):
        for j, other in enumerate(frames):
            shares[i, j] = _share_seen(cloud, inverse(other.T_world_camera) @ frames[i].T_world_camera, other, camera)
    return np.minimum(shares, shares.T)


def _share_seen(cloud: np.ndarray, T: np.ndarray, other: Frame, camera: Camera) -> float:
    p = cloud @ T[:3, :3].T + T[:3, 3]
    z = np.where(p[:, 2] > 0.1, p[:, 2], 1.0)
    u = np.rint(camera.fx * p[:, 0] / z + camera.cx).astype(int)
    v = np.rint(camera.fy * p[:, 1] / z + camera.cy).astype(int)
    inside = (p[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    depth = other.depth[v.clip(0, camera.height - 1), u.clip(0, camera.width - 1)]
    seen = inside & (depth > 0) & (np.abs(depth - z) < 0.05 * z + 0.02)
    return float(seen.mean()) if len(seen) else 0.0


# --- retrieval -------------------------------------------------------------------------------------------------------


def retrieval(recordings: Sequence[Keyframes]) -> None:
    """Prints precision and recall, and times."""
    print("retrieval      queries  top-1 right  top-5 has one  top-5 right  places found  describe    add  query")
    print("             with a hit          %              %            %             %   ms med. ms med. ms med.")
    names = [(r, k) for r in range(len(recordings)) for k in range(len(recordings[r].frames))]
    index = PlaceIndex(recordings[0].camera)
    for number_of_recording, recording in enumerate(recordings):
        rows: list = []
        times = []
        for k, frame in enumerate(recording.frames):
            number = len(index)

            def excluded(other: int, k: int = k, own: int = number_of_recording, gap: int = recording.gap) -> bool:
                return names[other][0] == own and abs(names[other][1] - k) < gap

            t0 = time.perf_counter()
            place = _describe(recording, frame)
            t1 = time.perf_counter()
            found = [names[m.number] for m in index.query(place, 5, excluded)]
            t2 = time.perf_counter()
            index.add(number, place)
            times.append((t1 - t0, time.perf_counter() - t2, t2 - t1))
            hits = set(np.flatnonzero(recording.overlap[k, : max(0, k - recording.gap + 1)] > SAME_PLACE).tolist())
            right = [own == number_of_recording and j in hits for own, j in found]
            if hits:
                rows.append((right[:1] == [True], any(right), np.mean(right or [0]), sum(right) / min(5, len(hits))))
        _print_retrieval(recording.name, rows, times)


def _describe(recording: Keyframes, frame: Frame) -> Place:
    view = FeatureView(frame.color, frame.depth, np.eye(4))
    return PlaceIndex(recording.camera).describe(view)


def _print_retrieval(name: str, rows: list, times: list) -> None:
    ms = 1e3 * np.median(times, axis=0)
    shares = 100 * np.mean(rows, axis=0) if rows else np.full(4, np.nan)
    print(
        f"{name[:14]:14s} {len(rows):7d} {shares[0]:12.1f} {shares[1]:14.1f} {shares[2]:12.1f} {shares[3]:13.1f} "
        f"{ms[0]:9.1f} {ms[1]:6.2f} {ms[2]:6.1f}",
        flush=True,
    )


def growth(recordings: Sequence[Keyframes], sizes: Sequence[int] = (100, 300, 1000, 3000)) -> None:
    """Prints the time of a query against the number of keyframes."""
    print("growth       keyframes  words  ms a query (median)  saved MB")
    camera = recordings[0].camera
    frames = [f for r in recordings if r.camera == camera for f in r.frames]
    index, queries = PlaceIndex(camera), [PlaceIndex(camera).describe(_variant(f, 0)) for f in frames[::5]]
    for number in range(min(max(sizes), 64 * len(frames))):
        index.add(number, index.describe(_variant(frames[number % len(frames)], number // len(frames))))
        if len(index) in sizes:
            times = [_seconds_of_query(index, query) for query in queries]
            size = sum(a.nbytes for a in index.to_arrays().values()) / 1e6
            words = np.mean([len(index[k].words) for k in range(len(index))])
            print(f"{'':12s} {len(index):9d} {words:6.0f} {1e3 * np.median(times):20.2f} {size:9.1f}", flush=True)


def _seconds_of_query(index: PlaceIndex, query: Place) -> float:
    start = time.perf_counter()
    index.query(query, 5)
    return time.perf_counter() - start


def _variant(frame: Frame, kind: int) -> FeatureView:
    """The frame turned to look like another place: mirrored, inverted, its colours mixed, one way per bit."""
    color, depth = frame.color, frame.depth
    if kind & 1:
        color, depth = color[:, ::-1], depth[:, ::-1]
    if kind & 2:
        color, depth = color[::-1], depth[::-1]
    if kind & 4:
        color = 255 - color
    if kind & 56:  # moved by half a scale of the detector's pyramid and more
        shift = 7 * (kind >> 3)
        color, depth = np.roll(color, (shift, 3 * shift), (0, 1)), np.roll(depth, (shift, 3 * shift), (0, 1))
        color = np.bitwise_xor(color, np.uint8(37 * (kind >> 3)))
    return FeatureView(np.ascontiguousarray(color), np.ascontiguousarray(depth), np.eye(4))


# --- verification ----------------------------------------------------------------------------------------------------


def verification(recordings: Sequence[Keyframes], pairs: int = 600) -> None:
    """Prints how many pairs of keyframes are accepted by true overlap, and how wrong the accepted ones are."""
    print(
        "verification    pairs  accepted  of overlap > 0.3  > 0.5  > 0.7   error m max     degrees max  ms  ms accepted"
    )
    context, settings = NativeContext(), TrackerSettings()
    places = [[_describe(r, frame) for frame in r.frames] for r in recordings]
    noises = [estimate_noise(r.frames[0].depth, r.camera) or DepthNoise() for r in recordings]
    points = [
        [extract_points(f.depth, r.camera, settings.points, noise, context) for f in r.frames]
        for r, noise in zip(recordings, noises, strict=True)
    ]
    random = np.random.default_rng(0)
    for k, recording in enumerate(recordings):
        near = np.abs(np.subtract.outer(*2 * [np.arange(len(recording.frames))])) < recording.gap
        candidates = np.argwhere(~near & np.tri(len(near), dtype=bool))
        rows = []
        for new, old in random.permutation(candidates)[:pairs].tolist():
            truth = inverse(recording.frames[old].T_world_camera) @ recording.frames[new].T_world_camera
            found, seconds = _verify(recording, places[k], points[k], noises[k], old, new, context, settings)
            rows.append((recording.overlap[new, old], found, *_errors(found, truth), seconds))
        _print_verification(recording.name, rows)
    _foreign(recordings, places, points, noises, context, settings)


def _verify(
    recording: Keyframes, places: list[Place], points: list[FramePoints], noise: DepthNoise, old: int, new: int,
    context: NativeContext, settings: TrackerSettings, foreign: tuple[Place, FramePoints] | None = None,
) -> tuple[Verification, float]:  # fmt: skip
    """The pair (old, new), or an old keyframe with the view of another recording; and the seconds it took."""
    surface, cloud = MeasuredSurface(settings.target, context), []
    for k in range(max(0, old - NEIGHBOURS), min(len(points), old + NEIGHBOURS + 1)):
        T = inverse(recording.frames[old].T_world_camera) @ recording.frames[k].T_world_camera
        surface.add(points[k], T)
        cloud.append(points[k].points @ T[:3, :3].T + T[:3, 3])
    target = surface.target
    assert target is not None
    place, own = foreign or (places[new], points[new])
    start = time.perf_counter()
    found = verify(
        LocalMap(places[old].landmarks, np.concatenate(cloud)), LocalMap(place.landmarks, own.points),
        recording.camera, noise.sigma, lambda T: align(own, target, T, settings.align, noise, context),
        VerificationSettings(),
    )  # fmt: skip
    return found, time.perf_counter() - start


def _foreign(
    recordings: Sequence[Keyframes], places: list, points: list, noises: list, context: NativeContext,
    settings: TrackerSettings,
) -> None:  # fmt: skip
    """Keyframes of other recordings: all to be refused."""
    random, accepted, tried = np.random.default_rng(1), 0, 0
    for k, recording in enumerate(recordings):
        for other in (o for o in range(len(recordings)) if o != k):
            for _ in range(150):
                old, new = random.integers(len(places[k])), random.integers(len(places[other]))
                foreign = (places[other][new], points[other][new])
                found, _ = _verify(recording, places[k], points[k], noises[k], old, 0, context, settings, foreign)
                accepted, tried = accepted + found.accepted, tried + 1
    print(f"pairs of different recordings: {accepted} of {tried} accepted")


def _errors(found: Verification, truth: np.ndarray) -> tuple[float, float]:
    E = inverse(truth) @ found.T_old_new
    return float(np.linalg.norm(E[:3, 3])), float(np.degrees(np.linalg.norm(so3_log(E[:3, :3]))))


def _print_verification(name: str, rows: list) -> None:
    overlap, ok = np.array([r[0] for r in rows]), np.array([r[1].accepted for r in rows])
    metres, degrees, seconds = (np.array([r[c] for r in rows]) for c in (2, 3, 4))
    if not ok.any():
        print(f"{name[:14]:14s} {len(rows):6d} {0:9d}")
        return
    shares = [100 * ok[overlap > limit].mean() if (overlap > limit).any() else 0 for limit in (0.3, 0.5, 0.7)]
    print(
        f"{name[:14]:14s} {len(rows):6d} {ok.sum():9d} {shares[0]:12.0f} % {shares[1]:4.0f} % {shares[2]:4.0f} % "
        f"{np.median(metres[ok]):9.3f} {metres[ok].max():.3f} {np.median(degrees[ok]):8.2f} {degrees[ok].max():5.2f} "
        f"{1e3 * np.median(seconds):4.0f} {1e3 * np.median(seconds[ok]):8.0f}",
        flush=True,
    )


# --- pose graph ------------------------------------------------------------------------------------------------------


def graph(sizes: Sequence[int] = (100, 300, 1000, 3000), seeds: int = 5) -> None:
    """Prints time and errors of graphs with one true closure per 20 keyframes and three false ones."""
    print(
        "pose graph  keyframes closures true missed  false believed  ATE m odometry   closed  without false  ms median"
    )
    for size in sizes:
        rows = [_drifting_circuit(size, seed) for seed in range(seeds)]
        missed, wrong = sum(r[0] for r in rows), sum(r[1] for r in rows)
        odometry, closed, clean, seconds = np.median([r[2:] for r in rows], axis=0)
        print(
            f"{'':10s} {size:10d} {max(3, size // 20):9d} {missed:12d} {wrong:15d} {odometry:15.3f} {closed:8.4f} "
            f"{clean:14.4f} {1e3 * seconds:10.0f}",
            flush=True,
        )


def _drifting_circuit(keyframes: int, seed: int) -> tuple[int, int, float, float, float, float]:
    """True closures missed, false ones believed, ATE of odometry, closed, closed without false ones, seconds."""
    random = np.random.default_rng(seed)
    # 10 cm between keyframes: two rounds of 5 m at 100 keyframes, 15 rounds of 20 m at 3000.
    radius = min(3.2, 0.1 * keyframes / (4 * np.pi))
    truth = []
    for path in 0.1 * np.arange(keyframes):
        T = se3_exp(np.array([0, 0, 0, 0, -path / radius, 0]))
        T[:3, 3] = radius * np.cos(path / radius), 0, radius * np.sin(path / radius)
        truth.append(T)
    motions = _odometry(truth, random)
    centres = np.array(truth)[:, :3, 3]
    near = np.argwhere(np.linalg.norm(centres[:, None] - centres[None], axis=2) < 0.3)
    near = near[near[:, 1] - near[:, 0] > 20]
    firm = np.diag([1e6] * 3 + [1e7] * 3)
    true = [
        (i, j, inverse(truth[i]) @ truth[j] @ se3_exp(_noise(random, 0.005, 0.2)))
        for i, j in near[random.choice(len(near), max(3, keyframes // 20), replace=False)].tolist()
    ]
    false = []
    for i, j in near[random.choice(len(near), 3, replace=False)].tolist():
        shift = random.normal(size=3)
        false.append(
            (i, j, se3_exp(np.append(shift / np.linalg.norm(shift), np.zeros(3))) @ inverse(truth[i]) @ truth[j])
        )
    results: list[GraphResult] = []
    for loops in (true, true + false):
        poses = PoseGraph()
        poses.add_node(truth[0])
        for k, motion in enumerate(motions):
            poses.add_node(poses.poses[-1] @ motion)
            poses.add_odometry(k, k + 1, motion, 25 * firm)
        odometry = np.array(poses.poses)
        for i, j, T in loops:
            poses.add_loop(i, j, T, firm)
        results.append(poses.optimise())
    clean, result = results
    believed = set(result.accepted)
    missed = len(set(range(len(true))) - believed)
    wrong = len(believed) - (len(true) - missed)
    errors = (score_trajectory(p, np.array(truth)) for p in (odometry, result.poses, clean.poses))
    return missed, wrong, *(e.ate_rmse_m if e else np.nan for e in errors), result.seconds


def _odometry(truth: list[np.ndarray], random: np.random.Generator) -> list[np.ndarray]:
    """Motions with noise and with a bias of up to a percent of the way."""
    bias = _noise(random, 0.004, 0.03)
    return [
        (motion := inverse(a) @ b) @ se3_exp(bias * np.linalg.norm(motion[:3, 3]) + _noise(random, 0.0008, 0.03))
        for a, b in zip(truth[:-1], truth[1:], strict=True)
    ]


def _noise(random: np.random.Generator, metres: float, degrees: float) -> np.ndarray:
    return np.concatenate([random.normal(0, metres, 3), np.radians(random.normal(0, degrees, 3))])


# --- command line ----------------------------------------------------------------------------------------------------

OF_RECORDINGS = {"retrieval": retrieval, "growth": growth, "verification": verification}
OF_RUNS = {"closing": closing, "localization": localization, "cut": cut}
OTHERS = {"graph": graph}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parts = [*OF_RECORDINGS, *OTHERS, *OF_RUNS]
    parser.add_argument("--parts", nargs="+", default=[*OF_RECORDINGS, *OTHERS], choices=parts)
    parser.add_argument("--scale", type=float, default=0.5, help="image size (default 0.5)")
    parser.add_argument("--stride", type=int, default=3, help="every so many frames are keyframes (default 3)")
    parser.add_argument("--gap", type=int, default=30, help="frames nearer than this in time are neighbours")
    parser.add_argument("--iterations", type=int, default=1, help="of mapping per frame, in runs (default 1)")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the first views (closing)")
    arguments = parser.parse_args()
    recordings: list[Keyframes] = []
    if set(arguments.parts) & set(OF_RECORDINGS):
        recordings = [read_keyframes(p, arguments.scale, arguments.stride, arguments.gap) for p in arguments.recordings]
    for part in arguments.parts:
        if part in OTHERS:
            OTHERS[part]()
        elif part in OF_RUNS:
            for path in arguments.recordings:
                OF_RUNS[part](path, arguments.scale, arguments.iterations, arguments.pictures)
        elif recordings:
            OF_RECORDINGS[part](recordings)


if __name__ == "__main__":
    main()
