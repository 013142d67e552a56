# SPDX-License-Identifier: Apache-2.0
"""Recordings of laser scans: points without a position are left out of every scan, and told of once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.localization.scans import ScanSequence


@pytest.mark.parametrize("suffix", [".bin", ".npy"])
def test_points_without_a_position_are_left_out_and_told_of_once(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    scans = [rng.normal(size=(400, 4)).astype("<f4") * [30, 30, 3, 0.1] for _ in range(4)]
    for number, gone in enumerate([0, 30, 0, 70]):
        scans[number] = scans[number].astype("<f4")
        scans[number][:gone, 1] = np.nan
        path = tmp_path / f"{number:06}{suffix}"
        scans[number].tofile(path) if suffix == ".bin" else np.save(path, scans[number])
    read = list(ScanSequence(tmp_path).stream())
    for scan, stored, gone in zip(read, scans, [0, 30, 0, 70], strict=True):
        assert scan.points.dtype == np.float32 and np.array_equal(scan.points, stored[gone:, :3])
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 1 and f"000001{suffix}: left out 30 of 400 points" in told[0]
