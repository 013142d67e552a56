# SPDX-License-Identifier: Apache-2.0
"""Pieces of work in worker processes: all are done, whatever becomes of the workers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from cell_work import die_always, die_once, square

from ggslam.errors import ConfigError, FormatError
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.tasks.local_workers import do_locally
from ggslam.jobs.tasks.outcomes import Failure, outcome_of


@pytest.fixture(autouse=True)
def workers_find_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{Path(__file__).parent}:{os.environ.get('PYTHONPATH', '')}")


def done_by(workers: int, work: Any, tasks: list[Any]) -> dict[Any, Any]:
    found: dict[Any, Any] = {}
    do_locally(work, tasks, found.__setitem__, workers)
    return found


@pytest.mark.parametrize("workers", [1, 2])
def test_each_piece_of_work_is_done_once(workers: int) -> None:
    found = done_by(workers, square, [3, -1, 5, 0])
    assert found == {3: 9, -1: Failure("ValueError: negative"), 5: 25, 0: 0}
    assert done_by(workers, square, []) == {}


def test_work_is_asked_for_when_a_worker_is_free() -> None:
    """Cells of a store are read as they are needed: not all of them fit into memory."""
    asked, most = list[int](), list[int]()

    def tasks() -> Any:
        for number in range(12):
            asked.append(number)
            yield number

    do_locally(square, tasks(), lambda task, found: most.append(len(asked) - len(most)), 2)
    assert len(most) == 12 and max(most) <= 2


@pytest.mark.long("workers that die and are begun again")
def test_a_worker_that_dies_is_replaced(tmp_path: Path) -> None:
    tasks = [(str(tmp_path / "died"), number) for number in range(5)]
    assert done_by(2, die_once, tasks) == {task: task[1] for task in tasks}
    assert (tmp_path / "died").exists()


@pytest.mark.long("workers that die and are begun again")
def test_work_that_kills_its_workers_is_given_up(tmp_path: Path) -> None:
    found = done_by(2, die_always, [1, 2, 3])
    assert (found[1], found[3]) == (1, 3) and "died 4 times" in found[2].line and found[2].exit_code == 1


def test_whose_fault_it_was_is_kept() -> None:
    def fail(task: int) -> None:
        raise FormatError("map.ply: damaged")

    assert outcome_of(fail, 1) == Failure("map.ply: damaged", 2)
    with pytest.raises(ConfigError, match="`workers`.* 1.* 0"):
        Engine(workers=0).do(square, [1], lambda task, found: None)


@pytest.mark.slow
def test_work_on_ray(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    found: dict[Any, Any] = {}
    Engine("ray").do(square, [3, -1, 5], found.__setitem__)
    assert found == {3: 9, -1: Failure("ValueError: negative"), 5: 25}
