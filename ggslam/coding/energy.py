# SPDX-License-Identifier: Apache-2.0
"""Energy that the processors used, from the counters that Linux offers (RAPL: running average power limit)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_FOLDER = Path("/sys/class/powercap")


@dataclass
class Energy:
    """Joules of one measurement; None until it ended, or if the machine has no counters."""

    joules: float | None = None


class EnergyMeter:
    """Reads the energy counters of all processor packages.

    They count what the whole machine uses, other programs included, and advance about every millisecond.

    Attributes:
        note: why there is nothing to read, in one line; empty if there is.

    Args:
        folder: where the kernel shows the counters.
    """

    def __init__(self, folder: Path = _FOLDER) -> None:
        # intel-rapl:0 is a package (AMD's too), intel-rapl:0:0 a part of it that is counted there already.
        self._zones = sorted(z for z in folder.glob("intel-rapl:*") if z.name.count(":") == 1 and _is_package(z))
        self.note = ""
        if not self._zones:
            self.note = f"no energy: this machine has no RAPL counters ({folder}/intel-rapl:*)"
        elif not all(os.access(zone / "energy_uj", os.R_OK) for zone in self._zones):
            self._zones = []
            self.note = f"no energy: the RAPL counters ({folder}/intel-rapl:*/energy_uj) are not readable by this user"

    @contextmanager
    def measure(self) -> Iterator[Energy]:
        """Measures the block; the result is there when it ended."""
        energy = Energy()
        before = [_number(zone / "energy_uj") for zone in self._zones]
        yield energy
        if not self._zones:
            return
        microjoules = 0
        for zone, start in zip(self._zones, before, strict=True):
            used = _number(zone / "energy_uj") - start
            if used < 0:  # the counter began anew
                used += _number(zone / "max_energy_range_uj")
            microjoules += used
        energy.joules = microjoules / 1e6


def _is_package(zone: Path) -> bool:
    """Whether a zone is a processor package, not the whole platform (psys), which would count packages twice."""
    try:
        return (zone / "name").read_text().startswith("package")
    except OSError:
        return False


def _number(path: Path) -> int:
    return int(path.read_text())
