# SPDX-License-Identifier: Apache-2.0
"""One run of bench_host.py: SLAM over a recording on a pretended GPU. Prints figures of each kind of frame as JSON. The
search path says which checkout is measured."""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cuda_emulation import emulated_library
from device_watch import DeviceWatch
from host_counts import CallCounter, CountedFunctions, KernelThread, count_operations, take_records

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.cuda import mapper
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.filters.depth_edges import DepthEdges
from ggslam.slam.slam import Slam
from ggslam.tracking.residual_noise import ResidualNoise

COUNTS = (
    "Python calls", "C calls", "torch operations", "allocations", "pinned allocations", "library calls", "waits",
    "downloads", "uploads", "blocking uploads", "bytes up", "bytes down",
)  # fmt: skip


KINDS = ("ordinary", "residuals", "keyframe")
REPEATS = 120
"""Frames with the kernels left out."""


@dataclass
class Step:
    """Figures of a frame of one kind."""

    kind: str
    figures: dict[str, float]


class Looks:
    """Knows of the frame at hand whether the tracker looked at its residuals."""

    def __init__(self) -> None:
        self.looked = False
        due = ResidualNoise.due

        def noted(residuals: ResidualNoise) -> bool:
            self.looked = due(residuals)
            return self.looked

        ResidualNoise.due = noted  # type: ignore[method-assign]

    def kind(self, is_keyframe: bool) -> str:
        """Of the frame."""
        kind = "keyframe" if is_keyframe else "residuals" if self.looked else "ordinary"
        self.looked = False
        return kind


def read(options: argparse.Namespace) -> list[Frame]:
    """The first frames of the recording, decoded."""
    sequence = open_sequence(options.recording, stop=options.frames)
    return [replace(frame, mask=frame.load_mask(), mask_loader=None) for frame in sequence.stream(masks=True)]


def settings(options: argparse.Namespace, *more: str) -> list[str]:
    """Of the run."""
    every = ["keyframes.max_gap=1", "mapping.iterations_per_frame=1"] if options.part == "growth" else []
    few = ["evaluation.held_out_every=0", "mapping.first_frame_iterations=4"]  # the first frame is not looked at
    return [*few, *every, *options.set, *more]


def start(frames: list[Frame], config: Config, library: CudaLibrary | None) -> Slam:
    """A run that knows already what it looks for in its first frames: whether outlines of depth are sharp."""
    slam = Slam(frames[0].camera, config, has_masks=frames[0].mask is not None, library=library)
    for chain in slam.chains:
        chain.get(DepthEdges).soft = False
    return slam


def counted_run(frames: list[Frame], options: argparse.Namespace) -> list[Step]:
    """Under the watch."""
    looks, steps, found = Looks(), [], Counter[str]()
    with DeviceWatch() as watch:
        watch.library.functions = CountedFunctions(watch.library.functions, found)
        count_operations(watch, found)
        calls = CallCounter(found)
        config = load_config(None, settings(options, "device=cuda"))
        slam = start(frames, config, None)
        for frame in frames:
            take_records(watch, found)
            with calls:
                report = slam.step(frame)
            taken = take_records(watch, found)
            steps.append(Step(looks.kind(report.is_keyframe), {name: float(taken[name]) for name in COUNTS}))
        slam.close()
    return steps


def timed_run(frames: list[Frame], options: argparse.Namespace) -> list[Step]:
    """Without the watch, tensors on the CPU."""
    looks, steps = Looks(), []
    library = CudaLibrary(Path(emulated_library().functions._name), device_type="cpu")
    kernels = KernelThread(library.functions)
    library.functions = kernels
    config = load_config(None, settings(options))
    with kernels.copying():
        slam = start(frames, config, library)
        gc.collect()
        gc.freeze()
        alignments = []
        for frame in frames:
            steps.append(timed_step(slam, frame, kernels, looks))
            alignments.append(kernels.alignment)
        if options.part == "time":
            steps += steps_without_kernels(slam, frames[1:], alignments[1:], kernels, looks)
    slam.close()
    return steps


def timed_step(slam: Slam, frame: Frame, kernels: KernelThread, looks: Looks) -> Step:
    """A step with the kernels' time taken out."""
    kernels.wall = kernels.cpu = 0.0
    wall, cpu = time.perf_counter(), time.thread_time()
    report = slam.step(frame)
    wall, cpu = time.perf_counter() - wall - kernels.wall, time.thread_time() - cpu - kernels.cpu
    figures = {"host ms": 1e3 * wall, "host ms of its processor": 1e3 * cpu, "kernels ms": 1e3 * kernels.wall}
    return Step(looks.kind(report.is_keyframe), figures)


def steps_without_kernels(
    slam: Slam, frames: list[Frame], alignments: list[Any], kernels: KernelThread, looks: Looks
) -> list[Step]:
    """Steps of these frames to and fro with the kernels left out, one after the other as a GPU lets them follow, and
    aligned as before. What surfaces hide is not looked for: that works with what kernels write."""
    mapper.mark_shown = lambda *_: None
    kernels.leaves_out, steps, last = True, list[Step](), len(frames) - 1
    for number in range(1, REPEATS + 1):
        place = abs(last - number % (2 * last))
        kernels.alignment = alignments[place]
        steps.append(timed_step(slam, replace(frames[place], index=frames[-1].index + number), kernels, looks))
    return [replace(step, kind=f"{step.kind}, no kernels") for step in steps[REPEATS // 4 :]]


def medians(steps: list[Step]) -> dict[str, float]:
    """Of each figure, and how many frames there are."""
    found = {name: statistics.median(step.figures[name] for step in steps) for name in steps[0].figures}
    return {"frames": len(steps), **found}


def kinds_of(steps: list[Step]) -> dict[str, dict[str, float]]:
    """Medians by kind."""
    kinds = [*KINDS, *(f"{kind}, no kernels" for kind in KINDS)]
    by_kind = {kind: [step for step in steps if step.kind == kind] for kind in kinds}
    return {kind: medians(of_kind) for kind, of_kind in by_kind.items() if of_kind}


def growth_of(counts: list[Step], times: list[Step], window: int) -> dict[str, dict[str, float]]:
    """Medians about keyframe 20 and about the last one."""
    joined = [
        Step(count.kind, {**count.figures, **clock.figures})
        for count, clock in zip(counts, times, strict=True)
        if count.kind == clock.kind == "keyframe"
    ]
    early, late = joined[20 - window : 20 + window], joined[-2 * window :]
    return {"keyframe 20": medians(early), f"keyframe {len(joined) - window}": medians(late)}


def main() -> None:
    """Prints one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["counts", "time", "growth"])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--skip", type=int, required=True)
    parser.add_argument("--window", type=int, required=True)
    parser.add_argument("--set", nargs="*", default=[])
    options = parser.parse_args()
    frames = read(options)
    found: dict[str, Any]
    if options.part == "growth":
        found = growth_of(counted_run(frames, options), timed_run(frames, options), options.window)
    else:
        measure = counted_run if options.part == "counts" else timed_run
        found = kinds_of(measure(frames, options)[options.skip :])
    print(json.dumps(found))


if __name__ == "__main__":
    main()
