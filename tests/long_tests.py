# SPDX-License-Identifier: Apache-2.0
"""Names the tests that take too long and do not say why (`@pytest.mark.long("why")`) at the end of a run.

Processor time counts, of this process and those it starts: the clock on the wall depends on what else the machine does.
What a fixture takes counts for the fixture, since it depends on the order which test is the first to need it.
"""

from __future__ import annotations

import os
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


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    start = processor_time()
    try:
        return (yield)
    finally:
        excused = any(item.get_closest_marker(name) for name in ("long", "slow"))
        item.user_properties += [("processor_s", round(processor_time() - start, 2)), ("excused", excused)]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    found = []
    for reports in terminalreporter.stats.values():
        for report in reports:
            properties = dict(getattr(report, "user_properties", ()))
            if getattr(report, "when", "") == "call" and not properties.get("excused"):
                found.append((properties.get("processor_s", 0.0), report.nodeid))
    for seconds, name in sorted(found, reverse=True):
        if seconds > LONGEST_S:
            terminalreporter.write_line(f"longer than {LONGEST_S:g} s and no reason given: {name} ({seconds:.1f} s)")
