# SPDX-License-Identifier: Apache-2.0
"""The scores of reports: where they are, how they are written, which way is better, and what they mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ggslam.jobs.report.run_data import RunData


@dataclass(frozen=True)
class Metric:
    """One score.

    Attributes:
        name: for people.
        keys: where it stands in metrics.json, or after "timing" in timing.json, which runs have that were not scored.
        factor: from the file's unit to the shown one.
        form: how the number is written.
        unit: shown.
        better: which way.
    """

    name: str
    keys: Sequence[str]
    factor: float
    form: str
    unit: str
    better: Literal["higher", "lower", ""]

    def of(self, run: RunData) -> float | None:
        """The value in the shown unit; None if the run does not have it."""
        timed = self.keys[0] == "timing"
        record, keys = (run.timing, self.keys[1:]) if timed else (run.metrics, self.keys)
        value = None if record is None else record.number(*keys)
        return None if value is None else self.factor * value

    def text(self, value: float | None) -> str:
        """The number as text, without unit."""
        return "-" if value is None else format(value, self.form)


METRICS = (
    Metric("PSNR, held out", ("images", "held_out", "psnr"), 1, ".2f", "dB", "higher"),
    Metric("SSIM, held out", ("images", "held_out", "ssim"), 1, ".3f", "", "higher"),
    Metric("LPIPS, held out", ("images", "held_out", "lpips"), 1, ".3f", "", "lower"),
    Metric("depth L1, held out", ("images", "held_out", "depth_l1_m"), 100, ".2f", "cm", "lower"),
    Metric("points off the surface, median", ("surface", "median_m"), 100, ".2f", "cm", "lower"),
    Metric("F1 of points at 1 cm", ("surface", "f1_1cm"), 100, ".1f", "%", "higher"),
    Metric("PSNR, all frames", ("images", "all", "psnr"), 1, ".2f", "dB", "higher"),
    Metric("ATE RMSE", ("trajectory", "ate_rmse_m"), 100, ".2f", "cm", "lower"),
    Metric("RPE, translation", ("trajectory", "rpe_trans_m"), 100, ".2f", "cm", "lower"),
    Metric("RPE, rotation", ("trajectory", "rpe_rot_deg"), 1, ".3f", "deg", "lower"),
    Metric("mIoU of objects, held out", ("segmentation", "held_out", "miou"), 100, ".1f", "%", "higher"),
    Metric("frames/s", ("timing", "frames_per_s"), 1, ".1f", "", "higher"),
    Metric("tracking a frame", ("timing", "tracking_ms_per_frame"), 1, ".1f", "ms", "lower"),
    Metric("Gaussians", ("timing", "gaussians"), 1, ",.0f", "", ""),
    Metric("peak memory", ("timing", "peak_rss_mb"), 1, ",.0f", "MB", "lower"),
)
TILES = (
    "PSNR, held out", "SSIM, held out", "LPIPS, held out", "ATE RMSE", "mIoU of objects, held out", "frames/s",
    "Gaussians", "peak memory",
)  # fmt: skip
"""Scores that stand on top of a report."""

MEANINGS = (
    ("PSNR", "Peak signal-to-noise ratio of a rendered image against the recorded one, in dB: higher is better; 20 dB "
     "is an average error of a tenth of the range from black to white, 40 dB a hundredth."),
    ("SSIM", "Structural similarity, 1 for equal images: how well local contrast and texture agree."),
    ("LPIPS", "Distance of the images in the features of a neural network (AlexNet), 0 for equal ones; nearest to what "
     "people notice, blur above all."),
    ("depth L1", "Mean distance of rendered and measured depth, where both are known."),
    ("points, F1", "points.ply against the recording's depth, fused at the run's poses: how far the points lie from "
     "that surface; precision is the share of them so near to it, recall the share of it so near to a point, F1 their "
     "harmonic mean. Points whose depth no frame measured are left out."),
    ("keyframes, held out, all", "Keyframes were trained on. Held-out frames never were: their scores tell what the "
     "map looks like from new poses. All: every frame of the recording."),
    ("masked, unmasked", "Plain names count the pixels with measured depth; unmasked counts all of them."),
    ("ATE RMSE", "Absolute trajectory error: root mean square distance of estimated and true camera positions, after "
     "the whole trajectory has been laid upon the truth (rotation and translation, no scale)."),
    ("RPE", "Relative pose error: how far the motion from one frame to the next is off, root mean square."),
    ("overlap", "Share of a frame's points that found a partner in the map. Low: little of the view is mapped, or "
     "tracking is about to fail."),
    ("fit", "Root mean square distance of the matched points from the map's surface."),
    ("mIoU", "Mean over objects of (pixels that both masks share) / (pixels that either has). Where masks were made "
     "smaller, pixels that things have like shares of are left out."),
    ("loss", "What the optimiser makes small on the keyframes it trains after each frame: colour (mean absolute "
     "difference), 1 - SSIM and depth (metres), added up with the weights of the settings mapping.loss."),
)  # fmt: skip
