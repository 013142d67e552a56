# SPDX-License-Identifier: Apache-2.0
"""timing.json: where the time of a run went, and how large it became."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import ClassVar, Final

from ggslam.runs.records.record import Number, NumberOrNone, Record, RecordFile
from ggslam.slam.latency import LatencyMeter, Since
from ggslam.slam.result import SlamResult
from ggslam.system.plurals import quantity, word_for
from ggslam.system.process_memory import peak_memory_mb
from ggslam.system.spent import Spent


class MappingTimes(Record):
    """See `mapping.mapper.MapperTimes`."""

    insertion: Number = 0.0
    forward: Number = 0.0
    loss: Number = 0.0
    backward: Number = 0.0
    identity: Number = 0.0
    identity_finish: Number = 0.0
    iterations: int = 0
    keyframes: int = 0


class UsedRecord(Record):
    """See `system.spent.Used`; `joules` is null where they cannot be read."""

    seconds: Number = 0.0
    cpu_s: Number = 0.0
    joules: NumberOrNone = None


class EnergyRecord(Record):
    """What a run used, in all and part by part: what is in one part is in no other. `source` says what was read (null:
    nothing), `note` why nothing could be. `beside`: parts of another thread beside the frames; `cpu_s` is of that
    thread alone, and within what the parts used meanwhile."""

    source: str | None = None
    note: str = ""
    whole: UsedRecord = UsedRecord()
    parts: dict[str, UsedRecord] = {}
    beside: dict[str, UsedRecord] = {}

    @staticmethod
    def of_spent(spent: Spent) -> EnergyRecord:
        """Of what was counted so far."""
        known = bool(spent.meter.source)
        parts = {name: {**asdict(used), **({} if known else {"joules": None})} for name, used in spent.so_far().items()}
        beside = {name: {**asdict(used), "joules": None} for name, used in spent.beside.so_far().items()}
        whole = {key: sum(used[key] for used in parts.values()) for key in ("seconds", "cpu_s", *["joules"][:known])}
        return EnergyRecord.of({
            "source": spent.meter.source or None, "note": spent.meter.note, "whole": whole, "parts": parts,
            "beside": beside,
        })  # fmt: skip

    def text(self) -> str:
        """One line for people: joules, or seconds of the processors where there are none."""
        key, unit = ("cpu_s", "s") if self.source is None else ("joules", "J")
        words = ", ".join(f"{name} {used.number(key) or 0:.1f} {unit}" for name, used in self.parts.items())
        total = f"{self.whole.number(key) or 0:.1f} {unit}"
        if self.beside:
            beside = ", ".join(f"{name} {used.seconds:.1f} s" for name, used in self.beside.items())
            words = f"{words}; in another thread beside the frames: {beside}"
        if self.source is None:
            return f"{self.note}; processor time {total}: {words}"
        return f"energy {total} ({self.source}, the whole machine): {words}"


class DelaysRecord(Record):
    """See `slam.latency.Delays`."""

    count: int = 0
    median_s: Number = 0.0
    p95_s: Number = 0.0


class ArrivalsRecord(Record):
    """What came from a camera over the network: images of colour and depth, pairs of them, pairs that the run took, and
    whether one more waited when it ended; pairs that a newer one overwrote before the run was free, images without a
    partner in time, damaged messages, messages that were sent and did not come, and those that came faster than they
    could be paired. `reasons`: why images were left out."""

    color: int = 0
    depth: int = 0
    pairs: int = 0
    taken: int = 0
    waiting: int = 0
    unmatched: int = 0
    overwritten: int = 0
    damaged: int = 0
    lost: int = 0
    overrun: int = 0
    reasons: dict[str, int] = {}


class LatencyRecord(Record):
    """Delays of a camera, or of a run in real time. `since`: see `slam.latency.Since`; `pose`: until a frame's pose was
    known, `map`: until a keyframe was in the map; `arrivals`: null where the source does not count them."""

    since: str = "stamp"
    pose: DelaysRecord | None = None
    map: DelaysRecord | None = None
    arrivals: ArrivalsRecord | None = None

    @staticmethod
    def of_meter(
        meter: LatencyMeter, since: Since, counts: Mapping[str, int] | None = None,
        reasons: Mapping[str, int] | None = None,
    ) -> LatencyRecord:  # fmt: skip
        """What was measured, and what a source counted."""
        delays = {name: None if found is None else asdict(found)
                  for name, found in (("pose", meter.pose()), ("map", meter.map()))}  # fmt: skip
        arrivals = None if counts is None else {**counts, "reasons": dict(reasons or {})}
        return LatencyRecord.of({"since": since, **delays, "arrivals": arrivals})

    def text(self) -> str:
        """One line for people."""
        parts = [
            f"{word} {1e3 * found.median_s:.0f} ms (95 %: {1e3 * found.p95_s:.0f} ms)"
            for word, found in (("pose", self.pose), ("map", self.map)) if found is not None
        ]  # fmt: skip
        line = f"latency since {SINCE.get(self.since, self.since)}: {', '.join(parts) or 'not measured'}"
        a = self.arrivals
        if a is None:
            return line
        return (
            f"{line}; {quantity(a.pairs, 'pair')} of {a.color} + {a.depth} images, {a.taken} taken, {a.overwritten} "
            f"overwritten; images: {a.unmatched} unmatched, {a.damaged} damaged, {a.lost} lost"
            f"{f', {a.overrun} not paired in time' if a.overrun else ''}"
        )


SINCE: Final = {
    "stamp": "the picture's time stamp", "arrival": "the picture came (stamps are of another clock)",
    "due": "the frame was due",
}  # fmt: skip
"""What latency counts from, in words."""


class TimingRecord(RecordFile):
    """Seconds by part; see `slam.result.SlamTimes`, whose `beside` is `beside_s`. `peak_rss_mb` is in MB (10^6 bytes).
    Of a merged run they are the sums over its runs, and `merge_s` says what merging took, `seam_iterations` the steps
    it made. `energy` is there if it was asked for, `latency` of cameras and of runs in real time."""

    FILE: ClassVar[str] = "timing.json"
    frames: int = 0
    dropped_frames: list[int] = []
    frames_per_s: NumberOrNone = None
    wall_s: Number = 0.0
    tracking_s: Number = 0.0
    loops_s: Number = 0.0
    beside_s: Number = 0.0
    refinement_s: Number = 0.0
    checkpoints_s: Number = 0.0
    checkpoints: int = 0
    tracking_ms_per_frame: NumberOrNone = None
    tracking_ms_per_100_frames: list[NumberOrNone] = []
    mapping_ms_per_iteration: NumberOrNone = None
    refine_iterations: int = 0
    mapping: MappingTimes = MappingTimes()
    gaussians: int | None = None
    peak_rss_mb: NumberOrNone = None
    paging: dict[str, NumberOrNone] | None = None
    merge_s: dict[str, Number] | None = None
    seam_iterations: int | None = None
    energy: EnergyRecord | None = None
    latency: LatencyRecord | None = None

    @staticmethod
    def of_result(result: SlamResult) -> TimingRecord:
        """Of a run that ended; memory is that of this process so far."""
        frames, t, m = max(1, len(result.frames)), result.times, result.mapper_times
        return TimingRecord.of({
            "frames": len(result.frames), "dropped_frames": result.dropped_frames,
            "frames_per_s": result.frames_per_second(),
            "wall_s": t.wall, "tracking_s": t.tracking, "loops_s": t.loops, "beside_s": t.beside,
            "refinement_s": t.refinement, "checkpoints_s": t.checkpoints, "checkpoints": t.saved,
            "tracking_ms_per_frame": 1e3 * t.tracking / frames,
            "tracking_ms_per_100_frames": t.tracking_ms_by_window(), "mapping_ms_per_iteration": m.iteration_ms,
            "refine_iterations": result.refine_iterations, "mapping": asdict(m), "gaussians": result.gaussian_count,
            "peak_rss_mb": peak_memory_mb(), "paging": result.paging,
        })  # fmt: skip

    @property
    def whole_s(self) -> float:
        """Seconds of wall time from the first frame to the end of the last identity steps, the final refinement
        included; scoring and reading the recording's list of frames are not."""
        return self.wall_s + self.refinement_s + self.mapping.identity_finish

    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        if not self.dropped_frames:
            return []
        first, count = self.dropped_frames[0], len(self.dropped_frames)
        were = f"{quantity(count, 'frame')} {word_for(count, 'was', 'were')}"
        return [f"{were} dropped because the run fell behind (the first: {first})"]
