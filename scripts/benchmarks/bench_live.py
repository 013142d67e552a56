#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How frames go from one process to another over Zenoh and over DDS, on 127.0.0.1, and what a live run makes of them.

    python scripts/benchmarks/bench_live.py
    python scripts/benchmarks/bench_live.py --quick
    python scripts/benchmarks/bench_live.py --parts transport --frames 100 --rate 60

Four parts. `transport`: a process sends 640x480 rgb8 and 16UC1 images at a rate; this one takes them. Each carrier is
measured with ROS 2's profile for sensors and with a reliable one of ten messages. `late` is the time from before a
message is sent until its CDR is in the hands of the taker; `send` the time that sending one takes whoever sends; the
processor time of a message is that of the whole process, all threads, of either side. A ratio of two carriers depends
less on the machine than their figures.

`runs`: a generated recording is played at 30 Hz into `ggslam run --realtime 30 --publish ros2,FILE.mcap`, and a third
process keeps all that is published: frames sent, taken, overwritten and lost, delays, bytes a second, messages that
other decoders read otherwise, and the frames' tree against trajectory.txt. `stalls`: what a run of a recording takes
while somebody who listens stands still, as a ratio to the run that is not published. `kills`: player and subscriber are
killed and started anew while a run goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median, quantiles
from typing import Any

from commands import ROOT

sys.path.insert(0, str(ROOT))
from ggslam.middleware.node import SENSOR_DATA, Node, NodeRequest, Publisher, Qos, Received
from ggslam.middleware.opening import open_node
from ggslam.middleware.types import message_types

IMAGE = "sensor_msgs/msg/Image"
TOPICS = {"/camera/color": ("rgb8", 3), "/camera/depth": ("16UC1", 2)}
WIDTH, HEIGHT = 640, 480
PROFILES = {"sensor": SENSOR_DATA, "reliable": Qos(depth=10)}
CARRIERS = ("zenoh", "dds")
PARTS = ["transport", "runs", "stalls", "kills"]
STAMP = struct.Struct("<II")
STAMP_AT = 4
"""Of seconds and nanoseconds in the CDR of a message that begins with a header."""
QUIET_S = 2.0


@dataclass
class Sent:
    """What the sender tells at its end: milliseconds of a message."""

    send_ms: list[float] = field(default_factory=list)
    processor_ms: float = 0.0
    left_out: int = 0


@dataclass
class Taken:
    """Messages of a topic as they came."""

    stamps: list[float] = field(default_factory=list)
    late_ms: list[float] = field(default_factory=list)

    def take(self, received: Received) -> None:
        sec, nanosec = STAMP.unpack_from(received.content, STAMP_AT)
        self.stamps.append(sec + 1e-9 * nanosec)
        self.late_ms.append(1e3 * (received.at - self.stamps[-1]))


def image(encoding: str, bytes_per_pixel: int) -> bytearray:
    """CDR of a picture of noise."""
    types = message_types("jazzy")
    import numpy as np

    stamp = types.make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = types.make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")
    step = bytes_per_pixel * WIDTH
    data = np.random.default_rng(1).integers(0, 255, step * HEIGHT, np.uint8)
    message = types.make(
        IMAGE, header=header, height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0, step=step, data=data
    )
    return bytearray(types.encode(IMAGE, message))


def join(carrier: Any, place: int, listens: bool) -> Node:
    """A node on 127.0.0.1. `place`: a free port; of DDS it chooses the domain."""
    if carrier == "dds":
        return open_node(NodeRequest("dds", 100 + place % 100, "", "127.0.0.1", "jazzy"), "bench")
    address = f"{'listen:' if listens else ''}tcp/127.0.0.1:{place}"
    return open_node(NodeRequest("zenoh", 0, "", address, "jazzy"), "bench")


def send_frames(carrier: str, place: int, profile: str, frames: int, rate: float) -> None:
    """The other process: sends, and writes what it took as JSON."""
    node = join(carrier, place, False)
    ends: list[tuple[Publisher, bytearray]] = []
    for topic, (encoding, bytes_per_pixel) in TOPICS.items():
        ends.append((node.publisher(topic, IMAGE, PROFILES[profile]), image(encoding, bytes_per_pixel)))
    while not all(publisher.subscribers for publisher, _ in ends):
        time.sleep(0.01)
    time.sleep(0.5)
    sent, began, used = Sent(), time.monotonic(), time.process_time()
    for number in range(frames):
        time.sleep(max(0.0, began + number / rate - time.monotonic()))
        for publisher, content in ends:
            at, start = time.time_ns(), time.perf_counter()
            STAMP.pack_into(content, STAMP_AT, at // 10**9, at % 10**9)
            publisher.send(bytes(content))
            sent.send_ms.append(1e3 * (time.perf_counter() - start))
    time.sleep(0.5)
    sent.processor_ms = 1e3 * (time.process_time() - used) / (len(ends) * frames)
    sent.left_out = sum(publisher.left_out for publisher, _ in ends)
    print(json.dumps(asdict(sent)), flush=True)
    sys.stdin.read()
    node.close()


def measure(carrier: str, profile: str, frames: int, rate: float) -> dict[str, Any]:
    """Figures of a carrier and a profile."""
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        place = made.getsockname()[1] if carrier == "zenoh" else random.randrange(100)
    node = join(carrier, place, True)
    taken = {topic: Taken() for topic in TOPICS}
    subscriptions = [node.subscribe(topic, IMAGE, PROFILES[profile], taken[topic].take) for topic in TOPICS]
    command = [sys.executable, __file__, "--sender", carrier, str(place), profile]
    command += ["--frames", str(frames), "--rate", str(rate)]
    sender = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    used = time.process_time()
    assert sender.stdout is not None
    limit = threading.Timer(frames / rate * 2 + 30, sender.kill)
    limit.start()
    line = sender.stdout.readline()
    limit.cancel()
    wanted, end = len(TOPICS) * frames, time.monotonic() + QUIET_S
    while sum(len(one.stamps) for one in taken.values()) < wanted and time.monotonic() < end:
        time.sleep(0.01)
    used = time.process_time() - used
    counted = sum(one.lost + one.overrun for one in subscriptions)
    sender.communicate(timeout=10)
    node.close()
    return figures(Sent(**json.loads(line)), list(taken.values()), counted, used, wanted)


def figures(sent: Sent, taken: list[Taken], counted: int, used: float, wanted: int) -> dict[str, Any]:
    """One row of the table."""
    late = [value for one in taken for value in one.late_ms]
    came = len(late)
    return {
        "came": came, "lost": wanted - came, "counted": counted, "left_out": sent.left_out,
        "in order": all(one.stamps == sorted(one.stamps) for one in taken),
        "late": median(late), "late 95 %": quantiles(late, n=20)[-1],
        "send": median(sent.send_ms), "send 95 %": quantiles(sent.send_ms, n=20)[-1],
        "sender": sent.processor_ms, "taker": 1e3 * used / max(came, 1),
    }  # fmt: skip


def show_transport(frames: int, rate: float) -> None:
    """Prints the table."""
    titles = ("lost", "counted", "order", "late", "95 %", "send", "95 %", "sender", "taker")
    print(f"{frames} frames of {WIDTH}x{HEIGHT} rgb8 and 16UC1 at {rate:g} Hz; times in ms, processor time a message")
    print(f"{'':16}" + "".join(f"{title:>9}" for title in titles))
    for profile in PROFILES:
        rows = {}
        for carrier in CARRIERS:
            row = rows[carrier] = measure(carrier, profile, frames, rate)
            order = "yes" if row["in order"] else "no"
            times = [row[name] for name in ("late", "late 95 %", "send", "send 95 %", "sender", "taker")]
            cells = [f"{row['lost']:9}{row['counted']:9}{order:>9}", *(f"{value:9.2f}" for value in times)]
            print(f"{carrier + ', ' + profile:16}" + "".join(cells), flush=True)
        ratios = [rows["dds"][name] / rows["zenoh"][name] for name in
                  ("late", "late 95 %", "send", "send 95 %", "sender", "taker")]  # fmt: skip
        print(f"{'dds : zenoh':16}{'':27}" + "".join(f"{ratio:9.2f}" for ratio in ratios), flush=True)


def show_live(parts: list[str], frames: int, quick: bool, stall: list[str]) -> None:
    """Prints the tables of whole runs."""
    from live_faults import show_kills, show_stalls
    from live_runs import play_into_run, show_runs

    with tempfile.TemporaryDirectory(prefix="bench-live-") as made:
        folder = Path(made)
        recording, size = folder / "room", ("160", "120") if quick else ("320", "240")
        synth = ["synth", str(recording), "--frames", "24" if quick else "120", "--width", size[0], "--height", size[1]]
        subprocess.run([sys.executable, "-m", "ggslam", *synth], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        some = list(CARRIERS[:1] if quick else CARRIERS)
        more = ["--iterations", "2", "--refine", "10"] if quick else ["--refine", "100"]  # the end is not the subject
        if "runs" in parts:
            print(f"\na generated recording, {'x'.join(size)}, at 30 Hz into a run in real time", flush=True)
            show_runs({name: play_into_run(name, recording, frames, folder / name, more) for name in some})
        if "stalls" in parts:
            place, words = (recording, [*more, "--stop", "12"]) if quick else (Path(stall[0]), stall[1:])
            show_stalls(place, words, some, 1 if quick else 3, folder / "stalls")
        if "kills" in parts:
            show_kills(some, recording, 1.0 if quick else 5.0, folder / "kills")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, help="of a recording that is sent; default 1000")
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second of `transport`")
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS)
    parser.add_argument("--quick", action="store_true", help="everything small, in a minute")
    parser.add_argument("--stall", nargs="+", metavar="WORD", help="recording of `stalls`, and more words for its run; "
                        "default: redkitchen of GGSLAM_DATA --scale .5 --stop 45")  # fmt: skip
    parser.add_argument("--sender", nargs=3, metavar=("CARRIER", "PLACE", "PROFILE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    frames = arguments.frames or (20 if arguments.quick else 1000)
    if arguments.sender:
        carrier, place, profile = arguments.sender
        send_frames(carrier, int(place), profile, frames, arguments.rate)
        return
    if "transport" in arguments.parts:
        show_transport(frames, arguments.rate)
    if arguments.parts != ["transport"]:
        data = Path(os.environ.get("GGSLAM_DATA", ROOT.parent / "shared" / "data"))
        stall = arguments.stall or [str(data / "redkitchen"), "--scale", ".5", "--stop", "45"]
        show_live(arguments.parts, frames, arguments.quick, stall)


if __name__ == "__main__":
    main()
