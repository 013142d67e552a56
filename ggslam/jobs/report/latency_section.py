# SPDX-License-Identifier: Apache-2.0
"""The part of a report on latency, beside what was dropped."""

from __future__ import annotations

from ggslam.reporting import page as p
from ggslam.reporting.page import Html
from ggslam.runs.records.timing import SINCE, TimingRecord

_COUNTS = (
    ("colour images", "color"), ("depth images", "depth"), ("pairs", "pairs"), ("pairs taken", "taken"),
    ("pairs that waited at the end", "waiting"),
    ("pairs overwritten by newer ones", "overwritten"), ("images without a partner", "unmatched"),
    ("damaged messages", "damaged"), ("lost by the network", "lost"),
    ("came faster than they were paired", "overrun"),
)  # fmt: skip


def latency_part(timing: TimingRecord | None) -> list[Html]:
    """Of a camera, or of a run in real time; else nothing."""
    latency = None if timing is None else timing.latency
    if timing is None or latency is None:
        return []
    rows = [
        [f"{name} known", str(found.count), f"{1e3 * found.median_s:.1f}", f"{1e3 * found.p95_s:.1f}"]
        for name, found in (("pose", latency.pose), ("map", latency.map)) if found is not None
    ]  # fmt: skip
    since = SINCE.get(latency.since, latency.since)
    note = f"Latency since {since}; frames that came too late and were dropped: {len(timing.dropped_frames)}."
    parts = [p.tag("p", note, class_="note"), p.table(["latency", "frames", "median, ms", "95 %, ms"], rows)]
    if latency.arrivals is not None:
        counts = [[name, f"{latency.arrivals.number(key) or 0:.0f}"] for name, key in _COUNTS]
        counts += [[f"left out: {reason}", str(count)] for reason, count in latency.arrivals.reasons.items()]
        parts.append(p.table(["what came", "number"], counts))
    return parts
