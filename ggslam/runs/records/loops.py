# SPDX-License-Identifier: Apache-2.0
"""loops.json: closed loops, other candidates, and stretches in which the camera was lost."""

from __future__ import annotations

from dataclasses import asdict
from typing import ClassVar

from ggslam.runs.records.record import Number, Record, RecordFile
from ggslam.slam.result import SlamResult
from ggslam.system.plurals import quantity


class LoopEventRecord(Record):
    """See `slam.loop_results.LoopEvent`."""

    kind: str
    frame: int
    keyframe: int
    old_keyframe: int
    reason: str = ""
    moved_m: Number = 0.0


class LostStretchRecord(Record):
    """See `slam.result.LostStretch`."""

    first: int
    frames: int
    seconds: Number
    after: int | None = None


class LoopsRecord(RecordFile):
    """What happened besides tracking and mapping; `seconds` is the time it took."""

    FILE: ClassVar[str] = "loops.json"
    seconds: Number = 0.0
    events: list[LoopEventRecord] = []
    lost: list[LostStretchRecord] = []

    @staticmethod
    def of_result(result: SlamResult) -> LoopsRecord:
        """Of a run that ended."""
        events, lost = (list(map(asdict, found)) for found in (result.loop_events, result.lost_stretches()))
        return LoopsRecord.of({"seconds": result.times.loops, "events": events, "lost": lost})

    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        notes = [
            f"loop closed at frame {e.frame}: keyframe {e.keyframe} moved {100 * e.moved_m:.1f} cm to keyframe "
            f"{e.old_keyframe}"
            for e in self.events if e.kind == "closed"
        ]  # fmt: skip
        notes += [_note_of_part(e) for e in self.events if e.kind in ("joined", "left out")]
        begun = {e.frame: e.reason for e in self.events if e.kind == "new part"}
        reasons = {e.frame: e.reason for e in self.events if e.kind == "found again"}
        for stretch in self.lost:
            ending = " and not found again"
            if stretch.after in begun:
                ending = f"; {begun[stretch.after]} at frame {stretch.after}"
            elif stretch.after is not None:
                reason = reasons.get(stretch.after)
                ending = f", found again at frame {stretch.after}" + (f": {reason}" if reason else "")
            length = f"{quantity(stretch.frames, 'frame')} ({stretch.seconds:.2f} s)"
            notes.append(f"lost for {length} from frame {stretch.first}{ending}")
        return notes


def _note_of_part(event: LoopEventRecord) -> str:
    if event.kind == "left out":
        return event.reason
    when = f"at frame {event.frame}" if event.frame >= 0 else "when the recording had ended"
    return f"{event.reason} {when}"
