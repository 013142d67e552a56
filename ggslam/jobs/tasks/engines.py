# SPDX-License-Identifier: Apache-2.0
"""Engines that run tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from ggslam.jobs.tasks.local_workers import do_locally
from ggslam.jobs.tasks.outcomes import Failure, Result, Task
from ggslam.jobs.tasks.ray_cluster import RayCluster


@dataclass(frozen=True)
class Engine:
    """Where pieces of work are done.

    Attributes:
        name: "local": processes on this machine; "ray": tasks of a Ray cluster.
        workers: of the local engine; None: one for every two processors.
        address: of the Ray cluster, see `RayCluster`.
    """

    name: Literal["local", "ray"] = "local"
    workers: int | None = None
    address: str | None = None

    def do(
        self, work: Callable[[Task], Result], tasks: Iterable[Task], take: Callable[[Task, Result | Failure], None]
    ) -> None:
        """Does all of it; see `do_locally` and `RayCluster.do` for arguments and errors."""
        if self.name == "local":
            do_locally(work, tasks, take, self.workers)
            return
        with RayCluster(self.address) as cluster:
            cluster.do(work, tasks, take, at_once=2 * cluster.workers())
