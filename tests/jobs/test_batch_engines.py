# SPDX-License-Identifier: Apache-2.0
"""Batches on Ray, as job arrays, and on a terminal."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_batch import write_small_batch
from typer.testing import CliRunner, Result

from ggslam import __version__
from ggslam.cli.main import app
from ggslam.errors import ConfigError, GgslamError, MissingDependency
from ggslam.jobs.batch import ray_engine
from ggslam.jobs.batch.batch import run_batch, run_one
from ggslam.jobs.batch.job_process import JobProcess
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.manifest import Manifest, read_manifest
from ggslam.jobs.batch.ray_engine import RayJob, make_on_worker
from ggslam.jobs.batch.slurm_script import slurm_script
from ggslam.jobs.tasks.outcomes import Failure
from ggslam.jobs.tasks.ray_cluster import do_on_worker


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_batch(tmp_path_factory.mktemp("engines"), "[missing, first]", frames=5)


def ggslam(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200"})


# --- job arrays ------------------------------------------------------------------------------------------------------


@pytest.mark.long("a process that really runs")
def test_elements_of_an_array_make_the_runs(manifest: Path, tmp_path: Path) -> None:
    """The script's own commands, each by hand, then its table."""
    jobs = read_manifest(manifest, tmp_path / "array")
    result = ggslam("batch", manifest, "--out", jobs.out, "--engine", "slurm", "--write-only")
    assert result.exit_code == 0 and "--array 0-1" in result.output
    assert subprocess.run(["bash", "-n"], input=result.output, text=True).returncode == 0
    wraps = [line.split("--wrap ", 1)[1] for line in result.output.splitlines() if "--wrap" in line]
    element, table = (shlex.split(shlex.split(wrap.rstrip(")"))[0])[3:] for wrap in wraps)
    assert element[-2:] == ["--only", "$SLURM_ARRAY_TASK_ID"]
    assert ggslam(*element[:-1], "0").exit_code == 1 and not (jobs.out / "table.md").exists()
    assert run_one(jobs, 0).state is State.FAILED  # it is not made again
    assert ggslam(*table).exit_code == 1
    assert "missing: no such folder" in (jobs.out / "table.md").read_text() and not (jobs.out / "runs/first").exists()
    with pytest.raises(ConfigError, match="`only`.* 0 .*1.* 2"):
        run_one(jobs, 2)


def test_names_with_spaces_survive_the_script(tmp_path: Path) -> None:
    jobs = Manifest("it's mine", tmp_path / "a b", [])
    words = [str(tmp_path / "a b.yaml"), "--options", "--scale 0.5"]
    text = slurm_script(jobs, words, "--only", "--table-only")
    (tmp_path / "sbatch").write_text('#!/bin/bash\nfor word in "$@"; do echo "[$word]" >&2; done\necho 7\n')
    (tmp_path / "sbatch").chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    found = subprocess.run(["bash"], input=text, text=True, capture_output=True, env=os.environ | {"PATH": path})
    assert found.returncode == 0 and "[it's mine]" in found.stderr and "[afterany:7]" in found.stderr
    assert f"'{words[0]}' --options '--scale 0.5' --only $SLURM_ARRAY_TASK_ID]" in found.stderr
    assert (tmp_path / "a b").is_dir()


def test_engines_are_refused_by_name(manifest: Path) -> None:
    for words, reason in (
        (["--engine", "slurm"], "--write-only"), (["--write-only"], "--engine slurm"), (["--address", "auto"], "ray"),
    ):  # fmt: skip
        result = ggslam("batch", manifest, *words)
        assert isinstance(result.exception, GgslamError) and reason in str(result.exception)


# --- processes -------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="prctl is Linux's")
@pytest.mark.long("a process that starts and is killed")
def test_a_run_dies_with_the_worker_that_made_it(manifest: Path, tmp_path: Path) -> None:
    (tmp_path / "worker.py").write_text(
        "import sys\nfrom pathlib import Path\nfrom ggslam.jobs.batch.job_process import JobProcess\n"
        "from ggslam.jobs.batch.job_states import JobState\nfrom ggslam.jobs.batch.manifest import read_manifest\n"
        "job = read_manifest(sys.argv[1]).jobs[1]\n"
        "worker = JobProcess.begin(JobState(job, Path(sys.argv[2])), (), 1, with_parent=True)\n"
        "print(worker.process.pid, flush=True)\nworker.process.wait()\n"
    )
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "worker.py"), str(manifest), str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    while "tied_process" not in _command(child) and parent.poll() is None:
        time.sleep(0.01)
    time.sleep(0.3)  # it has asked for it
    parent.kill()
    parent.wait()
    end = time.monotonic() + 10
    while _command(child) and time.monotonic() < end:
        time.sleep(0.02)
    assert not _command(child)


def _command(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_text()
    except OSError:
        return ""


def test_what_a_log_said_last(manifest: Path, tmp_path: Path) -> None:
    state = JobState(read_manifest(manifest).jobs[0], tmp_path)
    assert state.last_line() == ""
    state.begin()
    state.log.write_text("tracking\n" * 3000 + "frame 12 of 20, 7.1/s\n\n")
    assert state.last_line() == "frame 12 of 20, 7.1/s"
    state.log.write_text("error: the disk is full\nsome more\n")
    assert state.last_line() == "the disk is full"


# --- Ray -------------------------------------------------------------------------------------------------------------


class _Actor:
    """Stands for the actor that is told of runs that begin."""

    class note:  # noqa: N801
        @staticmethod
        def remote(name: str) -> None:
            """Nothing listens."""


def test_a_worker_without_the_folder_sends_its_files(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, folders = read_manifest(manifest).jobs[0], list[Path]()

    def make(state: JobState, processors: int, with_parent: bool) -> None:
        assert with_parent and processors >= 1
        state.begin()
        state.log.write_text("done\n")
        (state.run / "renders").mkdir(parents=True)
        for name in ("map.ply", "renders/first.png"):
            (state.run / name).write_text(name)
        folders.append(state.out)
        state.end(1, 2.5, "a line")

    monkeypatch.setattr(ray_engine, "make_job", make)
    made = make_on_worker(RayJob(job, "/no/such/folder", "token", _Actor))
    assert made.files is not None and (made.exit_code, made.seconds, made.line) == (1, 2.5, "a line")
    assert not folders[0].exists()  # what the worker made is not left there
    state = JobState(job, tmp_path)
    (state.run / "old").mkdir(parents=True)
    ray_engine._put(state, made.files)
    assert {path.name for path in state.run.rglob("*")} == {"map.ply", "renders", "first.png"}
    assert state.last_line() == "done" and not list(state.run.parent.glob(".*"))

    (tmp_path / "seen").mkdir()
    (tmp_path / "seen/.shared-by").write_text("token")
    assert make_on_worker(RayJob(job, str(tmp_path / "seen"), "token", _Actor)).files is None
    assert folders[-1] == tmp_path / "seen"


def test_another_version_on_the_worker_is_said(manifest: Path, tmp_path: Path) -> None:
    job = RayJob(read_manifest(manifest).jobs[0], str(tmp_path), "token", _Actor)
    made = do_on_worker(make_on_worker, job, "0.0.0")
    assert made == Failure(f"ggslam {__version__} on the worker, 0.0.0 where the work was begun")


def test_ray_that_is_missing_is_named(manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependency, match=r"ggslam\[ray\]"):
        run_batch(read_manifest(manifest, tmp_path / "out"), engine="ray")


@pytest.mark.slow
def test_a_batch_on_ray(manifest: Path, tmp_path: Path) -> None:
    """A cluster on this machine; a worker is killed, and its run is made all the same."""
    pytest.importorskip("ray")
    jobs = read_manifest(manifest, tmp_path / "ray")
    killed = list[int]()

    def kill_once(states: list[JobState]) -> None:
        run = str(states[1].run)
        for folder in Path("/proc").glob("[0-9]*") if not killed else ():
            command = _command(int(folder.name))
            if "tied_process" in command and run in command:
                killed.append(int(folder.name))
                os.kill(int((folder / "status").read_text().split("PPid:")[1].split()[0]), signal.SIGKILL)

    outcome = run_batch(jobs, changed=kill_once, engine="ray")
    assert killed and [state.state for state in outcome.states] == [State.FAILED, State.DONE]
    assert "no such folder" in outcome.failures[0].line
    local = run_batch(read_manifest(manifest, tmp_path / "local"))
    for name in ("map.ply", "trajectory.txt"):
        assert (outcome.states[1].run / name).read_bytes() == (local.states[1].run / name).read_bytes()
    assert run_batch(jobs, engine="ray").states[1].state is State.SKIPPED


@pytest.mark.long("a process that is begun and stopped")
def test_a_process_that_is_stopped_leaves_nothing_running(manifest: Path, tmp_path: Path) -> None:
    worker = JobProcess.begin(JobState(read_manifest(manifest).jobs[0], tmp_path), (), 1)
    worker.ask_to_stop()
    worker.wait_for_end()
    assert worker.process.poll() is not None
