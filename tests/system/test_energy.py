# SPDX-License-Identifier: Apache-2.0
"""Counters and sensors of a made-up machine: known powers give known joules; what each part of a program used."""

from __future__ import annotations

import hashlib
import threading
import time
from pathlib import Path

import pytest

from ggslam.system.energy import EnergyMeter, EnergyTuning
from ggslam.system.side_thread import SideThread
from ggslam.system.spent import Spent, count_beside, part
from ggslam.system.tuning import overridden


class Clock:
    """Tells the time that it is given."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def zone(folder: Path, name: str, kind: str, microjoules: int) -> Path:
    """A RAPL counter; returns the file of its value."""
    place = folder / "class" / "powercap" / name
    place.mkdir(parents=True)
    (place / "name").write_text(kind + "\n")
    (place / "energy_uj").write_text(f"{microjoules}\n")
    (place / "max_energy_range_uj").write_text("1000000\n")
    return place / "energy_uj"


def rail(folder: Path, number: int, label: str, millivolts: int, milliamperes: int, chip: str = "ina3221") -> Path:
    """A rail of a sensor; returns the file of its current."""
    place = folder / "class" / "hwmon" / "hwmon3"
    place.mkdir(parents=True, exist_ok=True)
    (place / "name").write_text(chip + "\n")
    (place / f"in{number}_label").write_text(label + "\n")
    (place / f"in{number}_input").write_text(f"{millivolts}\n")
    (place / f"curr{number}_input").write_text(f"{milliamperes}\n")
    return place / f"curr{number}_input"


def joules(meter: EnergyMeter) -> float:
    value = meter.joules()
    assert value is not None
    return value


def test_all_packages_with_counters_that_begin_anew(tmp_path: Path) -> None:
    first = zone(tmp_path, "intel-rapl:0", "package-0", 100)
    second = zone(tmp_path, "intel-rapl:1", "package-1", 900_000)
    inner, platform = zone(tmp_path, "intel-rapl:0:0", "core", 0), zone(tmp_path, "intel-rapl:2", "psys", 0)
    meter = EnergyMeter(tmp_path)
    with meter.measure() as energy:
        assert energy.joules is None
        first.write_text("250100")
        second.write_text("100000")  # 200,000 further, around the end of its range
        inner.write_text("999")
        platform.write_text("999")
    assert energy.joules == pytest.approx(0.45) and meter.note == "" and meter.source == "RAPL"


def test_a_counter_that_begins_anew_three_times_is_followed(tmp_path: Path) -> None:
    counter, total = zone(tmp_path, "intel-rapl:0", "package-0", 0), 0
    meter = EnergyMeter(tmp_path)
    before = joules(meter)
    with meter.watch():
        for _ in range(12):
            total += 250_000
            counter.write_text(str(total % 1_000_000))
            read = time.monotonic() + 5
            while joules(meter) - before < total / 1e6 - 1e-9 and time.monotonic() < read:
                time.sleep(1e-3)
    assert joules(meter) - before == pytest.approx(3.0)


def test_machines_without_counters_say_so(tmp_path: Path) -> None:
    meter = EnergyMeter(tmp_path / "none")
    with meter.measure() as energy:
        pass
    assert energy.joules is None and meter.source == ""
    assert "no RAPL counters" in meter.note and "no INA sensors" in meter.note and "\n" not in meter.note


def test_counters_that_only_root_may_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counter = zone(tmp_path, "intel-rapl:0", "package-0", 100)
    own = Path.read_text

    def refuse(path: Path, *arguments: str) -> str:
        if path == counter:
            raise PermissionError(13, "Permission denied", str(path))
        return own(path, *arguments)

    monkeypatch.setattr(Path, "read_text", refuse)
    meter = EnergyMeter(tmp_path)
    assert meter.joules() is None and "not readable by this user" in meter.note
    rail(tmp_path, 1, "VDD_CPU", 5000, 1000)
    assert EnergyMeter(tmp_path).source == "INA VDD_CPU"  # where the board has sensors they serve


def test_the_rail_of_the_whole_board_counts_alone(tmp_path: Path) -> None:
    clock = Clock()
    rail(tmp_path, 1, "VDD_IN", 19000, 1000)
    rail(tmp_path, 2, "VDD_CPU_GPU_CV", 19000, 400)
    meter = EnergyMeter(tmp_path, clock)
    before = joules(meter)
    clock.now += 10
    assert joules(meter) - before == pytest.approx(190.0, rel=1e-12) and meter.source == "INA VDD_IN"


def test_rails_of_parts_are_added_and_those_switched_off_left_out(tmp_path: Path) -> None:
    clock = Clock()
    rail(tmp_path, 1, "GPU", 5000, 2000)
    rail(tmp_path, 2, "CPU", 5000, 1000)
    rail(tmp_path, 3, "SYS5V", 5000, 500).write_text("")  # reads of a channel that is off give no number
    other = tmp_path / "class" / "hwmon" / "hwmon0"
    other.mkdir()
    (other / "name").write_text("coretemp")
    (other / "power1_input").write_text("99000000")
    meter = EnergyMeter(tmp_path, clock)
    before = joules(meter)
    clock.now += 2
    assert joules(meter) - before == pytest.approx(30.0, rel=1e-12) and meter.source == "INA GPU, INA CPU"


def test_a_chip_that_tells_power_and_an_old_jetson(tmp_path: Path) -> None:
    clock = Clock()
    rail(tmp_path, 1, "", 12, 7, "ina219")
    (tmp_path / "class" / "hwmon" / "hwmon3" / "power1_input").write_text("4000000")
    meter = EnergyMeter(tmp_path, clock)
    before = joules(meter)
    clock.now += 3
    assert joules(meter) - before == pytest.approx(12.0, rel=1e-12)
    old = tmp_path / "old" / "bus" / "i2c" / "drivers" / "ina3221x" / "6-0040" / "iio:device0"
    old.mkdir(parents=True)
    for number, (name, milliwatts) in enumerate((("POM_5V_IN", 3500), ("POM_5V_GPU", 1000), ("POM_5V_CPU", 800))):
        (old / f"rail_name_{number}").write_text(name)
        (old / f"in_power{number}_input").write_text(str(milliwatts))
    meter = EnergyMeter(tmp_path / "old", clock)
    before = joules(meter)
    clock.now += 4
    assert joules(meter) - before == pytest.approx(14.0, rel=1e-12) and meter.source == "INA POM_5V_IN"


def test_power_that_changes_is_met_within_a_reading(tmp_path: Path) -> None:
    """5 W and 15 W by turns of 0.33 s, over 33 s: 330 J; each of the 99 changes may be seen one reading too late."""
    clock = Clock()
    current = rail(tmp_path, 1, "VDD_IN", 5000, 1000)
    meter = EnergyMeter(tmp_path, clock)
    begin, truth, errors = joules(meter), 0.0, []
    for step in range(1650):
        watts = 15 if (step * EnergyTuning.every_s) // 0.33 % 2 else 5
        current.write_text(str(watts * 200))
        clock.now += EnergyTuning.every_s
        truth += watts * EnergyTuning.every_s
        meter.look()
        errors.append(abs(joules(meter) - begin - truth))
    assert truth == pytest.approx(330, abs=1) and max(errors) <= 10 * EnergyTuning.every_s + 1e-9


def test_a_busy_sensor_keeps_its_last_word(tmp_path: Path) -> None:
    clock = Clock()
    current = rail(tmp_path, 1, "VDD_IN", 5000, 1000)
    meter = EnergyMeter(tmp_path, clock)
    before = joules(meter)
    current.unlink()
    for _ in range(3):
        clock.now += 1
        meter.look()
        assert joules(meter) >= before
    assert joules(meter) - before == pytest.approx(15.0)


def test_the_thread_integrates_in_real_time_and_ends(tmp_path: Path) -> None:
    rail(tmp_path, 1, "VDD_IN", 10000, 1000)
    threads = threading.active_count()
    with overridden(EnergyTuning, every_s=0.002):
        start = time.monotonic()
        with EnergyMeter(tmp_path).measure() as energy:
            time.sleep(0.2)
            least = time.monotonic() - start
    most = time.monotonic() - start
    assert energy.joules is not None and 10 * 0.2 <= energy.joules <= 10 * most and least >= 0.2
    assert threading.active_count() == threads


# --- parts of a program ----------------------------------------------------------------------------------------------


def burn(seconds: float) -> None:
    """Keeps a processor busy."""
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


def test_parts_add_up_and_inner_ones_take_from_outer_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("ggslam.system.spent.time.perf_counter", clock)
    rail(tmp_path, 1, "VDD_IN", 10000, 1000)
    spent = Spent(EnergyMeter(tmp_path, clock))
    with part("before"):  # nobody counts yet
        clock.now += 1
    with spent.count_parts("rest"):
        clock.now += 2
        with part("outer"):
            clock.now += 4
            with part("inner"):
                clock.now += 8
            clock.now += 16
        with part("inner"):
            clock.now += 32
        clock.now += 64
        assert spent.so_far()["rest"].seconds == 66
        clock.now += 128
    used = spent.so_far()
    assert {name: one.seconds for name, one in used.items()} == {"rest": 194, "outer": 20, "inner": 40}
    for one in used.values():  # 10 W all the time
        assert one.joules == pytest.approx(10 * one.seconds, rel=1e-9)


def test_processor_seconds_go_to_the_part_that_used_them(tmp_path: Path) -> None:
    spent = Spent(EnergyMeter(tmp_path))
    with spent.count_parts("rest"):
        with part("outer"):
            burn(0.02)
            with part("inner"):
                burn(0.06)
        with part("inner"):
            burn(0.04)
        time.sleep(0.03)
    used = spent.so_far()
    assert 0.1 <= used["inner"].cpu_s < 0.2 and 0.02 <= used["outer"].cpu_s < 0.06
    assert used["rest"].cpu_s < 0.03 <= used["rest"].seconds


def test_what_runs_side_by_side_is_one_part_and_other_threads_are_not_split(tmp_path: Path) -> None:
    spent = Spent(EnergyMeter(tmp_path))

    took = []

    def other() -> None:
        with part("of the other thread"):
            start = time.thread_time()
            hashlib.sha256(bytes(30_000_000))  # beside this thread: it does not hold the interpreter
            took.append(time.thread_time() - start)

    with spent.count_parts("rest"), part("both", whole=True):
        thread = threading.Thread(target=other)
        thread.start()
        own = time.thread_time()
        with part("within"):
            burn(0.01)
        own = time.thread_time() - own
        thread.join()
    used = spent.so_far()
    assert list(used) == ["rest", "both"] and used["both"].cpu_s >= took[0] + 0.9 * own and used["both"].joules == 0


def test_what_another_thread_does_beside_is_counted_apart(tmp_path: Path) -> None:
    spent = Spent(EnergyMeter(tmp_path))

    def work() -> str:
        with part("loops"):
            burn(0.04)
            time.sleep(0.03)
        burn(0.02)
        return "done"

    assert count_beside(work, "mapping") is work  # nothing is counted
    side = SideThread[str]("beside")
    with spent.count_parts("rest"):
        for _ in range(2):
            side.start(count_beside(work, "mapping"))
            with part("tracking"):
                assert side.take() == "done"
    used, beside = spent.so_far(), spent.beside.so_far()
    assert list(used) == ["rest", "tracking"] and list(beside) == ["mapping", "loops"]
    assert 0.08 <= beside["loops"].cpu_s < 0.14 <= beside["loops"].seconds and beside["mapping"].cpu_s >= 0.04
    assert beside["loops"].seconds + beside["mapping"].seconds <= used["tracking"].seconds + used["rest"].seconds
    assert used["tracking"].cpu_s >= 0.12  # of the whole process
    side.start(count_beside(work, "mapping"))
    side.take()
    assert spent.beside.so_far() == beside


def test_an_error_closes_its_part(tmp_path: Path) -> None:
    spent = Spent(EnergyMeter(tmp_path))
    with spent.count_parts("rest"):
        with pytest.raises(ValueError, match="x"), part("bad"):
            raise ValueError("x")
        burn(0.02)
    assert spent.so_far()["rest"].cpu_s >= 0.02 > spent.so_far()["bad"].cpu_s
    with part("after"):
        pass
    assert "after" not in spent.so_far()
