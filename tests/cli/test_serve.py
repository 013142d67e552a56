# SPDX-License-Identifier: Apache-2.0
"""`ggslam serve` and `ggslam run --publish` on the command line."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import ggslam, succeed

from ggslam.runs.folder import RunFolder


def refusal(*words: object) -> str:
    """The one line of a command that is refused."""
    done = ggslam(*words)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done
    return done.stderr


def test_places_that_are_none_are_named(room_run: RunFolder) -> None:
    assert "--publish" in refusal("serve", room_run.path, "--publish", "telegram")
    assert "once" in refusal("serve", room_run.path, "--publish", "ros2,ros2")
    assert "foxglove:99999" in refusal("serve", room_run.path, "--publish", "foxglove:99999")
    assert "'9'" in refusal("serve", room_run.path, "--publish", "a.mcap", "--robot", "9")


def test_a_run_goes_into_a_file(room_run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    mcap = pytest.importorskip("mcap.reader")
    path = tmp_path / "room.mcap"
    said = succeed("serve", room_run.path, "--publish", path, "--no-http")
    assert "published file" in said
    with path.open("rb") as file:
        summary = mcap.make_reader(file).get_summary()
    topics = {channel.topic for channel in summary.channels.values()}
    assert {"/tf_static", "/ggslam/path", "/ggslam/points", "/ggslam/mesh", "/ggslam/distance"} <= topics, topics
    assert summary.statistics.message_count > 10
    assert "is there already" in refusal("serve", room_run.path, "--publish", path, "--no-http")


def test_a_run_is_published_as_it_goes_on(room: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    mcap = pytest.importorskip("mcap.reader")
    path = tmp_path / "run.mcap"
    few = ("--set", "mapping.iterations_per_frame=2", "--refine", "5", "--no-eval", "--stop", "6")
    said = succeed("run", room, "--out", tmp_path / "run", "--publish", path, *few)
    assert f"file: {path}" in said and "published file" in said
    with path.open("rb") as file:
        summary = mcap.make_reader(file).get_summary()
    counts = summary.statistics.channel_message_counts
    by_topic = {channel.topic: counts.get(key, 0) for key, channel in summary.channels.items()}
    assert by_topic["/tf"] == 7 and by_topic["/ggslam/pose"] == 7 and by_topic["/ggslam/points"] >= 1, by_topic
    record = RunFolder.open(tmp_path / "run").timing().model_dump()["publishing"]["outlets"]["file"]
    assert record["channels"]["/tf"]["messages"] == 7 and record["not_taken"] == 0


def test_it_serves_until_ctrl_c(room_run: RunFolder, tmp_path: Path) -> None:
    from urllib.request import urlopen

    words = ["serve", str(room_run.path), "--publish", "http:0"]
    with (tmp_path / "said").open("w") as out:
        process = subprocess.Popen([sys.executable, "-m", "ggslam", *words], stdout=out, stderr=subprocess.STDOUT)
    try:
        end = time.monotonic() + 60
        while (found := re.search(r"http: (\S+)", (tmp_path / "said").read_text())) is None:
            assert time.monotonic() < end and process.poll() is None, (tmp_path / "said").read_text()
            time.sleep(0.1)
        with urlopen(found[1].replace("/?", "/status?"), timeout=20) as answer:
            assert b'"ok": true' in answer.read()
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(20) == 0
    finally:
        process.kill()
