# SPDX-License-Identifier: Apache-2.0
"""Whole SLAM runs on the CPU and on a GPU, side by side in one process.

    python scripts/benchmarks/bench_cuda_slam.py  # all parts, all recordings there are
    python scripts/benchmarks/bench_cuda_slam.py --parts speed --only redkitchen --frames 100
    python scripts/benchmarks/bench_cuda_slam.py --parts profile --out build/gpu_check

Recordings are those of --only that are in --data; without any, a generated room, which is made once and kept (--room).
Frames, masks included, are decoded before the clock starts: no figure here contains reading. Object identity is on.
Parts:

    speed     synchronous runs: frames/s, ms of tracking and of the rest of a step per frame, iterations, errors,
              memory. What the host waits for is counted where it waits; what the GPU still has to do at the end is
              waited for before the clock stops
    realtime  frames arrive at --realtime per second on the GPU, at --realtime-cpu on the CPU: PSNR of both
    loops     the recording played forwards and backwards --loops times in one run: memory after every loop
    profile   what runs on the GPU in 50 frames, kernel by kernel, and how often it does nothing; see --out

PSNR is the mean over held-out frames, of pixels with measured depth, rendered by the CPU's rasterizer from both maps.
GPU memory is what torch has allocated, its caching not counted. The first frames on a GPU compile and load the kernels:
a run of a few frames is made before and not counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gpu_profile import profile_report

from ggslam.evaluation.images import psnr, unit_range
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.realtime import RealtimeSlam
from ggslam.slam.result import SlamResult
from ggslam.slam.slam import Slam
from ggslam.synthetic import write_synthetic_sequence
from ggslam.system.process_memory import resident_bytes

PARTS = ("speed", "realtime", "loops", "profile")
MB = 1e6
WARM_UP = 5
"""Frames of the run before the first one on a GPU."""


@dataclass(frozen=True)
class Recording:
    """Decoded frames of a recording."""

    name: str
    frames: list[Frame]

    @property
    def truth(self) -> np.ndarray:
        """T_world_camera [n, 4, 4], NaN where it is not told."""
        nowhere = np.full((4, 4), np.nan)
        return np.stack([nowhere if f.T_world_camera is None else f.T_world_camera for f in self.frames])


def read(name: str, path: Path, options: argparse.Namespace) -> Recording:
    """The first frames of a recording."""
    sequence = open_sequence(path, stop=options.frames, scale=options.scale)
    frames = [replace(frame, mask=frame.load_mask(), mask_loader=None) for frame in sequence.stream(masks=True)]
    camera = sequence.camera
    print(f"\n# {name}: {len(frames)} frames of {camera.width}x{camera.height}", flush=True)
    return Recording(name, frames)


def recordings(options: argparse.Namespace) -> list[tuple[str, Path]]:
    """Names and folders: of the recordings that are there, or of the generated room."""
    found = [(name, options.data / name) for name in options.only if (options.data / name).is_dir()]
    for name in sorted(set(options.only) - {name for name, _ in found} - {"room"}):
        print(f"# {name}: not in {options.data}", flush=True)
    if not found or "room" in options.only:
        width, height = options.room
        count = options.frames or 60
        room = options.keep / f"room_{width}x{height}_{count}"
        if not room.is_dir():
            write_synthetic_sequence(room, frames=count, width=width, height=height, seed=0)
        found.append(("room", room))
    return found


# --- runs -------------------------------------------------------------------------------------------------------------


def configuration(options: argparse.Namespace, device: str, **changes: Any) -> Config:
    """Settings of a run."""
    config = load_config(options.config, [f"mapping.iterations_per_frame={options.iterations}", *options.set])
    config = replace(config, identity=replace(config.identity, enabled=True), **changes)
    if "device" in {field.name for field in dataclasses.fields(Config)}:
        return replace(config, device=device)
    if device != "cpu":
        raise SystemExit("bench_cuda_slam: this version of ggslam runs on the CPU only")
    return config


def wait(device: str) -> None:
    """For all that a device was given to do."""
    if device == "cuda":
        torch.cuda.synchronize()


def start(recording: Recording, config: Config) -> Slam:
    """A fresh run; memory of the one before is given back first."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    first = recording.frames[0]
    return Slam(first.camera, config, has_masks=first.mask is not None)


def memory(device: str) -> dict[str, float]:
    """10^6 bytes: resident, and on the GPU."""
    found = {"resident_mb": resident_bytes() / MB}
    if device == "cuda":
        found["gpu_mb"] = torch.cuda.memory_allocated() / MB
        found["gpu_peak_mb"] = torch.cuda.max_memory_allocated() / MB
        found["gpu_reserved_mb"] = torch.cuda.memory_reserved() / MB
    return found


def held_out_psnr(recording: Recording, result: SlamResult, config: Config) -> tuple[float, int]:
    """Mean PSNR of the frames that were held out and tracked, and how many they are."""
    arrays = {name: getattr(result.gaussians, name).detach().cpu().contiguous() for name in PARAMETERS}
    gaussians, rasterizer = GaussianTensors(**arrays), CpuRasterizer()
    trained = {keyframe.frame_index for keyframe in result.keyframes}
    found = []
    for tracked, pose in zip(result.frames, result.trajectory(), strict=True):
        frame = recording.frames[tracked.frame_index]
        if not config.evaluation.is_held_out(frame.index) or frame.index in trained or np.isnan(pose).any():
            continue
        view = rasterizer.forward(gaussians, frame.camera, inverse(pose), features=False)
        image = unit_range(view.image.numpy().transpose(1, 2, 0))
        found.append(psnr(image, unit_range(frame.color), frame.depth > 0))
    return float(np.mean(found)) if found else float("nan"), len(found)


def quality(recording: Recording, result: SlamResult, config: Config) -> dict[str, Any]:
    """Errors of a run."""
    poses: list[np.ndarray | None] = [None] * len(recording.frames)
    for tracked, pose in zip(result.frames, result.trajectory(), strict=True):
        poses[tracked.frame_index] = None if np.isnan(pose).any() else pose
    scores = score_trajectory(poses, recording.truth)
    value, views = held_out_psnr(recording, result, config)
    return {
        "ate_cm": None if scores is None else 100 * scores.ate_rmse_m, "psnr_held_out": value, "views": views,
        "gaussians": result.gaussian_count, "keyframes": len(result.keyframes),
        "lost": sum(frame.status == "lost" for frame in result.frames), "dropped": len(result.dropped_frames),
    }  # fmt: skip


def measure_speed(recording: Recording, options: argparse.Namespace, device: str) -> dict[str, Any]:
    """A synchronous run."""
    config = configuration(options, device)
    slam, steps = start(recording, config), []
    wait(device)
    begin = time.perf_counter()
    for frame in recording.frames:
        steps.append(slam.step(frame).seconds)
    wait(device)
    wall = time.perf_counter() - begin
    used, iterations = memory(device), slam.mapper.times.iterations
    result = slam.finish()
    count, tracking = len(recording.frames), sum(slam.times.tracking_by_frame)
    return {
        "fps": count / wall, "tracking_ms": 1e3 * tracking / count, "mapping_ms": 1e3 * (wall - tracking) / count,
        "median_step_ms": 1e3 * float(np.median(steps)), "slowest_step_ms": 1e3 * max(steps), "iterations": iterations,
        **used, **quality(recording, result, config),
    }  # fmt: skip


def measure_realtime(recording: Recording, options: argparse.Namespace, device: str) -> dict[str, Any]:
    """A run in which frames arrive at a camera's pace."""
    rate = options.realtime if device == "cuda" else options.realtime_cpu
    config = configuration(options, device, realtime_fps=rate)
    slam = start(recording, config)
    RealtimeSlam(slam, rate).run(recording.frames, lambda frame, report: None)
    wait(device)
    used, iterations = memory(device), slam.mapper.times.iterations
    result = slam.finish()
    per_frame = iterations / len(recording.frames)
    return {"rate": rate, "iterations": iterations, "iterations_per_frame": per_frame, **used,
            **quality(recording, result, config)}  # fmt: skip


def measure_loops(recording: Recording, options: argparse.Namespace, device: str) -> dict[str, Any]:
    """One run over the recording, forwards and backwards in turn; held-out frames are those of the first loop's."""
    slam = start(recording, configuration(options, device))
    rows, number, spacing = [], 0, recording.frames[-1].timestamp / max(1, len(recording.frames) - 1)
    for turn in range(options.loops):
        begin = time.perf_counter()
        for frame in recording.frames[:: 1 if turn % 2 == 0 else -1]:
            slam.step(replace(frame, index=number, source_index=number, timestamp=number * spacing))
            number += 1
        wait(device)
        seconds = time.perf_counter() - begin
        row = {"loop": turn + 1, "fps": len(recording.frames) / seconds, "gaussians": slam.gaussian_count,
               "keyframes": len(slam.mapper.keyframes), "image_mb": getattr(slam.mapper, "image_bytes", 0) / MB,
               **memory(device)}  # fmt: skip
        rows.append(row)
        show(f"loop {turn + 1}", device, row)
    name = "gpu_mb" if device == "cuda" else "resident_mb"
    first, last = rows[min(1, len(rows) - 1)], rows[-1]
    growth = {"growth_mb": last[name] - first[name], "growth_image_mb": last["image_mb"] - first["image_mb"],
              "growth_gaussians": last["gaussians"] - first["gaussians"],
              "growth_keyframes": last["keyframes"] - first["keyframes"]}  # fmt: skip
    slam.close()
    return {**growth, "rows": rows}


def measure_profile(recording: Recording, options: argparse.Namespace, device: str) -> dict[str, Any]:
    """The part of a run after its first frames, as torch's profiler sees it."""
    slam = start(recording, configuration(options, device))
    before = min(options.profile_after, len(recording.frames) // 2)
    for frame in recording.frames[:before]:
        slam.step(frame)
    chosen = recording.frames[before : before + options.profile_frames]

    def run() -> None:
        for frame in chosen:
            with torch.profiler.record_function("frame"):
                slam.step(frame)
        wait(device)

    wait(device)
    figures, text, table = profile_report(run, len(chosen), device)
    print(text, flush=True)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / f"profile_{recording.name}_{device}.txt").write_text(f"{text}\n\n{table}\n")
    slam.close()
    return figures


MEASURE = {
    "speed": measure_speed, "realtime": measure_realtime, "loops": measure_loops, "profile": measure_profile,
}  # fmt: skip


# --- what is printed --------------------------------------------------------------------------------------------------


def show(part: str, device: str, figures: dict[str, Any]) -> None:
    """One line."""
    texts = [
        f"{name} {value:.3f}" if isinstance(value, float) else f"{name} {value}"
        for name, value in figures.items()
        if not isinstance(value, (list, dict))
    ]
    print(f"{part:>9} {device:>4} | {' | '.join(texts)}", flush=True)


def compare(part: str, found: dict[str, dict[str, Any]]) -> None:
    """The GPU against the CPU."""
    if "cpu" not in found or "cuda" not in found:
        return
    cpu, gpu = found["cpu"], found["cuda"]
    if part == "speed":
        figures = {"fps ratio": gpu["fps"] / cpu["fps"]}
    elif part != "realtime":
        return
    else:
        figures = {}
    figures["psnr gain"] = gpu["psnr_held_out"] - cpu["psnr_held_out"]
    if cpu["ate_cm"] is not None and gpu["ate_cm"] is not None:
        figures["ate gain cm"] = cpu["ate_cm"] - gpu["ate_cm"]
    show(part, "g/c", figures)


def parse_arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("GGSLAM_DATA", Path(__file__).parents[3] / "shared" / "data")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--devices", nargs="+", choices=["cpu", "cuda"], default=["cpu", "cuda"])
    parser.add_argument("--data", type=Path, default=default, help="folder with recordings (or GGSLAM_DATA)")
    parser.add_argument("--only", nargs="+", default=["redkitchen", "livingroom"], help="recordings; room: generated")
    parser.add_argument("--room", nargs=2, type=int, default=[320, 240], help="size of the generated room's images")
    parser.add_argument("--keep", type=Path, default=Path("build/recordings"), help="where the generated room is kept")
    parser.add_argument("--frames", type=int, help="of each recording; default: all, 60 of the generated room")
    parser.add_argument("--scale", type=float, default=1.0, help="of the images")
    parser.add_argument("--config", help="preset or file of settings")
    parser.add_argument("--iterations", type=int, default=3, help="mapping iterations a frame")
    parser.add_argument("--realtime", type=float, default=30.0, help="frames a second on the GPU")
    parser.add_argument("--realtime-cpu", type=float, default=10.0, help="frames a second on the CPU")
    parser.add_argument("--loops", type=int, default=10)
    parser.add_argument("--loop-devices", nargs="+", choices=["cpu", "cuda"], default=["cuda"])
    parser.add_argument("--profile-frames", type=int, default=50)
    parser.add_argument("--profile-after", type=int, default=40, help="frames before those that are profiled")
    parser.add_argument("--set", nargs="*", default=[], action="extend", help="settings, name=value")
    parser.add_argument("--out", type=Path, help="folder for the tables of the profile")
    parser.add_argument("--json", type=Path, help="also write all figures here, after every part")
    return parser.parse_args(words)


def devices_of(part: str, options: argparse.Namespace) -> list[str]:
    """Where a part runs: loops and profile on the CPU only if no GPU is asked for."""
    if part not in ("loops", "profile"):
        return options.devices
    wanted = options.loop_devices if part == "loops" else ["cuda"]
    return [device for device in options.devices if device in wanted] or options.devices


def main() -> int:
    """Prints a line for each run."""
    options, outcomes = parse_arguments(), []
    if "cuda" in options.devices and not torch.cuda.is_available():
        print("bench_cuda_slam: torch finds no CUDA device; only the CPU's part is run", file=sys.stderr)
        options.devices = [device for device in options.devices if device != "cuda"]
    if not options.devices:
        return 1
    print(torch.cuda.get_device_name() if "cuda" in options.devices else "CPU only", flush=True)
    for name, path in recordings(options):
        recording = read(name, path, options)
        if "cuda" in options.devices and not outcomes:
            measure_speed(Recording(name, recording.frames[:WARM_UP]), options, "cuda")
        for part in options.parts:
            found = {}
            for device in devices_of(part, options):
                found[device] = MEASURE[part](recording, options, device)
                show(part, device, found[device])
            compare(part, found)
            outcomes.append({"recording": name, "part": part, "frames": len(recording.frames), **found})
            if options.json:
                options.json.parent.mkdir(parents=True, exist_ok=True)
                options.json.write_text(json.dumps(outcomes, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
