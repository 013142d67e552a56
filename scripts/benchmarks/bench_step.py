# SPDX-License-Identifier: Apache-2.0
"""Speed of an optimisation step on the map of a run: forward, loss, and backward with Adam, over some of its keyframes.

    python scripts/benchmarks/bench_step.py RUN [--cores OLD.so NEW.so] [--recording FOLDER]

Milliseconds, the shortest of several repetitions, mean over the keyframes. With several compiled cores each is measured
by turns in processes of its own. Times of one thread are the processor's, so that other programs count for less. Rates
are zero: the map stays as it is.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from bench_low_pass import views_of

from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.keyframe import make_keyframe
from ggslam.mapping.losses import LossTarget
from ggslam.native.loader import NativeContext
from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.poses import inverse

PARTS = ("forward", "loss", "step")


def measure(
    run: Path, recording: Path | None, instruction_set: str, threads: int, repeat: int, views: int
) -> np.ndarray:
    """Milliseconds of `PARTS`."""
    folder = RunFolder.open(run)
    gaussians, mapping = folder.gaussians(with_moments=True), folder.config().mapping
    context = NativeContext(threads, instruction_set)
    rasterizer, loss, still = CpuRasterizer(context=context), CpuImageLoss(context), AdamSettings({})
    poses = list(views_of(folder, 1)["keyframes"].items())
    sequence = open_recording_of(folder, recording)
    chosen = np.unique(np.linspace(0, len(poses) - 1, views).astype(int))
    keyframes = [make_keyframe(k, sequence[poses[k][0]], inverse(poses[k][1])) for k in chosen]
    clock = time.process_time if threads == 1 else time.perf_counter
    best = np.full((len(keyframes), len(PARTS)), np.inf)
    for _ in range(repeat):
        for times, keyframe in zip(best, keyframes, strict=True):
            laps = [clock()]
            view = rasterizer.forward(
                gaussians, keyframe.camera, keyframe.T_camera_world, features=False, close_below=mapping.close_below
            )
            laps.append(clock())
            target = LossTarget(keyframe.color, keyframe.depth, keyframe.depth_unit)
            found = loss.evaluate(view, target, mapping.loss)
            laps.append(clock())
            rasterizer.backward_step(gaussians, found.d_image, found.d_depth, found.d_alpha, optimizer=still)
            laps.append(clock())
            np.minimum(times, 1e3 * np.diff(laps), out=times)
    return best.mean(0)


def measure_apart(core: Path | None, arguments: argparse.Namespace, instruction_set: str, threads: int) -> np.ndarray:
    """`measure` in a process of its own with another compiled core."""
    command = [sys.executable, __file__, str(arguments.run), "--alone", "--repeat", str(arguments.repeat)]
    command += ["--views", str(arguments.views), "--instruction-sets", instruction_set, "--threads", str(threads)]
    command += ["--recording", str(arguments.recording)] if arguments.recording else []
    environment = os.environ if core is None else {**os.environ, "GGSLAM_CORE": str(core)}
    said = subprocess.run(command, check=True, env=environment, capture_output=True, text=True).stdout
    return np.array(json.loads(said.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--cores", type=Path, nargs="+", default=[None], help="compiled cores to compare")
    parser.add_argument("--recording", type=Path, help="where the recording is, if it was moved")
    parser.add_argument("--instruction-sets", nargs="+", default=["avx512", "avx2"])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeat", type=int, default=8)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.alone:
        options = (arguments.instruction_sets[0], arguments.threads[0], arguments.repeat, arguments.views)
        print(json.dumps(measure(arguments.run, arguments.recording, *options).tolist()))
        return
    print(f"{'set':8} threads {'core':20} " + " ".join(f"{part:>8}" for part in (*PARTS, "all")))
    for instruction_set in arguments.instruction_sets:
        for threads in arguments.threads:
            best = [np.full(len(PARTS), np.inf) for _ in arguments.cores]
            for _ in range(arguments.rounds):
                for k, core in enumerate(arguments.cores):
                    best[k] = np.minimum(best[k], measure_apart(core, arguments, instruction_set, threads))
            for core, times in zip(arguments.cores, best, strict=True):
                name = "this one" if core is None else core.name
                numbers = " ".join(f"{t:8.2f}" for t in (*times, times.sum()))
                print(f"{instruction_set:8} {threads:7} {name:20} {numbers}")


if __name__ == "__main__":
    main()
