# SPDX-License-Identifier: Apache-2.0
"""A short scan by a phone's LiDAR: smooth depth that looks noiseless, half a metre away from boards on a floor."""

from __future__ import annotations

from pathlib import Path

import pytest

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.recordings import SequenceRequest


@pytest.mark.long("runs a recording and scores it")
def test_a_phone_scan_is_mapped_by_defaults(shared_data: Path, tmp_path: Path) -> None:
    recording = shared_data / "phone_scan"
    if not recording.is_dir():
        pytest.skip(f"no recording at {recording}")
    request = RunRequest(SequenceRequest(recording), tmp_path / "run", overrides=["identity.enabled=false"])
    metrics = execute(request).metrics
    assert metrics is not None and metrics.images.held_out is not None and metrics.trajectory is not None
    assert metrics.images.held_out.psnr is not None and metrics.images.held_out.psnr > 29
    assert metrics.trajectory.ate_rmse_m < 0.008
