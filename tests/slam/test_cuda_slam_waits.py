# SPDX-License-Identifier: Apache-2.0
"""What the host waits for in the loop on a device, and that nothing of the host gets mixed into it."""

from __future__ import annotations

from pathlib import Path

import pytest
from device_watch import DeviceWatch

from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.tracking.residual_noise import ResidualNoise

SETTINGS = ["device=cuda", "mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "identity.every=1",
            "identity.pixels=128", "identity.neighbours.samples=20", "identity.neighbours.every=2",
            "identity.final_passes=1", "evaluation.held_out_every=0", "keyframes.max_gap=3"]  # fmt: skip


@pytest.mark.long("the whole loop under emulation")
@pytest.mark.parametrize(("setting", "scale"), [
    ("identity.schedule=sampled", 0.42), ("identity.schedule=votes", 0.42), ("tracker=edges_planes", 0.6),
])  # fmt: skip
def test_the_host_waits_for_a_frame_once(
    room: Path, setting: str, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For its pose; at a keyframe once more, for what the map shows of objects and the number of new Gaussians. Looks
    at the residuals of tracking, which are rare, wait besides."""
    monkeypatch.setattr(ResidualNoise, "due", lambda self: False)
    frames = list(open_sequence(room, scale=scale).stream())[:6]
    with DeviceWatch() as watch:
        slam = Slam(frames[0].camera, load_config(None, [*SETTINGS, setting]), has_masks=True)
        kinds = []
        for frame in frames:
            watch.forget()
            report = slam.step(frame)
            kinds.append(report.is_keyframe)
            waits = [(wait.operation, wait.where) for wait in watch.waits]
            if frame.index > 1:  # the first two show what the camera is like
                assert len(waits) == (2 if report.is_keyframe else 1), waits
                assert not [upload for upload in watch.uploads if upload.blocking]
        assert kinds.count(True) > 1 and kinds.count(False) > 2
        result = slam.finish()
        assert result.gaussians.means.device.type == "cpu" and len(result.gaussians) > 1000
        assert result.objects is not None
