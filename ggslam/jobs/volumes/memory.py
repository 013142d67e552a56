# SPDX-License-Identifier: Apache-2.0
"""How much memory TSDF and distance field may take while frames are fused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from ggslam.slam.config import Config
from ggslam.slam.memory_budget import MB, MemoryBudget
from ggslam.system.staging import make_staging
from ggslam.system.tuning import Tuning
from ggslam.volumes.maps import Paging, VolumeMaps


class VolumeMemoryTuning(Tuning):
    """How a memory limit is kept."""

    measured_after = 4
    """Instants after which the memory of the program is measured. By then every part of it has run."""
    share_of_run = 0.25
    """Share of a limit that volumes take beside a run that is going on; the run keeps to the rest."""


class VolumeBudget:
    """What TSDF and distance field may take; see `Paging.allowed`.

    Args:
        budget: of the process.
    """

    def __init__(self, budget: MemoryBudget) -> None:
        self.budget, self._calls = budget, 0

    def __call__(self, held: int) -> int | None:
        """Bytes that they may take; they take `held` now. None: not known yet."""
        self._calls += 1
        if self._calls == VolumeMemoryTuning.measured_after:
            self.budget.measure(held)
        elif self._calls > VolumeMemoryTuning.measured_after:
            self.budget.check(held)
        return self.budget.map_bytes


def lines_of_cells(maps: VolumeMaps) -> list[str]:
    """What happened to cells, for people; nothing if all stay in memory."""
    if maps.paging is None or maps.pager is None:
        return []
    pager, allowed = maps.pager, maps.paging.allowed
    notes = allowed.budget.notes if isinstance(allowed, VolumeBudget) else []
    exceeded = f"; views need {pager.most_bytes / MB:.0f} MB" if pager.exceeded else ""
    line = (
        f"cells of {pager.cells.edge:.2f} m: {pager.written} went to disk, {pager.read} came back; TSDF and distance "
        f"field took {pager.most_bytes / MB:.0f} MB at most while frames were fused{exceeded}"
    )
    return [*notes, line]


@contextmanager
def cells_on_disk(config: Config, out: Path | None) -> Iterator[Paging | None]:
    """The paging that settings ask for; None if they ask for none. What is on disk goes at the end.

    Args:
        config: the settings.
        out: folder of the volumes; None: of a run that is to be made.

    Raises:
        ConfigError: the program takes more than the limit before it has begun.
    """
    limit, given = config.memory_limit_mb, config.volumes.budget_mb
    if not limit and not given:
        yield None
        return
    if out is None and not given:
        given = VolumeMemoryTuning.share_of_run * limit
    budget = MemoryBudget(0 if out is None else int(limit * MB), int(given * MB))
    folder = make_staging(out) if out is not None else Path(mkdtemp(prefix="ggslam-cells-"))
    try:
        yield Paging(folder, VolumeBudget(budget))
    finally:
        rmtree(folder, ignore_errors=True)
