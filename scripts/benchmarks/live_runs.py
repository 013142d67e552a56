# SPDX-License-Identifier: Apache-2.0
"""A generated recording that is played into a run which publishes, in processes of their own, for bench_live.py: what
was lost, how late poses and map are, what was sent, and whether other decoders read the same."""

from __future__ import annotations

import re
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from commands import ROOT

sys.path.insert(1, str(ROOT / "tests" / "jobs"))
sys.path.insert(1, str(ROOT / "tests" / "messages"))
from compared_decoders import Compared, compare_foxglove, compare_recorded, located_ros2, read_recorded
from live_processes import SERVED, LivePlace, Said

from ggslam.jobs.serve.channels import CAMERA, ODOM, T_CAMERA_OPTICAL
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.timing import LatencyRecord
from ggslam.scene.poses import quaternion_to_matrix, separation

__all__ = ["SERVED", "LivePlace", "LiveRun", "Said", "frames_sent", "play_into_run", "read_recorded", "show_runs"]

RATE = 30
REALTIME = ["--realtime", str(RATE)]
PATH = "/ggslam/path"


@dataclass
class LiveRun:
    """What a run was told and told.

    Attributes:
        sent: frames by the player.
        latency: as of timing.json.
        seconds: in which messages came while frames did.
        bytes, messages: by topic, of the same time.
        ros2, foxglove: by other decoders.
        end_m, end_deg: of the last frame, from map -> camera_optical to trajectory.txt.
        path_m: of all frames, from the last path to trajectory.txt, the most.
    """

    sent: int
    latency: LatencyRecord
    seconds: float = 0.0
    bytes: Counter[str] = field(default_factory=Counter)
    messages: Counter[str] = field(default_factory=Counter)
    ros2: Compared = field(default_factory=Compared)
    foxglove: Compared = field(default_factory=Compared)
    end_m: float = np.nan
    end_deg: float = np.nan
    path_m: float = np.nan


def frames_sent(player: Said) -> int:
    """Frames that a player says it sent."""
    found = re.search(r"sent (\d+) frames?", "\n".join(player.lines))
    return int(found[1]) if found else 0


def play_into_run(middleware: str, recording: Path, frames: int, folder: Path, words: list[str]) -> LiveRun:
    """Plays a recording, round after round, at 30 Hz for so many frames after the first one was located.

    Args:
        middleware: zenoh or dds.
        recording: the recording.
        frames: to play.
        folder: that is made for what is written.
        words: more, for the run.
    """
    folder.mkdir()
    told, file, out = folder / "told.mcap", folder / "foxglove.mcap", folder / "run"
    with LivePlace(middleware) as place:
        recorder = place.listen(told)
        run = place.run(out, *REALTIME, *words, "--publish", f"ros2,{file}", idle_s=2.0)
        player = place.play(recording, "--fps", str(RATE), "--loop")
        recorder.wait_for("topic /tf", 60)
        time.sleep(frames / RATE)
        player.interrupt(20)
        run.wait_for(SERVED, 300)
        recorder.wait_for("topic /ggslam/changes", 30)
        run.interrupt(60)
        recorder.finish(60)
    latency = RunFolder.open(out).timing().latency
    assert latency is not None
    live = LiveRun(frames_sent(player), latency)
    _count_bytes(live, told)
    live.ros2, live.foxglove = compare_recorded(told), compare_foxglove(file, located_ros2(told))
    _compare_poses(live, told, out)
    return live


def _count_bytes(live: LiveRun, told: Path) -> None:
    """While frames came: from the first edges of frames to the last ones but those of the end."""
    came = [(topic, at, len(content)) for topic, _, at, content, _ in read_recorded(told)]
    times = [at for topic, at, _ in came if topic == "/tf"][:-1]
    live.seconds = times[-1] - times[0]
    for topic, at, size in came:
        if times[0] <= at <= times[-1]:
            live.messages[topic] += 1
            live.bytes[topic] += size


def _compare_poses(live: LiveRun, told: Path, out: Path) -> None:
    edges: dict[str, np.ndarray] = {}
    path: Any = None
    for topic, _, _, _, message in read_recorded(told):
        if topic in ("/tf", "/tf_static"):
            for edge in message.transforms:
                edges[edge.child_frame_id] = _matrix(edge.transform.translation, edge.transform.rotation)
        elif topic == PATH:
            path = message
    written = RunFolder.open(out).trajectory().T_world_camera
    T = edges[ODOM] @ edges[CAMERA] @ edges["camera_optical"]
    live.end_m, live.end_deg = separation(T, written[-1])
    poses = [_matrix(one.pose.position, one.pose.orientation) @ T_CAMERA_OPTICAL for one in path.poses]
    if len(poses) == len(written):
        live.path_m = max(separation(a, b)[0] for a, b in zip(poses, written, strict=True))


def _matrix(t: Any, q: Any) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([q.w, q.x, q.y, q.z]))
    T[:3, 3] = t.x, t.y, t.z
    return T


def show_runs(runs: dict[str, LiveRun]) -> None:
    """Prints the tables, a column for each middleware."""
    rows: dict[str, list[str]] = {}

    def row(name: str, *cells: object) -> None:
        rows.setdefault(name, []).extend(str(cell) for cell in cells)

    for run in runs.values():
        a, latency = run.latency.arrivals, run.latency
        assert a is not None and latency.pose is not None and latency.map is not None
        row("frames sent", run.sent)
        row("taken", a.taken)
        row("overwritten (newest wins)", a.overwritten)
        row("lost or unmatched images, damaged", f"{a.lost}, {a.unmatched}, {a.damaged}")
        left = (a.lost + a.overrun + a.unmatched + 1) // 2
        row("not counted by anybody", run.sent - a.taken - a.overwritten - a.waiting - left)
        for name, delays in (("pose", latency.pose), ("map", latency.map)):
            row(f"capture -> {name}, median (95 %)", f"{1e3 * delays.median_s:.0f} ({1e3 * delays.p95_s:.0f}) ms")
        for decoder in ("mcap-ros2-support", "cyclonedds"):
            row(f"messages read by {decoder}", run.ros2.read[decoder])
        row("Foxglove's read by protobuf", run.foxglove.read["protobuf"])
        row("of their poses told over ROS 2, too", run.foxglove.read["as ROS 2"])
        row("differences", len(run.ros2.differences) + len(run.foxglove.differences))
        row("map -> camera_optical at the end", f"{run.end_m:.1e} m, {run.end_deg:.1e} deg")
        row("path at the end", f"{run.path_m:.1e} m")
        row("sent, all topics", f"{sum(run.bytes.values()) / run.seconds / 1e3:.0f} kB/s")
    topics = sorted({topic for run in runs.values() for topic in run.bytes},
                    key=lambda topic: -sum(run.bytes[topic] for run in runs.values()))  # fmt: skip
    for topic in topics:
        for run in runs.values():
            rate = run.bytes[topic] / run.seconds / 1e3
            row(f"  {topic}", f"{rate:.1f} kB/s, {run.messages[topic] / run.seconds:.1f} Hz")
    print(f"{'':36}" + "".join(f"{name:>28}" for name in runs))
    for name, cells in rows.items():
        print(f"{name:36}" + "".join(f"{cell:>28}" for cell in cells))
    for name, run in runs.items():
        for text in [*run.ros2.differences, *run.foxglove.differences][:5]:
            print(f"differs, {name}: {text}")
    print(
        "Poses are told as they are known by then; at the end the last one is told once more. `map` is until a\n"
        "keyframe is in the map. `not counted` are frames that the player sent while nobody had subscribed.\n"
        "The subscriber takes every topic, so images come raw and compressed. The map's topics share 900 kB/s\n"
        "in the long run; a short run has the burst at its beginning besides."
    )
