# SPDX-License-Identifier: Apache-2.0
"""Pieces of work on the machines of a Ray cluster. Ray places them, and does one again whose worker died."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any

from ggslam import __version__
from ggslam.errors import GgslamError, MissingDependency
from ggslam.jobs.tasks.outcomes import Failure, RetryTuning, outcome_of, worker_died
from ggslam.jobs.tasks.processors import ProcessorTuning
from ggslam.system.tuning import Tuning


class RayTuning(Tuning):
    """How Ray's tasks are waited for."""

    wait_s = 0.2
    """Seconds between two looks at the tasks."""


class RayCluster:
    """A connection to a cluster.

    Args:
        address: as `ray.init` takes it ("auto": the cluster this machine belongs to); None: one on this machine, for
            as long as this is open.

    Raises:
        MissingDependency: Ray is not installed.
        GgslamError: there is no cluster at the address.
    """

    def __init__(self, address: str | None) -> None:
        try:
            import ray
        except ImportError:
            raise MissingDependency("work on Ray needs it: pip install 'ggslam[ray]'") from None
        dashboard = False if address is None else None
        try:
            ray.init(address=address, include_dashboard=dashboard, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise GgslamError(f"no Ray cluster at {address}: {_first_line(error)}") from None
        self.ray = ray

    def __enter__(self) -> RayCluster:
        return self

    def __exit__(self, *_: object) -> None:
        self.ray.shutdown()

    def do(
        self, work: Callable[[Any], Any], tasks: Iterable[Any], take: Callable[[Any, Any], None],
        changed: Callable[[], None] = lambda: None, at_once: int | None = None,
    ) -> None:  # fmt: skip
        """Does pieces of work; if it is interrupted, they are cancelled.

        Args:
            work: a function of a module; ggslam has to be installed on every machine in this version.
            tasks: its arguments; they, and results, have to be picklable.
            take: is given each piece of work with its result or a `Failure`, in the order in which they end.
            changed: is called now and then.
            at_once: pieces of work that are handed to Ray at a time; None: all.
        """
        ray, waiting, pending = self.ray, iter(tasks), dict[Any, Any]()
        remote = ray.remote(num_cpus=ProcessorTuning.per_worker, max_retries=RetryTuning.tries - 1)(do_on_worker)
        try:
            while True:
                for task in islice(waiting, None if at_once is None else max(0, at_once - len(pending))):
                    pending[remote.remote(work, task, __version__)] = task
                if not pending:
                    return
                done, _ = ray.wait(list(pending), timeout=RayTuning.wait_s)
                for reference in done:
                    take(pending.pop(reference), self._result(reference))
                changed()
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)

    def workers(self) -> int:
        """Pieces of work that the cluster has processors for at the same time, 1 at least."""
        return max(1, int(self.ray.cluster_resources().get("CPU", 1)) // ProcessorTuning.per_worker)

    def _result(self, reference: Any) -> Any:
        try:
            return self.ray.get(reference)
        except self.ray.exceptions.RayError as error:
            return worker_died(_first_line(error))


def do_on_worker(work: Callable[[Any], Any], task: Any, version: str) -> Any:
    """What a worker does; `version` is that of the driver's ggslam."""
    if version != __version__:
        return Failure(f"ggslam {__version__} on the worker, {version} where the work was begun")
    return outcome_of(work, task)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
