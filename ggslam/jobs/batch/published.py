# SPDX-License-Identifier: Apache-2.0
"""Figures that papers print for scenes of Replica and TUM, to be read beside one's own; only beside the data that the
papers had, and on request with our own figures by each paper's rules.

GS-ICP prints the mean of the aligned error under the name RMSE, and its PSNR counts training frames, masked; MonoGS
counts every fifth frame that is no keyframe.
"""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ggslam.errors import GgslamError
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted_text

_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
_TUM = ("rgbd_dataset_freiburg1_desk", "rgbd_dataset_freiburg2_xyz", "rgbd_dataset_freiburg3_long_office_household")


class PublishedDataTuning(Tuning):
    """When a recording is the papers'."""

    least_share = 0.9
    """Smallest share of the papers' frames that a recording has: TUM's colour images without a depth image near in
    time are left out, by different rules."""


@dataclass(frozen=True)
class Data:
    """What a paper's recording is: width and height in pixels, and its frames."""

    width: int
    height: int
    frames: int


REPLICA_DATA: Final = Data(1200, 680, 2000)
"""NICE-SLAM's renders of Replica's scenes, which all these papers use."""
DATA: Final = {
    **dict.fromkeys(_SCENES, REPLICA_DATA),
    **dict(zip(_TUM, (Data(640, 480, 613), Data(640, 480, 3669), Data(640, 480, 2585)), strict=True)),
}
"""By scene; of TUM the number of colour images."""


def why_other_data(scene: str, record: SequenceRecord | None) -> str | None:
    """Why figures that papers print for a scene do not belong beside a run of it; None: they do, or none are printed.

    Args:
        scene: name of the recording.
        record: what the run was given; None: it is not known.
    """
    data = DATA.get(scene)
    if data is None:
        return None
    if record is None or record.frames is None:
        return f"{scene}: it is not known which frames this run was given"
    camera, frames = record.camera, record.frames
    same_size = (camera.width, camera.height) == (data.width, data.height)
    if same_size and PublishedDataTuning.least_share * data.frames <= frames <= data.frames:
        return None
    return (
        f"{scene}: papers have {data.frames} frames of {data.width}x{data.height}, "
        f"this run {frames} of {camera.width}x{camera.height}"
    )


Rule = Callable[[MetricsRecord, Path], float]
"""Gives our figure by a paper's rules, from a run's metrics and folder; NaN: there is none."""


def _mean_error(metrics: MetricsRecord, run: Path) -> float:
    return _scale(metrics.number("trajectory", "ate_mean_m"), 100)


def _error(metrics: MetricsRecord, run: Path) -> float:
    return _scale(metrics.number("trajectory", "ate_rmse_m"), 100)


def _trained_frames(metrics: MetricsRecord, run: Path) -> float:
    return _scale(metrics.number("images", "keyframes", "psnr"), 1)


def _every_fifth(metrics: MetricsRecord, run: Path) -> float:
    """The mean over every fifth frame that is no keyframe."""
    try:
        rows = list(csv.DictReader(io.StringIO(read_untrusted_text(run / "frames.csv"))))
        found = [float(r["psnr"]) for r in rows if int(r["frame"]) % 5 == 0 and r["kind"] != "keyframe" and r["psnr"]]
    except (GgslamError, KeyError, ValueError):
        return math.nan
    return statistics.fmean(found) if found else math.nan


def _scale(value: float | None, factor: float) -> float:
    return math.nan if value is None else factor * value


@dataclass(frozen=True)
class Published:
    """One column: a method's figures for scenes, in the unit of our column `beside`.

    Attributes:
        title: of the method.
        beside: title of our column.
        source: where they are printed, and by which rules.
        values: by scene.
        rule: gives ours by its rules.
        rule_words: the rules.
    """

    title: str
    beside: str
    source: str
    values: dict[str, float]
    rule: Rule
    rule_words: str


def _replica(*values: float) -> dict[str, float]:
    return dict(zip(_SCENES, values, strict=True))


def _tum(*values: float) -> dict[str, float]:
    return dict(zip(_TUM, values, strict=True))


PUBLISHED = (
    Published("GS-ICP", "ATE RMSE cm", "arXiv 2403.12550, RTX 4090; the mean error",
              _replica(0.15, 0.16, 0.11, 0.18, 0.12, 0.17, 0.16, 0.21) | _tum(2.7, 1.8, 2.7),
              _mean_error, "mean error"),
    Published("RTG-SLAM", "ATE RMSE cm", "SIGGRAPH 2024, on a GPU; TUM with ORB features",
              _replica(0.20, 0.18, 0.13, 0.22, 0.12, 0.22, 0.20, 0.19) | _tum(1.66, 0.38, 1.13),
              _error, "RMSE"),
    Published("GS-ICP", "PSNR dB", "arXiv 2403.12550, limited to 30 frames/s, RTX 4090; training frames, masked",
              _replica(35.37, 37.80, 38.50, 43.13, 43.26, 36.93, 36.90, 38.75),
              _trained_frames, "keyframes, masked"),
    Published("MonoGS", "PSNR dB", "CVPR 2024, on a GPU; every fifth frame, no keyframes",
              _replica(34.83, 36.43, 37.49, 39.95, 42.09, 36.24, 36.70, 36.07),
              _every_fifth, "every fifth frame, no keyframes"),
)  # fmt: skip
