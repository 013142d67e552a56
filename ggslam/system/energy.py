# SPDX-License-Identifier: Apache-2.0
"""Energy that the machine used, from what Linux shows: counters of the processors (RAPL: running average power limit),
or sensors of the board (INA3221, INA219 and their like, on a Jetson).

A counter is read when somebody asks, and by a thread in between, so that it cannot begin anew twice unseen. A sensor
tells watts: the thread reads it every `EnergyTuning.every_s` seconds, and the power counts until the next reading.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ggslam.system.tuning import Tuning

_SYS = Path("/sys")
_WHOLE_BOARD = ("VDD_IN", "POM_5V_IN")
"""Names of rails that feed the whole board: others on it are parts of them."""


class EnergyTuning(Tuning):
    """How energy is measured."""

    every_s = 0.02
    """Seconds between two readings of a sensor. Power that changes faster is met on average only."""


@dataclass
class Energy:
    """Joules of one measurement; None until it ended, or if the machine has no counters."""

    joules: float | None = None


class EnergySource(Protocol):
    """A counter or a sensor."""

    def look(self) -> None:
        """Reads what has to be read often; may take long."""

    def joules_until(self, now: float) -> float:
        """What was used since the call before.

        Args:
            now: seconds of the meter's clock.

        Raises:
            OSError, ValueError: it cannot be read this time; the next call covers this one.
        """


@dataclass
class _Counter:
    """A RAPL counter of a processor package, which begins anew at the end of its range. Microjoules."""

    zone: Path
    last: int = field(init=False)

    def __post_init__(self) -> None:
        self.last = _number(self.zone / "energy_uj")

    def look(self) -> None:
        """See `EnergySource`."""

    def joules_until(self, now: float) -> float:
        """See `EnergySource`."""
        reading = _number(self.zone / "energy_uj")
        used = reading - self.last
        if used < 0:
            used += _number(self.zone / "max_energy_range_uj")
        self.last = reading
        return used / 1e6


@dataclass
class _Rail:
    """A sensor of one rail of the board.

    Attributes:
        label: the rail's name.
        files: their numbers multiplied are the power.
        unit: of that, watts.
        watts: as read last.
        since: until when it is counted, seconds.
    """

    label: str
    files: tuple[Path, ...]
    unit: float
    watts: float = field(init=False)
    since: float | None = None

    def __post_init__(self) -> None:
        self.watts = self._read()

    def _read(self) -> float:
        watts = self.unit
        for file in self.files:
            watts *= _number(file)
        return max(0.0, watts)  # a sensor of a rail at rest may read a little less than nothing

    def look(self) -> None:
        """See `EnergySource`."""
        with suppress(OSError, ValueError):  # a sensor that is busy measuring: its last word counts on
            self.watts = self._read()

    def joules_until(self, now: float) -> float:
        """See `EnergySource`. The power that was read last has held until now."""
        used = 0.0 if self.since is None else self.watts * (now - self.since)
        self.since = now
        return used


class EnergyMeter:
    """Energy of the whole machine, other programs included. RAPL counters count all processor packages and advance
    about every millisecond.

    Attributes:
        source: what is read, some words; empty if nothing can be.
        note: why there is nothing to read, in one line; empty if there is.

    Args:
        folder: where the kernel shows the devices.
        clock: seconds.
    """

    def __init__(self, folder: Path = _SYS, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock, self._joules = clock, threading.Lock(), 0.0
        self._sources, self.source, note = _counters(folder)
        if not self._sources:
            self._sources, self.source = _rails(folder)
        self.note = "" if self._sources else note

    def joules(self) -> float | None:
        """What was used since some moment; None if there is nothing to read. `watch` has to run between two calls."""
        if not self._sources:
            return None
        with self._lock:
            now = self._clock()
            for source in self._sources:
                with suppress(OSError, ValueError):  # a counter goes on meanwhile
                    self._joules += source.joules_until(now)
            return self._joules

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Reads what has to be read often, in another thread, for as long as the block takes."""
        if not self._sources:
            yield
            return
        self.joules()
        stop = threading.Event()
        thread = threading.Thread(target=self._read_until, args=(stop,), name="energy", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def _read_until(self, stop: threading.Event) -> None:
        while not stop.wait(EnergyTuning.every_s):
            self.look()

    def look(self) -> None:
        """Reads the sensors. Others that ask meanwhile do not wait."""
        self.joules()
        for source in self._sources:
            source.look()

    @contextmanager
    def measure(self) -> Iterator[Energy]:
        """Measures the block; the result is there when it ended."""
        energy = Energy()
        with self.watch():
            before = self.joules()
            yield energy
            after = self.joules()
        if before is not None and after is not None:
            energy.joules = after - before


def _counters(folder: Path) -> tuple[list[EnergySource], str, str]:
    """The counters of all packages, their name, and why there are none."""
    place = folder / "class" / "powercap"
    # intel-rapl:0 is a package (AMD's too), intel-rapl:0:0 a part of it that is counted there already; psys, the whole
    # platform, would count packages twice.
    zones = [z for z in place.glob("intel-rapl:*") if z.name.count(":") == 1]
    zones = [z for z in zones if _text(z / "name").startswith("package")]
    if not zones:
        sensors = folder / "class" / "hwmon"
        return [], "", (
            f"no energy: this machine has no RAPL counters ({place}/intel-rapl:*) and no INA sensors ({sensors})"
        )
    try:
        return [_Counter(zone) for zone in sorted(zones)], "RAPL", ""
    except (OSError, ValueError):
        return [], "", f"no energy: the RAPL counters ({place}/intel-rapl:*/energy_uj) are not readable by this user"


def _rails(folder: Path) -> tuple[list[EnergySource], str]:
    """The sensors to add up, and their names: that of the whole board, or else all there are."""
    rails = [rail for monitor in sorted((folder / "class" / "hwmon").glob("hwmon*")) for rail in _rails_of(monitor)]
    # Kernels of older Jetsons show the same chip as an industrial I/O device.
    for device in sorted((folder / "bus" / "i2c" / "drivers" / "ina3221x").glob("*/iio:device*")):
        for number in range(3):
            name = _text(device / f"rail_name_{number}")
            rails += _rail_if_on(name or f"{device.name}-{number}", (device / f"in_power{number}_input",), 1e-3)
    used = [rail for rail in rails if rail.label in _WHOLE_BOARD][:1] or rails
    return list(used), ", ".join(f"INA {rail.label}" for rail in used)


def _rails_of(monitor: Path) -> list[_Rail]:
    """Rails of one chip: those with a power, else all with both a voltage and a current."""
    if not _text(monitor / "name").startswith("ina"):
        return []
    rails = []
    for number in (1, 2, 3):
        label = _text(monitor / f"in{number}_label") or f"{monitor.name}-{number}"
        power = monitor / f"power{number}_input"
        both = (monitor / f"in{number}_input", monitor / f"curr{number}_input")
        rails += _rail_if_on(label, (power,), 1e-6) or _rail_if_on(label, both, 1e-6)
    return rails


def _rail_if_on(label: str, files: tuple[Path, ...], unit: float) -> list[_Rail]:
    """The rail, or none: it is not there, not readable or switched off."""
    try:
        return [_Rail(label, files, unit)]
    except (OSError, ValueError):
        return []


def _text(path: Path) -> str:
    """The words of a file; none: it is not there."""
    try:
        return path.read_text().strip()
    except (OSError, ValueError):
        return ""


def _number(path: Path) -> int:
    return int(path.read_text())
