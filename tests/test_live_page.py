# SPDX-License-Identifier: Apache-2.0
"""The page on live maps does what it says, as printed: a camera that plays, a run that maps it, Foxglove, questions."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE, UNIT = ROOT / "docs" / "live.md", ROOT / "examples" / "ggslam-live.service"
pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="not in a checkout")
WAIT_S = 240.0
OF_A_RUN = ("/tf_static", "/diagnostics", *(f"/ggslam/{name}" for name in (
    "pose", "path", "points", "splats", "mesh", "grid", "distance", "objects",
)))  # fmt: skip
"""Topics that there is something of in every finished run."""


def commands() -> list[str]:
    """Of the section on a robot, without the name of the program."""
    section = PAGE.read_text().split("## A robot in 15 minutes")[1].split("\n## ")[0]
    return re.findall(r"```bash\nggslam (.*)\n```", section)


def is_free(port: int) -> bool:
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) != 0


class Terminal:
    """A command that goes on, with what it said so far."""

    def __init__(self, command: str, place: Path, domain: int) -> None:
        self.log = place / f"{command.split()[0]}.log"
        words = [sys.executable, "-m", "ggslam", *shlex.split(command)]
        env = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(words, cwd=place, stdout=log, stderr=subprocess.STDOUT, env=env)

    def wait_for(self, words: str) -> str:
        """What was said until these words came."""
        end = time.monotonic() + WAIT_S
        while words not in (said := self.log.read_text()):
            assert time.monotonic() < end and self.process.poll() is None, said[-2000:]
            time.sleep(0.2)
        return said

    def end(self) -> int:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


@pytest.fixture
def opened() -> Iterator[list[Terminal]]:
    """Terminals; what still runs is killed at the end."""
    terminals: list[Terminal] = []
    yield terminals
    for terminal in terminals:
        terminal.process.kill()
        terminal.process.wait()


@pytest.mark.long("a camera of 150 frames at 15 a second, its run, and its volumes")
def test_a_robot_in_15_minutes(tmp_path: Path, opened: list[Terminal]) -> None:
    for package in ("zenoh", "rosbags", "foxglove", "mcap"):
        pytest.importorskip(package)
    if not (is_free(8765) and is_free(8090)):
        pytest.skip("another program listens at the ports that the page names")
    synth, play, run, serve, to_file = commands()
    assert synth.startswith("synth") and play.startswith("play") and run.startswith("run") and serve.startswith("serve")
    domain = 100 + os.getpid() % 100
    subprocess.run([sys.executable, "-m", "ggslam", *shlex.split(synth)], cwd=tmp_path, check=True, capture_output=True)
    for command in (play, run):
        opened.append(Terminal(command, tmp_path, domain))
    said = opened[1].wait_for("published (Ctrl-C ends)")
    assert "ws://127.0.0.1:8765" in said and not is_free(8765) and "Traceback" not in said
    address = re.search(r"http://localhost:8090/\?token=\S+", said)
    assert address is not None
    question = re.search(r"curl \"(\S+)\" -d '(.*)'", PAGE.read_text())
    assert question is not None
    asked = question[1].replace("TOKEN", address[0].rpartition("=")[2])
    with urllib.request.urlopen(asked, question[2].encode(), WAIT_S) as answer:
        found = json.load(answer)
    assert found["ok"] and 0.2 < found["distance"][0] < 4  # a metre before the first camera, in its room
    assert opened[1].end() == 0 and opened[0].process.wait(10) == 0
    timing = json.loads((tmp_path / "runs" / "robot" / "timing.json").read_text())
    came = timing["latency"]["arrivals"]  # a busy machine leaves pairs out, and says of each what became of it
    counted = came["taken"] + came["overwritten"] + came["waiting"]
    assert timing["frames"] == came["taken"] >= 5 and came["pairs"] == counted, said
    assert max(came["color"], came["depth"]) <= 150, said
    _check_file(to_file, tmp_path, domain)


def _check_file(command: str, place: Path, domain: int) -> None:
    """The file of a finished run is one that MCAP's own reader takes, and holds what the page lists."""
    from mcap.reader import make_reader

    words, env = shlex.split(command), {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    program = [sys.executable, "-m", "ggslam", *words]
    subprocess.run(program, cwd=place, check=True, env=env, timeout=WAIT_S)
    with (place / words[-1]).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = {summary.channels[id].topic: n for id, n in summary.statistics.channel_message_counts.items()}
    page = PAGE.read_text()
    for topic in OF_A_RUN:
        assert counts.get(topic) and f"`{topic}`" in page, topic


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_the_unit_is_one_that_systemd_takes(tmp_path: Path) -> None:
    text = re.sub(r"^User=.*$", "User=root", UNIT.read_text(), flags=re.M)
    (tmp_path / UNIT.name).write_text(text)
    said = subprocess.run(["systemd-analyze", "verify", str(tmp_path / UNIT.name)], capture_output=True, text=True)
    assert said.returncode == 0 and UNIT.name not in said.stderr, said.stderr


def test_the_command_of_the_unit_is_a_command(tmp_path: Path) -> None:
    """As systemd would start it: its percent signs and dollars undone, with the environment that the unit sets."""
    text = UNIT.read_text()
    command = re.search(r"^ExecStart=/bin/sh -c '(.*)'$", text, re.M)
    topics = re.search(r"^Environment=TOPICS=(.*)$", text, re.M)
    assert command is not None and topics is not None
    shell = command[1].replace("%%", "%").replace("$$", "$").replace("/var/lib/ggslam", str(tmp_path))
    env = {**os.environ, "GGSLAM": "echo", "TOPICS": topics[1]}
    said = subprocess.run(["/bin/sh", "-c", shell], capture_output=True, text=True, env=env, check=True).stdout.split()
    assert said[0] == "run" and said[1] == topics[1] and re.fullmatch(rf"{tmp_path}/\d{{8}}-\d{{6}}", said[-1])
    from typer.testing import CliRunner

    from ggslam.cli.main import app

    refused = CliRunner().invoke(app, [said[0], "--help"])
    assert all(word in refused.output for word in said if word.startswith("--"))
