# SPDX-License-Identifier: Apache-2.0
"""A whole run against training by OpenSplat's CPU build: dB of held-out frames by processor time.

    python scripts/benchmarks/bench_training.py RECORDING --opensplat PATH/TO/opensplat [--scale 0.5] [--times 1 10]

Ours is `ggslam run` without objects: it reads the recording, tracks the camera, maps and refines. OpenSplat
(github.com/pierotofy/OpenSplat, AGPL: built outside this checkout, GPU_RUNTIME=CPU) gets the same images but those
held out, the recording's true poses, and points of the run's surface to begin with. Its number of steps is chosen by
trials so that it uses as much processor time as ours, times each of --times; once as its defaults are, from a quarter
of the size up, and once at full size (--num-downscales 0). Every eighth frame is held out. Both results are PLY files
that one renderer draws by the rules of 3D Gaussian Splatting at the true poses; dB over all pixels.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from commands import usage_of

from ggslam.evaluation.images import psnr, unit_range
from ggslam.formats.splat_formats import read_splats
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.poses import inverse

EVERY = 8
"""Every so many frames one is held out."""
NEAR_ENOUGH = 0.1
"""A trial whose processor time is off by less than this part is taken."""
MOST_TRIALS = 5
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def processor_seconds(words: list[object]) -> float:
    """Runs a command; the processor time that it and its threads used."""
    return usage_of([str(word) for word in words]).processor_seconds


def true_poses(folder: RunFolder) -> dict[int, np.ndarray]:
    """T_world_camera by frame number, in the run's world: its first frame's axes."""
    truth = open_recording_of(folder).ground_truth
    if truth is None:
        sys.exit("the recording has no true poses")
    known = {i: pose for i, pose in enumerate(truth) if np.isfinite(pose).all()}
    start = inverse(known[min(known)])
    return {i: start @ pose for i, pose in known.items()}


def give_true_poses(images: Path, poses: dict[int, np.ndarray]) -> int:
    """Leaves the images to train on, at their true poses, in a transforms.json; returns their number."""
    path = images / "transforms.json"
    transforms = json.loads(path.read_text())
    kept = set(transforms["train_filenames"])
    transforms["frames"] = [frame for frame in transforms["frames"] if frame["file_path"] in kept]
    for frame in transforms["frames"]:
        number = int("".join(c for c in Path(frame["file_path"]).stem if c.isdigit()))
        frame["transform_matrix"] = (poses[number] @ _OPENGL_FROM_OPENCV).tolist()
    path.write_text(json.dumps(transforms))
    return len(transforms["frames"])


def held_out_psnr(folder: RunFolder, splats: Path, poses: dict[int, np.ndarray]) -> float:
    """Mean PSNR in dB of the frames that nobody trained on."""
    sequence, gaussians, rasterizer = open_recording_of(folder), read_splats(splats), CpuRasterizer()
    number = folder.sequence().own_number
    evaluation, found = folder.config().evaluation, []
    for i, pose in poses.items():
        if not evaluation.is_held_out(number(i)):
            continue
        frame = sequence.frame(i, masks=False)
        view = rasterizer.forward(gaussians, frame.camera, inverse(pose), features=False, as_3dgs=True)
        found.append(psnr(view.image.numpy().clip(0, 1).transpose(1, 2, 0), unit_range(frame.color)))
    return float(np.mean(found))


def train_for(theirs: list[object], goal_s: float, steps: int) -> tuple[int, float]:
    """Trains for about so many seconds of processor time; the number of steps and what they took."""
    used = 0.0
    for _ in range(MOST_TRIALS):
        used = processor_seconds([*theirs, "-n", steps])
        if abs(used - goal_s) < NEAR_ENOUGH * goal_s:
            break
        steps = max(10, round(steps * goal_s / used))
    return steps, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--opensplat", type=Path, required=True, help="its program")
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--times", type=float, nargs="+", default=[1, 10], help="our processor time")
    parser.add_argument("--voxel", type=float, default=0.03, help="metres between OpenSplat's first points")
    options = parser.parse_args()
    ggslam: list[object] = [sys.executable, "-m", "ggslam"]
    print("| program | steps | processor time | Gaussians | held out |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as made:
        run, images, ours, out = (Path(made, name) for name in ("run", "images", "ours.ply", "out.ply"))
        goal = processor_seconds([
            *ggslam, "run", options.recording, "--scale", options.scale, "--out", run, "--no-eval",
            "--set", f"evaluation.held_out_every={EVERY}", "--set", "identity.enabled=false",
        ])  # fmt: skip
        processor_seconds([*ggslam, "export", run, "--format", "nerfstudio", "--voxel", options.voxel, "--out", images])
        processor_seconds([*ggslam, "export", run, "--format", "ply", "--out", ours])
        folder = RunFolder.open(run)
        poses = true_poses(folder)
        give_true_poses(images, poses)
        count = read_splats(ours).count
        print(f"| ours | | {goal:.0f} s | {count} | {held_out_psnr(folder, ours, poses):.2f} dB |", flush=True)
        for times in options.times:
            for downscales in (2, 0):
                theirs = [options.opensplat, images, "--cpu", "--keep-crs", "--num-downscales", downscales, "-o", out]
                steps, used = train_for(theirs, times * goal, steps=round(100 * times))
                found = held_out_psnr(folder, out, poses)
                print(
                    f"| OpenSplat, {times:g} times as long, {downscales} halvings | {steps} | {used:.0f} s"
                    f" | {read_splats(out).count} | {found:.2f} dB |", flush=True,
                )  # fmt: skip


if __name__ == "__main__":
    main()
