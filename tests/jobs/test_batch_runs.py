# SPDX-License-Identifier: Apache-2.0
"""Batches that really run: what is done is not made again, what failed is said, what was cut off goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import succeed
from small_batch import write_small_batch

from ggslam.errors import ConfigError, RunFolderError
from ggslam.jobs.batch.batch import run_batch
from ggslam.jobs.batch.job_process import JobProcess
from ggslam.jobs.batch.job_states import JobState, State, states_of
from ggslam.jobs.batch.manifest import BatchJob, Manifest, read_manifest
from ggslam.jobs.tasks.processors import shares
from ggslam.synthetic import write_synthetic_sequence


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Manifest:
    return read_manifest(write_small_batch(tmp_path_factory.mktemp("batch"), "[first, missing]"))


def told(states: list[JobState]) -> list[State]:
    return [state.state for state in states]


@pytest.mark.long("processes that really run")
def test_runs_are_made_once_and_what_fails_is_said(batch: Manifest) -> None:
    outcome = run_batch(batch, workers=2)
    assert told(outcome.states) == [State.DONE, State.FAILED]
    assert outcome.failures[0].line == f"{batch.jobs[1].words[0]}: no such folder or file"
    assert sorted(path.name for path in outcome.files) == ["table.csv", "table.html", "table.md", "table.tex"]
    assert "first | default | 1" in (batch.out / "table.md").read_text()
    run, before = batch.out / "runs/first/default/seed0", time.time_ns()
    alone = batch.out.parent / "alone"
    succeed("run", *batch.jobs[0].words, "--out", alone, "--no-eval")
    for name in ("map.ply", "trajectory.txt"):
        assert (run / name).read_bytes() == (alone / name).read_bytes()

    again = run_batch(batch, workers=1)
    assert told(again.states) == [State.SKIPPED, State.FAILED]  # neither is made again
    assert (run / "map.ply").stat().st_mtime_ns < before
    assert run_batch(batch, retry=True).failures[0].line == outcome.failures[0].line


def test_other_arguments_are_another_run(batch: Manifest, tmp_path: Path) -> None:
    job = batch.jobs[0]
    state = JobState(job, tmp_path)
    state.begin()
    state.end(2, 1.0, "some reason")
    assert (state.state, state.line) == (State.FAILED, "some reason")
    same = Manifest("same", tmp_path, [job])
    assert told(states_of(same, retry=False)) == [State.FAILED] and told(states_of(same, retry=True)) == [State.WAITING]
    changed = BatchJob(job.recording, job.settings, job.seed, (*job.words, "--stop", "3"))
    assert told(states_of(Manifest("changed", tmp_path, [changed]), retry=False)) == [State.WAITING]
    (tmp_path / "jobs" / job.name / "job.json").write_text("{")
    assert told(states_of(same, retry=False)) == [State.WAITING]


@pytest.mark.slow
def test_a_batch_that_was_killed_goes_on(tmp_path: Path) -> None:
    write_synthetic_sequence(tmp_path / "slow", frames=24, width=64, height=48, seed=0)
    (tmp_path / "batch.yaml").write_text("options: --checkpoint-every 2\nrecordings: [slow]\nout: table\n")
    command = [sys.executable, "-m", "ggslam", "batch", str(tmp_path / "batch.yaml")]
    run = tmp_path / "table/runs/slow/default/seed0"
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    end = time.monotonic() + 120
    while not list((run / "checkpoints").glob("*")) and time.monotonic() < end:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=120)
    assert not (tmp_path / "table/table.md").exists()
    manifest = read_manifest(tmp_path / "batch.yaml")
    outcome = run_batch(manifest)
    assert told(outcome.states) == [State.DONE]
    timing, metrics = (json.loads((run / name).read_text()) for name in ("timing.json", "metrics.json"))
    assert timing["frames"] == 24 and np.isfinite(metrics["images"]["all"]["psnr"])



def test_processors_are_shared_out() -> None:
    there = len(os.sched_getaffinity(0))
    assert len(shares(None)) == max(1, there // 2)
    for workers in (1, 2, 3):
        found = shares(workers)
        assert len(found) == workers and all(len(share) == max(1, there // workers) for share in found)
    with pytest.raises(ConfigError, match="workers"):
        shares(0)


PLANTED = ("runs", "runs/a", "runs/a/b", "runs/a/b/seed0", "jobs", "jobs/a/b/seed0", "jobs/a/b/seed0/log.txt")


@pytest.mark.parametrize("place", PLANTED)
def test_no_link_in_a_batch_leads_its_runs_elsewhere(tmp_path: Path, place: str) -> None:
    victim, out = tmp_path / "victim", tmp_path / "out"
    victim.mkdir()
    (victim / "run.json").write_text("precious")
    link = out / place
    link.parent.mkdir(parents=True)
    link.symlink_to(victim / "run.json" if place.endswith(".txt") else victim)
    with pytest.raises(RunFolderError, match="link.*victim"):
        JobProcess.begin(JobState(BatchJob("a", "b", 0, ("nowhere",)), out), ())
    assert [path.name for path in victim.iterdir()] == ["run.json"]
    assert (victim / "run.json").read_text() == "precious"


@pytest.mark.parametrize("kind", ["hard link", "pipe"])
def test_a_log_takes_the_place_of_what_is_there(tmp_path: Path, kind: str) -> None:
    precious, state = tmp_path / "precious", JobState(BatchJob("a", "b", 0, ("nowhere",)), tmp_path / "out")
    precious.write_text("precious")
    state.log.parent.mkdir(parents=True)
    os.mkfifo(state.log) if kind == "pipe" else os.link(precious, state.log)
    JobProcess.begin(state, ()).process.wait(timeout=60)
    assert precious.read_text() == "precious" and "nowhere" in state.log.read_text()


def test_tables_are_not_written_through_links(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "out" / "table.csv").symlink_to(tmp_path / "precious")
    with pytest.raises(RunFolderError, match=r"table\.csv.*precious"):
        run_batch(Manifest("mine", tmp_path / "out", []), engine="none")
    assert (tmp_path / "precious").read_text() == "precious"
