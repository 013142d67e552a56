# SPDX-License-Identifier: Apache-2.0
"""What closing loops does to a run: trajectory, the first room's views, false closures. A part of bench_loops.py."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.mapping.keyframe import Keyframe
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.reporting.pictures import color_to_uint8, write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe
from ggslam.runs.starting import start_in_map
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.sequences.sequence import Sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.loop_results import Correction
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.slam import Slam

FIRST_FRAMES = 40
"""Keyframes of so many frames are the first room's views."""
MAPPED_FRAMES, START_EVERY, TRIES = 120, 5, 3
"""Localisation: frames that make the map, distance of the starts in the rest, frames that a start may take."""
CUT_FRAMES = (100, 160)
"""First frame that is cut out, and the first after it."""


class WatchedSlam(Slam):
    """Looks at the first views before and after each closure."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.corrections = _WatchedCorrections(self)

    def first_views(self) -> float:
        """Mean PSNR of the keyframes of the first frames, dB, each from its own pose."""
        chosen = [k for k in self.mapper.keyframes if k.frame_index < FIRST_FRAMES]
        return float(np.mean([psnr(self, k) for k in chosen]))


class _WatchedCorrections(MapCorrections):
    def __init__(self, slam: WatchedSlam) -> None:
        super().__init__(slam.surface, slam.mapper, slam.pager)
        self._slam = slam

    def apply(self, correction: Correction, loops: LoopCloser) -> None:
        before = self._slam.first_views()
        super().apply(correction, loops)
        print(f"  closed: first views {before:.2f} dB before, {self._slam.first_views():.2f} dB after", flush=True)


def rendered(slam: Slam, keyframe: Keyframe) -> np.ndarray:
    """The map from a keyframe's pose, float32 [3, H, W]."""
    rasterizer = CpuRasterizer(context=slam.context)
    return rasterizer.forward(slam.map, keyframe.camera, keyframe.T_camera_world, features=False).image.numpy()


def psnr(slam: Slam, keyframe: Keyframe) -> float:
    """Of a keyframe over pixels with depth, dB."""
    seen = keyframe.depth > 0
    error = rendered(slam, keyframe).clip(0, 1).transpose(1, 2, 0)[seen] - keyframe.color[seen] / 255.0
    return float(-10 * np.log10((error**2).mean()))


def run_settings(enabled: bool, iterations: int) -> Config:
    """Settings of runs without objects."""
    loops = f"loops.enabled={str(enabled).lower()}"
    return load_config(None, ["identity.enabled=false", loops, f"mapping.iterations_per_frame={iterations}"])


def run(sequence: Sequence, enabled: bool, iterations: int) -> tuple[WatchedSlam, float]:
    """A run with loops or without, and its wall time in seconds."""
    slam = WatchedSlam(sequence.camera, run_settings(enabled, iterations), has_masks=False)
    start = time.perf_counter()
    for frame in sequence.stream():
        slam.step(frame)
    return slam, time.perf_counter() - start


def report(slam: WatchedSlam, sequence: Sequence, seconds: float, name: str) -> None:
    """Prints a line."""
    truth, poses = sequence.ground_truth, slam.result().trajectory()
    assert truth is not None
    known = [T if np.isfinite(T).all() else None for T in poses]
    scores = score_trajectory(known, truth)
    assert scores is not None
    last = max(i for i, T in enumerate(known) if T is not None)
    end = np.linalg.norm(poses[last][:3, 3] - (inverse(truth[0]) @ truth[last])[:3, 3])
    loops = slam.loops.seconds if slam.loops is not None else 0.0
    closed = sum(e.kind == "closed" for e in slam.loops.events) if slam.loops is not None else 0
    print(
        f"{name:24s} {100 * scores.ate_rmse_m:8.2f} {100 * scores.ate_raw_rmse_m:8.2f} {100 * end:8.2f} {closed:8d} "
        f"{slam.first_views():11.2f} {len(slam.map):10d} {seconds:8.1f} {loops:8.2f}",
        flush=True,
    )


def false_closures(slam: Slam, count: int = 3) -> None:
    """Adds closures that are wrong by a metre or so to a run's graph, and prints what becomes of them."""
    assert slam.loops is not None
    graph, rng = slam.loops.graph, np.random.default_rng(0)
    before = graph.optimise().poses
    first = len(graph.loops)
    for _ in range(count):
        i, j = sorted(rng.choice(len(before), 2, replace=False).tolist())
        wrong = se3_exp(np.concatenate([rng.normal(0, 1.0, 3), rng.normal(0, 0.3, 3)]))
        graph.add_loop(i, j, inverse(before[i]) @ before[j] @ wrong, 1e5 * np.eye(6))
    result = graph.optimise()
    moved = np.linalg.norm(result.poses[:, :3, 3] - before[:, :3, 3], axis=1).max()
    rejected = sum(first + k in result.rejected for k in range(count))
    print(f"false closures: {rejected} of {count} rejected, poses moved by {1e3 * moved:.2f} mm at most")


def closing(path: Path, scale: float, iterations: int, pictures: Path | None) -> None:
    """Prints the table of one recording, and with `pictures` writes first views with loops and without."""
    sequence = open_sequence(path, scale=scale)
    print(f"{sequence.name:24s} ATE cm   raw cm   end cm   closed  first views  Gaussians   wall s  loops s")
    slams = {}
    for enabled in (False, True):
        name = "with loops" if enabled else "without"
        slam, seconds = run(sequence, enabled, iterations)
        report(slam, sequence, seconds, name)
        slams[name] = slam
    if slams["with loops"].loops is not None and slams["with loops"].loops.graph.loops:
        false_closures(slams["with loops"])
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for number in (0, 3, 6):
            row = [slams["without"].mapper.keyframes[number].color]
            row += [color_to_uint8(rendered(slam, slam.mapper.keyframes[number])) for slam in slams.values()]
            write_picture(pictures / f"{sequence.name}_{number}.png", np.concatenate(row, axis=1))


def localization(path: Path, scale: float, iterations: int, pictures: Path | None) -> None:
    """Prints how many starts in a map of the first frames succeed, and how right they are. Draws nothing."""
    whole, mapped = open_sequence(path, scale=scale), SequenceRequest(path, scale=scale, stop=MAPPED_FRAMES)
    truth = whole.ground_truth
    assert truth is not None
    slam, _ = run(mapped.open(), True, iterations)
    tries, errors, seconds = [], [], []
    starts = range(MAPPED_FRAMES, len(whole) - TRIES, START_EVERY)
    with tempfile.TemporaryDirectory() as temporary:
        folder = RunFolder.create(Path(temporary) / "map")
        folder.save(slam.config, describe(mapped, mapped.open()), slam.result())
        for start in starts:
            visitor = Slam(whole.camera, slam.config, has_masks=False)
            start_in_map(visitor, folder, growing=False)
            for tried in range(TRIES):
                begin = time.perf_counter()
                found = visitor.step(whole.frame(start + tried)).frame.status != "lost"
                seconds.append(time.perf_counter() - begin)
                if found:
                    difference = inverse(truth[0]) @ truth[start + tried]
                    errors.append(np.linalg.norm(visitor.result().trajectory()[-1][:3, 3] - difference[:3, 3]))
                    tries.append(tried)
                    break
        visitor = Slam(whole.camera, slam.config, has_masks=False)
        start_in_map(visitor, folder, growing=False)
        played = range(MAPPED_FRAMES, len(whole))
        located = sum(visitor.step(whole.frame(k)).frame.status != "lost" for k in played)
    first, any_of = (100 * count / len(starts) for count in (tries.count(0), len(tries)))
    middle, most, largest = 100 * np.quantile(errors, [0.5, 0.9, 1.0])
    print(
        f"{whole.name}: {len(starts)} starts in a map of {MAPPED_FRAMES} frames; localised by the first frame "
        f"{first:.0f} %, by one of {TRIES} {any_of:.0f} %; error median {middle:.1f} cm, 90 % {most:.1f} cm, largest "
        f"{largest:.1f} cm; {1e3 * np.median(seconds):.0f} ms a frame; of all {len(played)} frames "
        f"played in a row {located} are located"
    )


def cut(path: Path, scale: float, iterations: int, pictures: Path | None) -> None:
    """Prints the trajectory's error with and without a gap in the recording, and when the camera was found again."""
    sequence = open_sequence(path, scale=scale)
    truth = sequence.ground_truth
    assert truth is not None
    for gap in (range(0), range(*CUT_FRAMES)):
        chosen = [k for k in range(len(sequence)) if k not in gap]
        slam = Slam(sequence.camera, run_settings(True, iterations), has_masks=False)
        for k in chosen:
            slam.step(sequence.frame(k, masks=False))
        result = slam.result()
        known = [T if np.isfinite(T).all() else None for T in result.trajectory()]
        scores = score_trajectory(known, truth[chosen])
        assert scores is not None and slam.loops is not None
        lost = sum(stretch.frames for stretch in result.lost_stretches())
        found = [f"frame {e.frame} at {e.reason}" for e in slam.loops.events if e.kind == "found again"]
        print(
            f"{sequence.name}: {len(chosen)} frames, {lost} lost, found again: {', '.join(found) or '-'}; ATE RMSE "
            f"{100 * scores.ate_rmse_m:.2f} cm",
            flush=True,
        )
