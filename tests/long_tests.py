# SPDX-License-Identifier: Apache-2.0
"""Names the tests that take too long and do not say why (`@pytest.mark.long("why")`) at the end of a run; with
`--processor-times N` also the N files and the N tests, fixtures included, that took most.

Processor time counts, of this process and those it starts: the clock on the wall depends on what else the machine does.
What a fixture takes counts for the fixture, since it depends on the order which test is the first to need it.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Generator

import pytest

LONGEST_S = 5.0


def processor_time() -> float:
    """Seconds of this process and of its children that ended."""
    found = os.times()
    return found.user + found.system + found.children_user + found.children_system


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with long tests come first, so that no process is left with one when the others are done."""
    long = {item.path for item in items if item.get_closest_marker("long")}
    items.sort(key=lambda item: item.path not in long)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--processor-times", type=int, default=0, metavar="N", help="the N longest files and tests")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _timed(item, "setup"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    if any(item.get_closest_marker(name) for name in ("long", "slow")):
        item.user_properties.append(("may_be_long", True))
    return (yield from _timed(item, "call"))


def _timed(item: pytest.Item, phase: str) -> Generator[None, object, object]:
    """Notes what a phase of a test takes where the report carries it, also from another process."""
    start = processor_time()
    try:
        return (yield)
    finally:
        item.user_properties.append((f"{phase}_s", round(processor_time() - start, 2)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    tests: dict[str, dict[str, float]] = {}
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        if isinstance(report, pytest.TestReport):
            tests.setdefault(report.nodeid, {}).update(report.user_properties)  # type: ignore[arg-type]
    for name, noted in tests.items():
        if noted.get("call_s", 0) > LONGEST_S and "may_be_long" not in noted:
            terminalreporter.write_line(f"over {LONGEST_S:g} s and does not say why: {name} ({noted['call_s']:.1f} s)")
    count = terminalreporter.config.getoption("--processor-times")
    if not count:
        return
    whole = Counter({name: noted.get("setup_s", 0) + noted.get("call_s", 0) for name, noted in tests.items()})
    files: Counter[str] = Counter()
    for name, seconds in whole.items():
        files[name.split("::")[0]] += seconds
    terminalreporter.write_line(f"{sum(whole.values()):.1f} s of processor time in tests and fixtures; of these:")
    for name, seconds in files.most_common(count) + whole.most_common(count):
        terminalreporter.write_line(f"{seconds:8.1f} s  {name}")
