# SPDX-License-Identifier: Apache-2.0
"""What a GPU does while frames are processed, by torch's profiler: kernel times by name, how often the host starts work
or waits, and how long nothing runs."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch.autograd import DeviceType

WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaDeviceSynchronize")
LAUNCHES = ("cudaLaunchKernel", "cuLaunchKernel", "cudaGraphLaunch")
LONG_GAP = 50.0
"""Microseconds."""


def profile_report(run: Callable[[], None], frames: int, device: str) -> tuple[dict[str, Any], str, str]:
    """Runs something under the profiler.

    Args:
        run: processes `frames` frames and waits for the device.

    Returns:
        Figures per frame, the same as text with the kernels that take longest, and torch's own table.
    """
    activities = [torch.profiler.ProfilerActivity.CPU]
    if device == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as profiler:
        begin = time.perf_counter()
        run()
        wall = time.perf_counter() - begin
    events = profiler.events()
    on_device = [event for event in events if event.device_type == DeviceType.CUDA and event.name != "frame"]
    busy, gaps = busy_time((event.time_range.start, event.time_range.end) for event in on_device)
    calls: dict[str, int] = defaultdict(int)
    for event in events:
        if event.device_type == DeviceType.CPU and event.name.startswith("cu"):
            calls[event.name] += 1
    figures = {
        "frame_ms": 1e3 * wall / frames,
        "busy_ms": busy / 1e3 / frames,
        "idle_ms": sum(gaps) / 1e3 / frames,
        "long_gaps": sum(gap > LONG_GAP for gap in gaps) / frames,
        "work_items": len(on_device) / frames,
        "launches": sum(n for name, n in calls.items() if name.startswith(LAUNCHES)) / frames,
        "host_waits": sum(calls.get(name, 0) for name in WAITS) / frames,
        "calls": {name: n / frames for name, n in sorted(calls.items())},
        "kernels": kernel_times(on_device, frames),
    }
    order = "self_device_time_total" if device == "cuda" else "self_cpu_time_total"
    table = profiler.key_averages().table(sort_by=order, row_limit=80, max_name_column_width=90)
    return figures, as_text(figures), table


def busy_time(ranges: Iterable[tuple[float, float]]) -> tuple[float, list[float]]:
    """Length of the union of time ranges, and the gaps in it."""
    busy, gaps, end = 0.0, [], None
    for first, last in sorted(ranges):
        if end is None:
            end = first
        if first > end:
            gaps.append(first - end)
        busy += max(0.0, last - max(first, end))
        end = max(end, last)
    return busy, gaps


def kernel_times(events: Iterable[Any], frames: int) -> list[dict[str, Any]]:
    """Milliseconds and number per frame of what ran on the device, longest first."""
    spent: dict[str, list[float]] = defaultdict(list)
    for event in events:
        spent[event.name].append(event.time_range.end - event.time_range.start)
    rows = [
        {"name": name, "ms": sum(times) / 1e3 / frames, "times": len(times) / frames, "longest_us": max(times)}
        for name, times in spent.items()
    ]
    return sorted(rows, key=lambda row: -row["ms"])


def as_text(figures: dict[str, Any]) -> str:
    """A summary to read."""
    lines = ["per frame: " + ", ".join(f"{k} {v:.3f}" for k, v in figures.items() if isinstance(v, float))]
    lines += [f"{row['ms']:9.4f} ms {row['times']:8.2f} x  longest {row['longest_us']:8.1f} us  {row['name'][:100]}"
              for row in figures["kernels"][:60]]  # fmt: skip
    lines += [f"{number:9.2f} x {name}" for name, number in figures["calls"].items()]
    return "\n".join(lines)
