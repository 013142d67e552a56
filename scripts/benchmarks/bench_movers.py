# SPDX-License-Identifier: Apache-2.0
"""Things that move while a recording is made: what they cost a run, as printed in docs/movers.md.

    python scripts/benchmarks/bench_movers.py ../shared/data                     # all of it
    python scripts/benchmarks/bench_movers.py ../shared/data --only movers       # one part: movers, still
    python scripts/benchmarks/bench_movers.py ../shared/data --masks none
    python scripts/benchmarks/bench_movers.py --synth 3                          # generated rooms instead

movers: `livingroom_movers`, with the search and without, beside its twin in which nothing moves: error of the
trajectory, held-out PSNR over pixels that no mover covers, and behind the movers, where the twin tells what is
there (places where a thing rests before it moves, or afterwards, are left out of both: no one map is right there).
The twin is run as it is, and with the pixels hidden that movers truly cover: what a search without any error would
leave to the map. Then the overlap of the masks that were found with the true ones, and when each mover was found
first; of each mover since when it moves by movers.json, and its displacement, against the truth.
--synth N: N generated rooms with a walker, a mug and a drawer (320x240), as in movers.
still: recordings in which nothing moves, with the search and without: frames in which something was found.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from ggslam.evaluation.trajectory import align_points
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.runs.records.movers import MoversRecord
from ggslam.scene.poses import inverse, separation, transform_points
from ggslam.sequences import Sequence, open_sequence
from ggslam.sequences.moving_pixels import MovingPixels
from ggslam.slam.config import load_config
from ggslam.slam.result import SlamResult
from ggslam.slam.slam import Slam
from ggslam.synthetic import MOVERS, SynthTuning, write_synthetic_sequence

FEWEST_PIXELS = 30
"""Of a mover at half size: fewer are not asked for."""
AROUND = 2
"""Pixels by which places of rest are made larger."""
STILL = ("livingroom_movers_static", "livingroom", "redkitchen", "rgbd_dataset_freiburg3_cabinet")


@dataclass
class Run:
    """What a run gives that is scored."""

    slam: Slam
    result: SlamResult
    seconds: float
    masks: dict[int, np.ndarray] = field(default_factory=dict)


def open_recording(path: Path, stop: int | None) -> Sequence:
    """At half size, but small ones as they are."""
    sequence = open_sequence(path, stop=stop)
    return open_sequence(path, scale=0.5, stop=stop) if sequence.camera.width > 400 else sequence


def run(path: Path, settings: list[str], stop: int | None, hidden: MovingPixels | None = None) -> Run:
    """A run of a recording, of which pixels may be hidden."""
    sequence = open_recording(path, stop)
    sequence.moving = hidden
    slam, masks, seconds = Slam(sequence.camera, load_config(None, settings)), {}, 0.0
    for frame in sequence:
        start = time.process_time()
        slam.step(frame)
        seconds += time.process_time() - start
        if slam.movers.mask is not None:
            masks[frame.index] = slam.movers.mask
    return Run(slam, slam.finish(), seconds, masks)


def ate_cm(done: Run, path: Path, stop: int | None) -> float:
    """Root mean square error of the trajectory."""
    sequence = open_recording(path, stop)
    found, true = [], []
    for tracked, frame in zip(done.slam.frames, sequence, strict=True):
        if tracked.status != "lost" and frame.T_world_camera is not None:
            found.append(done.slam.pose_of(tracked)[:3, 3])
            true.append(frame.T_world_camera[:3, 3])
    T_true_found, _ = align_points(np.array(found), np.array(true))
    distances = np.linalg.norm(transform_points(np.array(found), T_true_found) - np.array(true), axis=1)
    return 100 * float(np.sqrt((distances**2).mean()))


def psnr(error: list[np.ndarray]) -> float:
    """Of squared errors of colours from 0 to 1."""
    return float(-10 * np.log10(np.concatenate(error).mean())) if error else float("nan")


def places_of_rest(path: Path, twin: Path, numbers: list[int], stop: int | None) -> list[np.ndarray]:
    """Of each frame the pixels, bool [H, W], where a thing is before it moves, or after it came to rest."""
    frames = list(open_recording(path, stop))
    seen_at_rest = []
    for frame in (frames[0], frames[-1]):
        mask = frame.load_mask()
        assert mask is not None and frame.T_world_camera is not None
        own = np.isin(mask, numbers) & (frame.depth > 0)
        seen_at_rest.append(transform_points(frame.camera.back_project(frame.depth)[own], frame.T_world_camera))
    points = np.concatenate(seen_at_rest)
    found = []
    for frame in open_recording(twin, stop):
        mask = frame.load_mask()
        assert mask is not None and frame.T_world_camera is not None
        seen, camera = transform_points(points, inverse(frame.T_world_camera)), frame.camera
        image = np.isin(mask, numbers).astype(np.uint8)
        ahead = seen[seen[:, 2] > 0]
        u = np.rint(camera.fx * ahead[:, 0] / ahead[:, 2] + camera.cx).astype(int)
        v = np.rint(camera.fy * ahead[:, 1] / ahead[:, 2] + camera.cy).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        image[v[inside], u[inside]] = 1
        found.append(cv2.dilate(image, np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8)) > 0)
    return found


def scores(
    done: Run, twin: Path, movers: list[np.ndarray], rests: list[np.ndarray], stop: int | None
) -> tuple[float, float]:
    """Held-out PSNR against the twin's images over pixels that no mover covers, and over all frames behind movers.

    Args:
        done: the run.
        twin: recording of the same camera path without movers.
        movers: bool [H, W] of each frame, where movers are.
        rests: bool [H, W] of each frame, where nothing is compared.
        stop: frames.
    """
    free, behind, mapper = [], [], done.slam.mapper
    assert isinstance(mapper, CpuMapper)
    sequence = open_recording(twin, stop)
    for tracked, frame, covered, left_out in zip(done.slam.frames, sequence, movers, rests, strict=True):
        held_out = done.slam.config.evaluation.is_held_out(frame.index)
        if tracked.status == "lost" or not (held_out or covered.any()):
            continue
        view = mapper.render_view(frame.camera, inverse(done.slam.pose_of(tracked)))
        wrong = (view.image.numpy().transpose(1, 2, 0).clip(0, 1) - frame.color / np.float32(255)) ** 2
        if held_out:
            free.append(wrong[~covered & ~left_out].reshape(-1))
        behind.append(wrong[covered & ~left_out].reshape(-1))
    return psnr(free), psnr(behind)


def bench_movers(path: Path, twin: Path, more: list[str], stop: int | None) -> None:
    """A recording with movers against its twin."""
    told = json.loads((path / "movers.json").read_text())
    truth, movers = told["frames"], told["movers"]
    sequence = open_recording(path, stop)
    ids, numbers = [], {m["instance_id"] for m in movers}
    for frame in sequence:
        mask = frame.load_mask()
        assert mask is not None
        ids.append(mask)
    covered = [np.isin(mask, list(numbers)) for mask in ids]
    rests = places_of_rest(path, twin, [m["instance_id"] for m in movers if m["rigid"]], stop)
    hidden = MovingPixels()
    for index, mask in enumerate(covered):
        hidden.add(index, mask)
    print("| run | ATE cm | free pixels dB | behind movers dB | Gaussians | processor s |")
    print("|---|---|---|---|---|---|")
    for name, where, settings, withheld in (
        ("twin", twin, [], None),
        ("twin, hidden where movers are", twin, [], hidden),
        ("movers", path, ["movers.enabled=true"], None),
        ("without the search", path, ["movers.enabled=false"], None),
    ):
        done = run(where, [*settings, *more], stop, withheld)
        free, behind = scores(done, twin, covered, rests, stop)
        error, count = ate_cm(done, where, stop), done.slam.map.count
        print(f"| {name} | {error:.3f} | {free:.2f} | {behind:.2f} | {count} | {done.seconds:.1f} |", flush=True)
        if name == "movers":
            found = done
    print_masks(found, ids, truth)
    print_tracks(found, path, truth, {m["instance_id"]: m["rigid"] for m in movers}, stop)


def print_masks(done: Run, ids: list[np.ndarray], truth: list[dict]) -> None:
    """How the masks that were found compare with the true ones."""
    overlaps, invented = [], []
    onsets: dict[int, list[int | None]] = {}
    for index, mask in enumerate(ids):
        found = done.masks.get(index, np.zeros(mask.shape, bool))
        wanted = np.zeros(mask.shape, bool)
        for mover in truth[index]["movers"]:
            own = mask == mover["instance_id"]
            if not mover["moving"]:
                continue
            wanted |= own
            if own.sum() >= FEWEST_PIXELS:
                begun = onsets.setdefault(mover["instance_id"], [index, None])
                if begun[1] is None and (found & own).sum() > own.sum() / 2:
                    begun[1] = index
        if wanted.sum() >= FEWEST_PIXELS:
            overlaps.append((found & wanted).sum() / (found | wanted).sum())
        elif found.any():
            invented.append(index)
    print(f"\nIoU {np.mean(overlaps):.3f} over {len(overlaps)} frames; frames with a mover where none is: {invented}")
    for number, (first, seen) in onsets.items():
        print(f"mover {number}: moves from frame {first}, found in frame {seen}")


def print_tracks(done: Run, path: Path, truth: list[dict], rigid: dict[int, bool], stop: int | None) -> None:
    """Each mover of movers.json against the truth: since when it moves, its kind, and its displacement, measured at its
    place before. Of runs without instance masks: the masks do not tell which is which."""
    true_poses = {f.index: f.T_world_camera for f in open_recording(path, stop)}
    found = MoversRecord.of_result(done.result, {}).movers
    print("\n| mover | kind (true) | moves from (true) | found | moved (true) cm | turn (true) deg | error cm, deg |")
    print("|---|---|---|---|---|---|---|")
    for mover in found:
        told = [{m["instance_id"]: m for m in frame["movers"]}.get(mover.instance) for frame in truth]
        if mover.instance not in rigid:
            print(f"| {mover.id}, none of the true ones | {mover.kind} | {mover.moves[0][0]} | {mover.found} | | | |")
            continue
        begun = next((k for k, m in enumerate(told) if m and m["moving"] and m["visible_px"] > 0), -1)
        kind = "rigid" if rigid[mover.instance] else "not rigid"
        words = f"| {mover.title} | {mover.kind} ({kind}) | {mover.moves[0][0]} ({begun}) | {mover.found} |"
        if mover.displacement is None or mover.before is None or mover.after is None:
            print(f"{words} | | | |")
            continue
        own, first = mover.displacement, true_poses[0]
        old, new = told[mover.before.frame], told[mover.after.frame]
        assert old is not None and new is not None and first is not None
        T_run_world = inverse(first)  # a run's world is its first camera
        T_world_new, T_world_old = (np.array(m["T_world"], float) for m in (new, old))
        T_true = T_run_world @ T_world_new @ inverse(T_world_old) @ inverse(T_run_world)
        at = mover.before.T_world_mover[:3, 3][None]
        go, turn = separation(np.eye(4), T_true)
        go = float(np.linalg.norm(transform_points(at, T_true) - at))
        off = 100 * float(np.linalg.norm(transform_points(at, T_true) - transform_points(at, own.T_new_old)))
        degrees = separation(T_true, own.T_new_old)[1]
        print(f"{words} {100 * own.distance_m:.1f} ({100 * go:.1f}) | {own.turn_deg:.1f} ({turn:.1f}) | "
              f"{off:.2f}, {degrees:.2f} |")  # fmt: skip


def bench_still(data: Path, more: list[str], stop: int | None) -> None:
    """Recordings in which nothing moves."""
    print("| recording | frames with a mover | most pixels | ATE cm with, without | processor s with, without |")
    print("|---|---|---|---|---|")
    for name in STILL:
        on, off = (run(data / name, [f"movers.enabled={v}", *more], stop) for v in ("true", "false"))
        most = max((mask.mean() for mask in on.masks.values()), default=0)
        ates = ", ".join(f"{ate_cm(r, data / name, stop):.3f}" for r in (on, off))
        print(f"| {name} | {len(on.masks)} | {most:.2%} | {ates} | {on.seconds:.1f}, {off.seconds:.1f} |", flush=True)


def bench_generated(count: int, more: list[str], stop: int | None) -> None:
    """Generated rooms against their twins."""
    for seed in range(count):
        with tempfile.TemporaryDirectory() as folder:
            path, twin = Path(folder) / "busy", Path(folder) / "still"
            write_synthetic_sequence(path, seed=seed, movers=MOVERS)
            write_synthetic_sequence(twin, seed=seed, frames=SynthTuning.frames_with_movers)
            print(f"\nroom {seed}")
            bench_movers(path, twin, more, stop)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of the recordings")
    parser.add_argument("--synth", type=int, default=0, metavar="N", help="generated rooms instead")
    parser.add_argument("--only", choices=["movers", "still"])
    parser.add_argument("--masks", choices=["recording", "none", "geometry", "auto"], default="auto")
    parser.add_argument("--stop", type=int, help="frames of each recording")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting")
    given = parser.parse_args()
    more = [f"masks.source={given.masks}", *given.set]
    if given.synth:
        return bench_generated(given.synth, more, given.stop)
    if given.data is None:
        parser.error("expected the folder of the recordings, or --synth")
    if given.only != "still":
        bench_movers(given.data / "livingroom_movers", given.data / "livingroom_movers_static", more, given.stop)
    if given.only != "movers":
        bench_still(given.data, more, given.stop)


if __name__ == "__main__":
    main()
