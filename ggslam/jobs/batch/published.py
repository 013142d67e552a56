# SPDX-License-Identifier: Apache-2.0
"""Figures that papers print for scenes of Replica and TUM, to be read beside one's own.

They are scored by each paper's own rules: GS-ICP prints the mean of the aligned error under the name RMSE, and its
PSNR counts training frames, masked; MonoGS every fifth frame that is no keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass

_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
_TUM = ("rgbd_dataset_freiburg1_desk", "rgbd_dataset_freiburg2_xyz", "rgbd_dataset_freiburg3_long_office_household")


@dataclass(frozen=True)
class Published:
    """One column: a method's figures for scenes, in the unit of our column `beside`."""

    title: str
    beside: str
    source: str
    values: dict[str, float]


def _replica(*values: float) -> dict[str, float]:
    return dict(zip(_SCENES, values, strict=True))


def _tum(*values: float) -> dict[str, float]:
    return dict(zip(_TUM, values, strict=True))


PUBLISHED = (
    Published("GS-ICP", "ATE RMSE cm", "arXiv 2403.12550, RTX 4090; the mean error",
              _replica(0.15, 0.16, 0.11, 0.18, 0.12, 0.17, 0.16, 0.21) | _tum(2.7, 1.8, 2.7)),
    Published("RTG-SLAM", "ATE RMSE cm", "SIGGRAPH 2024, on a GPU; TUM with ORB features",
              _replica(0.20, 0.18, 0.13, 0.22, 0.12, 0.22, 0.20, 0.19) | _tum(1.66, 0.38, 1.13)),
    Published("GS-ICP", "PSNR dB", "arXiv 2403.12550, limited to 30 frames/s, RTX 4090; training frames, masked",
              _replica(35.37, 37.80, 38.50, 43.13, 43.26, 36.93, 36.90, 38.75)),
    Published("MonoGS", "PSNR dB", "CVPR 2024, on a GPU; every fifth frame, no keyframes",
              _replica(34.83, 36.43, 37.49, 39.95, 42.09, 36.24, 36.70, 36.07)),
)  # fmt: skip
