# SPDX-License-Identifier: Apache-2.0
"""The outcome of a task: its result, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ggslam.errors import GgslamError, plain
from ggslam.system.tuning import Tuning

Task = TypeVar("Task")
Result = TypeVar("Result")


class RetryTuning(Tuning):
    """When a piece of work is given up."""

    tries = 4
    """Workers that may die over one piece of work."""


@dataclass(frozen=True)
class Failure:
    """Why there is no result.

    Attributes:
        line: for people.
        exit_code: 2: the user's input is at fault; 1: ggslam or the machine is.
    """

    line: str
    exit_code: int = 1


def outcome_of(work: Callable[[Task], Result], task: Task) -> Result | Failure:
    """Does a piece of work; what goes wrong with it does not reach the others."""
    try:
        return work(task)
    except GgslamError as error:
        return Failure(str(error), error.exit_code)
    except Exception as error:
        return Failure(plain(f"{type(error).__name__}: {error}"))


def worker_died(reason: str = "") -> Failure:
    """Of work whose workers die again and again."""
    return Failure(f"the worker died {RetryTuning.tries} times" + (f": {reason}" if reason else ""))
