# SPDX-License-Identifier: Apache-2.0
"""Looking the recordings of a rig over before working with them: which images belong together, what seems wrong."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.scene.poses import inverse, separation
from ggslam.sequences.inspection import SequenceReport, inspect_sequence
from ggslam.sequences.rig import RigSequence, camera_gaps
from ggslam.sequences.verdicts import Verdict
from ggslam.system.tuning import Tuning


class RigInspectionTuning(Tuning):
    """When rig.yaml is doubted."""

    far_m = 0.05
    """Distance of a camera's true pose from its place in rig.yaml, in metres."""
    far_deg = 2.0
    """Rotation between them, in degrees."""
    min_instants = 5
    """Fewest instants with two true poses."""
    max_lacking = 0.05
    """Largest share of the instants at which a camera may lack a frame."""


@dataclass
class RigCameraReport:
    """What was found of a camera of a rig.

    Attributes:
        name: of the camera.
        T_first_camera: [4, 4], where it is, as rig.yaml has it.
        frames: of its recording, as far as they were chosen.
        together: how many of them were taken with one of another camera.
        gap_s: median and largest time by which these are apart from the first camera of their instants, seconds; the
            median has a sign (later: above 0). NaN without any.
        off: metres and degrees by which true poses have it elsewhere than rig.yaml; None when they do not tell.
        recording: of its recording alone.
    """

    name: str
    T_first_camera: np.ndarray
    frames: int
    together: int
    gap_s: tuple[float, float]
    off: tuple[float, float] | None
    recording: SequenceReport


@dataclass
class RigReport:
    """What `inspect_rig` found.

    Attributes:
        name: of the rig.
        instants: how many there are; `whole`: at which all cameras have a frame.
        tolerance: seconds between images that count as taken together.
        cameras: one by one.
        verdicts: what seems wrong by the numbers, of the recordings with the camera's name in front.
        warnings: everything that looks wrong or needs to be known, the texts of the verdicts among it.
    """

    name: str
    instants: int
    whole: int
    tolerance: float
    cameras: list[RigCameraReport]
    verdicts: list[Verdict] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def inspect_rig(sequence: RigSequence, samples: int = 8, masks: bool = True, clocks: bool = False) -> RigReport:
    """Looks at the cameras' times, and at each recording as `inspect_sequence` does, with the same arguments."""
    seen = sequence.instants >= 0
    apart = camera_gaps(sequence)
    report = RigReport(sequence.name, len(seen), int(seen.all(1).sum()), sequence.tolerance, [])
    for k, part in enumerate(sequence.parts):
        together = seen[:, k] & (seen.sum(1) > 1)
        own = apart[together, k]
        gap = (float(np.median(own)), float(np.abs(own).max())) if len(own) else (np.nan, np.nan)
        of_camera = RigCameraReport(
            part.name, sequence.rig.T_first_camera[k], int(seen[:, k].sum()), int(together.sum()), gap,
            _off(sequence, k), inspect_sequence(part.sequence, samples, masks, clocks),
        )  # fmt: skip
        report.cameras.append(of_camera)
        _warn(report, of_camera)
    return report


def _off(sequence: RigSequence, number: int) -> tuple[float, float] | None:
    """See `RigCameraReport.off`."""
    first, part = (sequence.parts[k].sequence.ground_truth for k in (0, number))
    at = sequence.instants[(sequence.instants[:, [0, number]] >= 0).all(1)]
    if number == 0 or first is None or part is None:
        return None
    T_first_camera = inverse(first[at[:, 0]]) @ part[at[:, number]]
    T_first_camera = T_first_camera[np.isfinite(T_first_camera).all((1, 2))]
    if len(T_first_camera) < RigInspectionTuning.min_instants:
        return None
    expected = sequence.rig.T_first_camera[number]
    shift, turn = np.median([separation(T, expected) for T in T_first_camera], axis=0)
    return float(shift), float(turn)


def _warn(report: RigReport, camera: RigCameraReport) -> None:
    lacking = report.instants - camera.frames
    if lacking > RigInspectionTuning.max_lacking * report.instants:
        report.warnings.append(
            f"{camera.name}: no frame at {lacking} of {report.instants} instants; there the others alone are tracked"
        )
    if camera.off is not None and (
        camera.off[0] > RigInspectionTuning.far_m or camera.off[1] > RigInspectionTuning.far_deg
    ):
        text = (
            f"{camera.name}: true poses have it {100 * camera.off[0]:.1f} cm and {camera.off[1]:.1f} degrees from "
            "where T_rig_camera has it; check T_rig_camera (from the camera to the rig), or the poses are of two worlds"
        )
        _judge(report, [Verdict("rig", "wrong", text)])
    found = camera.recording
    _judge(report, [replace(verdict, text=f"{camera.name}: {verdict.text}") for verdict in found.verdicts])
    told = {verdict.text for verdict in found.verdicts}
    report.warnings += [f"{camera.name}: {warning}" for warning in found.warnings if warning not in told]


def _judge(report: RigReport, verdicts: list[Verdict]) -> None:
    report.verdicts += verdicts
    report.warnings += [verdict.text for verdict in verdicts]
