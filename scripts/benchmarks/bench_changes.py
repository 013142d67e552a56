# SPDX-License-Identifier: Apache-2.0
"""Object-level change between visits to generated rooms, against the truth, as printed in docs/changes.md.

    python scripts/benchmarks/bench_changes.py                          # 20 rooms with 3 to 8 changes, 5 without any
    python scripts/benchmarks/bench_changes.py --rooms 2 --unchanged 1 --folder /tmp/visits
    python scripts/benchmarks/bench_changes.py --geometry               # objects found without masks
    python scripts/benchmarks/bench_changes.py --map  # second visits are run in the maps of the first ones

Each room is recorded twice, from other places and with other noise, and each recording is run with the defaults. Only
what can be known counts: things that both visits looked at (`FEW_PIXELS` in three frames and more), and where something
went or came. A found change is right if its kind is and its surface lies on the thing's. Turns that were said
not to be known, of round and plain things, are counted apart. With `--folder` recordings and runs stay, and are used
again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ggslam.changes.change import Change
from ggslam.changes.change_table import ChangeTable
from ggslam.formats.trajectory import read_tum
from ggslam.jobs.changes.changes import find_changes
from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import inverse, transform_points, turning_angle
from ggslam.sequences import open_sequence
from ggslam.synthetic import write_synthetic_sequence

LEAST_PIXELS, FEW_PIXELS, FRAMES_SEEN, NEAR_M = 20, 60, 3, 0.03


@dataclass
class Score:
    """Of one pair of visits."""

    right: int = 0
    missed: list[str] = field(default_factory=list)
    invented: list[str] = field(default_factory=list)
    off_cm: list[float] = field(default_factory=list)
    turned_deg: list[float] = field(default_factory=list)
    turn_unknown: list[str] = field(default_factory=list)
    seconds: float = 0.0


def run_visit(
    folder: Path, seed: int, count: int, visit: int, given: argparse.Namespace, in_map: Path | None = None
) -> Path:
    """Records and runs a visit, in the map of another one if it is given, unless that is done."""
    recording, out = folder / f"room{seed}-{count}-{visit}", folder / f"run{seed}-{count}-{visit}{given.kind}"
    out = out.with_name(f"{out.name}-in-map") if in_map else out
    if not recording.is_dir():
        write_synthetic_sequence(
            recording, frames=given.frames, width=given.width, height=given.width * 3 // 4, seed=seed, changes=count,
            visit=visit,
        )  # fmt: skip
    if not (out / "map.ply").is_file():
        command = [sys.executable, "-m", "ggslam", "run", str(recording), "--out", str(out), "--no-eval", "--overwrite"]
        more = ["--set", "masks.source=geometry"] if given.geometry else []
        more += ["--map", str(in_map)] if in_map else []
        subprocess.run([*command, *more], check=True, capture_output=True)
    return out


def points_of(recording: Path, instances: set[int]) -> dict[int, tuple[np.ndarray, int]]:
    """World points on each instance that a recording shows, and the number of frames that do."""
    found: dict[int, list[np.ndarray]] = {i: [] for i in instances}
    counts, sequence = dict.fromkeys(instances, 0), open_sequence(recording)
    for frame in sequence:
        assert frame.mask is not None and frame.T_world_camera is not None
        for i in instances:
            row, column = np.nonzero((frame.mask == i) & (frame.depth > 0))
            if len(row) >= LEAST_PIXELS:
                counts[i] += len(row) >= FEW_PIXELS
                z, camera = frame.depth[row, column].astype(float), frame.camera
                local = np.stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z], 1)
                found[i].append(transform_points(local[::7], frame.T_world_camera))
    return {i: (np.concatenate(p) if p else np.zeros((0, 3)), counts[i]) for i, p in found.items()}


def true_world(run: Path) -> np.ndarray:
    """T_truth_run [4, 4]: brings a run's world into that of the true poses."""
    folder, truth = RunFolder.open(run), read_tum(run / "ground_truth.txt")
    trajectory = folder.trajectory()
    at = np.searchsorted(truth.timestamps, trajectory.timestamps[0] - 1e-6)
    return truth.T_world_camera[at] @ inverse(trajectory.T_world_camera[0])


def score(table: ChangeTable, T_truth: np.ndarray, truth: list[dict[str, Any]], shown: list[Any]) -> Score:
    """What was found against what was made."""
    result, left = Score(), [c for c in table.found.changes if c.kind != "look"]
    for made in truth:
        i, sides = made["instance"], {"moved": (0, 1), "removed": (0,), "added": (1,)}[made["kind"]]
        known = all(shown[side][i][1] >= FRAMES_SEEN for side in sides)
        match = next((c for c in left if is_it(c, made, table, T_truth, shown)), None)
        if match is not None:
            left.remove(match)
            if known:
                result.right += 1
                note_pose(result, match, made, T_truth)
        elif known:
            result.missed.append(f"{made['kind']} {made['name']} ({i})")
    result.invented = [f"{c.kind} {table.label(c)}" for c in left]
    return result


def is_it(c: Change, made: dict[str, Any], table: ChangeTable, T_truth: np.ndarray, shown: list[Any]) -> bool:
    """Whether a found change is one that was made: of its kind, and its surface lies where the thing's was and is."""
    if c.kind != made["kind"]:
        return False
    for side in (0, 1):
        points, true = table.points(c, side), shown[side][made["instance"]][0]
        if len(points) and not (len(true) and lies_on(transform_points(points, T_truth), true)):
            return False
    return True


def lies_on(found: np.ndarray, true: np.ndarray) -> bool:
    """Whether points [n, 3] and [m, 3] are of one surface, for the most part."""
    pairs = ((found, true), (true, found))
    return all((cKDTree(b).query(a, distance_upper_bound=NEAR_M)[0] < NEAR_M).mean() > 0.5 for a, b in pairs)


def note_pose(result: Score, c: Change, made: dict[str, Any], T_truth: np.ndarray) -> None:
    """Error of a moved thing's pose: at its middle, and of its turn."""
    if c.T_new_old is None or c.fit is None:
        return
    found, true = T_truth @ c.T_new_old @ inverse(T_truth), np.array(made["T_new_old"])
    middle = np.array([made["middle"]])
    off = transform_points(middle, found) - transform_points(middle, true)
    result.off_cm.append(100 * float(np.linalg.norm(off)))
    if not c.fit.turn_known:
        result.turn_unknown.append(made["name"])
    else:
        result.turned_deg.append(float(np.degrees(turning_angle(found, true))))


def bench_pair(folder: Path, seed: int, count: int, given: argparse.Namespace) -> Score:
    """Both visits to a room."""
    first = run_visit(folder, seed, count, 1, given)
    runs = [first, run_visit(folder, seed, count, 2, given, first if given.map else None)]
    recordings = [folder / f"room{seed}-{count}-{visit}" for visit in (1, 2)]
    truth = json.loads((recordings[1] / "changes.json").read_text())["changes"]
    shown = [points_of(recording, {made["instance"] for made in truth}) for recording in recordings]
    outcome = find_changes(runs[0], runs[1], ids=None if given.ids else False)
    result = score(outcome.table, true_world(runs[0]), truth, shown)
    result.seconds = outcome.seconds
    return result


def line(name: str, s: Score) -> str:
    """A row of the table."""
    known = s.right + len(s.missed)
    words = "; ".join([*(f"missed {m}" for m in s.missed), *(f"invented {m}" for m in s.invented)]) or "-"
    off = f"{np.mean(s.off_cm):.2f}" if s.off_cm else "-"
    turned = f"{np.mean(s.turned_deg):.1f}" if s.turned_deg else "-"
    return f"| {name} | {s.right} of {known} | {off} | {turned} | {s.seconds:.1f} | {words} |"


def totals(scores: list[Score]) -> list[str]:
    """F1 over all pairs, and errors of poses."""
    right = sum(s.right for s in scores)
    wrong = sum(len(s.missed) + len(s.invented) for s in scores)
    lines = [f"F1 {2 * right / max(1, 2 * right + wrong):.3f} ({right} right, {wrong} missed or invented)"]
    off, turned = [v for s in scores for v in s.off_cm], [v for s in scores for v in s.turned_deg]
    for name, unit, values in (("middle", "cm", off), ("turn", "deg", turned)):
        if values:
            middle, most = np.quantile(values, [0.5, 0.9])
            lines.append(f"error of the {name}: median {middle:.2f}, 90 % {most:.2f} {unit} ({len(values)} things)")
    unknown = [name for s in scores for name in s.turn_unknown]
    lines.append(f"turn not known: {len(unknown)} ({', '.join(sorted(set(unknown)))})")
    return lines


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--unchanged", type=int, default=5, help="pairs of visits between which nothing changed")
    parser.add_argument("--first", type=int, default=0, help="seed of the first room")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--geometry", action="store_true", help="objects by geometry instead of masks")
    parser.add_argument("--map", action="store_true", help="run second visits in the maps of the first ones")
    parser.add_argument("--no-ids", dest="ids", action="store_false", help="do not believe ids")
    parser.add_argument("--folder", type=Path, help="where recordings and runs are kept")
    given = parser.parse_args()
    given.kind = "-geometry" if given.geometry else ""
    return given


def main() -> None:
    given = parse_arguments()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        print(f"{given.frames} frames of {given.width} pixels a visit; load {os.getloadavg()[0]:.1f}")
        print("| room | found | middle off, cm | turn off, deg | s | |\n|---|---|---|---|---|---|", flush=True)
        changed = []
        for k in range(given.rooms):
            seed, count = given.first + k, 3 + k % 6
            changed.append(bench_pair(folder, seed, count, given))
            print(line(f"{seed}, {count} changes", changed[-1]), flush=True)
        for k in range(given.unchanged):
            seed = given.first + k
            print(line(f"{seed}, unchanged", bench_pair(folder, seed, 0, given)), flush=True)
        for text in totals(changed) if changed else []:
            print(text)


if __name__ == "__main__":
    main()
