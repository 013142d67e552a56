# SPDX-License-Identifier: Apache-2.0
"""A camera, a run and somebody who listens, in three processes over Zenoh on 127.0.0.1."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from live_processes import SERVED, LivePlace

sys.path.append(str(Path(__file__).parents[1] / "messages"))
pytest.importorskip("zenoh")
pytest.importorskip("rosbags")
pytest.importorskip("cyclonedds")
pytest.importorskip("mcap_ros2")
pytest.importorskip("foxglove")
pytest.importorskip("google.protobuf")

from compared_decoders import compare_foxglove, compare_recorded, located_ros2  # noqa: E402

from ggslam.jobs.serve.channels import T_CAMERA_OPTICAL  # noqa: E402
from ggslam.messages.pose_numbers import position_and_quaternion  # noqa: E402
from ggslam.runs.folder import RunFolder  # noqa: E402
from ggslam.scene.poses import inverse  # noqa: E402


@pytest.mark.long("three processes that import ggslam")
def test_a_camera_is_mapped_and_what_is_told_is_read_by_others(room: Path, tmp_path: Path) -> None:
    told, file, out = tmp_path / "told.mcap", tmp_path / "foxglove.mcap", tmp_path / "run"
    with LivePlace("zenoh") as place:
        recorder = place.listen(told)
        words = ["--realtime", "30", "--iterations", "2", "--refine", "10", "--publish", f"ros2,{file}"]
        words += ["--record", str(tmp_path / "kept")]  # that meshes and grids are made of
        run = place.run(out, *words, idle_s=3.0)
        player = place.play(room, "--fps", "10")
        assert player.wait(60) == 0
        run.wait_for(SERVED, 60)
        for topic in ("mesh", "grid", "distance"):
            recorder.wait_for(f"topic /ggslam/{topic}", 30)
        assert run.interrupt(30) == 0
        assert recorder.finish(30) == 0
    sent = int(re.search(r"sent (\d+) frames", "\n".join(player.lines))[1])  # type: ignore[index]
    folder = RunFolder.open(out)
    latency = folder.timing().latency
    assert sent == 24 and latency is not None and latency.arrivals is not None and latency.pose is not None
    assert latency.arrivals.pairs == latency.arrivals.taken + latency.arrivals.overwritten + latency.arrivals.waiting
    poses = folder.trajectory()
    assert 12 <= len(poses.T_world_camera) == latency.arrivals.taken and latency.pose.count == latency.arrivals.taken

    compared = compare_recorded(told)
    poses_and_frames = compared.read["cyclonedds"]
    assert not compared.differences and poses_and_frames >= 2 * len(poses.T_world_camera)
    assert compared.read["mcap-ros2-support"] >= poses_and_frames + 8  # of eight more topics one each, at least
    located = located_ros2(told)
    last = max(stamp for name, stamp in located if name == "pose")
    expected = position_and_quaternion(poses.T_world_camera[-1] @ inverse(T_CAMERA_OPTICAL))
    np.testing.assert_allclose(located["pose", last][-1], expected, rtol=0, atol=1e-6)
    foxglove = compare_foxglove(file, located)
    assert not foxglove.differences and foxglove.read["as ROS 2"] >= 2 * len(poses.T_world_camera)
