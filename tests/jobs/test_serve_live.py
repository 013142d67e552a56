# SPDX-License-Identifier: Apache-2.0
"""A run that is published while it goes on."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from serve_tools import KeptOutlet, SlowOutlet, chain, until

from ggslam.errors import ConfigError
from ggslam.formats.gaussian_ply import read_gaussian_ply
from ggslam.jobs.run.pipeline import Follower, RunOutcome, RunRequest, execute
from ggslam.jobs.serve import channels as c
from ggslam.jobs.serve.frames_tree import T_OPTICAL_CAMERA
from ggslam.jobs.serve.live_contents import LiveContents, LiveContentsTuning
from ggslam.jobs.serve.live_functions import LiveFunctions
from ggslam.jobs.serve.live_serving import AFTER, LIVE, LiveServing
from ggslam.jobs.serve.outlets import PublishRequest
from ggslam.jobs.serve.pausing import Pause
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.sending import SendTuning
from ggslam.jobs.serve.services import MapServices
from ggslam.jobs.serve.serving import ServeRequest
from ggslam.runs.opened_points import surface_points
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, separation
from ggslam.slam.result import StepReport
from ggslam.slam.slam import Slam
from ggslam.system.tuning import overridden

MOVE = se3_exp(np.array([0.4, 0.1, -0.2, 0, 0.15, 0]))
FEW = ["mapping.iterations_per_frame=2", "refine_iterations=10"]


def run_of(room: Path, out: Path, follower: Follower, frames: int = 24, *settings: str) -> RunOutcome:
    request = RunRequest(
        SequenceRequest(room, stop=frames), out=out, overrides=[*FEW, *settings], evaluate=False, check=False
    )
    return execute(request, follower=follower)


def test_a_forced_correction_moves_odom_and_not_the_camera_in_it(room: Path, tmp_path: Path) -> None:
    """The whole world moves after frame 12, as a closed loop moves the part about the camera."""
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, True)], LIVE)
    contents = LiveContents(publisher)
    tracked: list[np.ndarray] = []

    def follow(slam: Slam, frame: Frame, report: StepReport) -> None:
        contents.follow(slam, frame, report)
        tracked.append(report.T_world_camera)
        if frame.index == 12:
            assert slam.loops is not None
            slam.corrections.move_world(MOVE, slam.loops)

    outcome = run_of(room, tmp_path / "run", follow)
    contents.finish(outcome.result)
    assert publisher.wait_idle(10.0)
    trees = [kept.content for kept in outlet.sent if kept.channel == c.TF]
    publisher.close()
    assert len(trees) == 25  # one a frame, and as it came out
    stamps, of_poses = ([round(1e9 * kept.stamp) for kept in outlet.sent if kept.channel == x] for x in (c.TF, c.POSE))
    assert stamps == of_poses == sorted(set(stamps))  # of two of one time, tf2 may keep the first
    odom = [chain(tree, c.ODOM, c.CAMERA) for tree in trees[:24]]
    tracked = [MOVE @ T if k <= 12 else T for k, T in enumerate(tracked)]
    for k in range(1, 24):
        moved = separation(odom[k - 1] @ c.T_CAMERA_OPTICAL, odom[k] @ c.T_CAMERA_OPTICAL)
        np.testing.assert_allclose(moved, separation(tracked[k - 1], tracked[k]), atol=1e-7)
    offset = [chain(tree, c.MAP, c.ODOM) for tree in trees]
    jumps = [separation(a, b)[0] for a, b in zip(offset[:-1], offset[1:], strict=True)][:23]
    assert int(np.argmax(jumps)) == 12 and jumps[12] > 0.3
    assert max(jump for k, jump in enumerate(jumps) if k != 12) < 0.02
    final = chain(trees[-1], c.MAP, c.ODOM, c.CAMERA) @ c.T_CAMERA_OPTICAL
    np.testing.assert_allclose(final, outcome.result.trajectory()[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(odom[-1], chain(trees[-1], c.ODOM, c.CAMERA), rtol=0, atol=0)
    path = outlet.of(c.PATH.name)[-1]
    written = outcome.folder.trajectory().T_world_camera
    np.testing.assert_allclose(path.poses @ inverse(T_OPTICAL_CAMERA), written, rtol=0, atol=3e-9)


def test_everything_is_told_and_the_end_is_the_map_as_saved(room: Path, tmp_path: Path) -> None:
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, True)], LIVE)
    with overridden(LiveContentsTuning, min_rest_s=0.0, map_share=10.0, image_share=10.0, picture_every_s=0.0):
        contents = LiveContents(publisher)
        outcome = run_of(room, tmp_path / "run", contents.follow)
        contents.finish(outcome.result, outcome.folder)
    assert publisher.wait_idle(10.0)
    publisher.close()
    told = {kept.channel.name for kept in outlet.sent}
    assert told == {channel.name for channel in LIVE} - {c.MOVERS.name}
    assert len(outlet.of(c.RECORDED.name)) == 24 == len(outlet.of(c.POSE.name)) - 1
    assert contents.copies >= 2
    surface = cKDTree(surface_points(outcome.folder).points)  # a point each centimetre
    growing, last = (surface.query(outlet.of(c.POINTS.name)[i].xyz)[0] for i in (0, -1))
    assert len(growing) > 2000 and np.median(growing) < 0.012 and np.percentile(growing, 90) < 0.03  # as a Kinect sees
    assert len(last) > 4000 and np.median(last) < 0.005 and np.percentile(last, 99) < 0.01
    level = [verdict.level for verdict in outlet.of(c.VERDICTS.name)[0].verdicts]
    assert level == ["ok", "ok"]
    assert {child for _, child, _ in outlet.of(c.TF_STATIC.name)[-1].edges} == {c.OPTICAL, c.FLOOR}


def test_what_it_costs_is_bounded(room: Path, tmp_path: Path) -> None:
    """With a budget of nothing, one copy of the map is made and no image is sent; poses go out all the same."""
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, True)], LIVE)
    with overridden(LiveContentsTuning, min_rest_s=0.0, map_share=0.0, image_share=0.0, ahead_s=0.0):
        contents = LiveContents(publisher)
        run_of(room, tmp_path / "run", contents.follow, 12)
        contents.stop()
    assert publisher.wait_idle(10.0)
    publisher.close()
    assert contents.copies == 1 and not outlet.of(c.RECORDED.name) and len(outlet.of(c.POSE.name)) == 12
    assert contents.cpu_s > 0


def test_nothing_is_copied_while_nobody_listens(room: Path, tmp_path: Path) -> None:
    publisher = MapPublisher([(KeptOutlet(everybody=0), False)], LIVE)
    contents = LiveContents(publisher)
    contents._floor_due = False
    run_of(room, tmp_path / "run", contents.follow, 6)
    contents.stop()
    publisher.close()
    assert contents.copies == 0 and not publisher.newest(c.POINTS)


def test_a_stalled_outlet_slows_nothing(room: Path, tmp_path: Path) -> None:
    """The first send takes as long as the run."""
    outlet, ended = SlowOutlet(0.0), threading.Event()
    outlet.wait = ended.wait  # type: ignore[method-assign]
    publisher = MapPublisher([(outlet, False)], LIVE)
    contents = LiveContents(publisher)
    run_of(room, tmp_path / "run", contents.follow)
    contents.stop()
    assert outlet.begun == 1 and contents.follow_s < 2.0
    with overridden(SendTuning, end_s=0.1):
        publisher.close()
    ended.set()


# --- functions of a run that goes on -------------------------------------------------------------------------------


def live_serving(outlet: KeptOutlet, beside: Path, opened: ExitStack) -> tuple[LiveServing, MapServices]:
    publisher = MapPublisher([(outlet, False)], (*LIVE, *AFTER, c.grid_channel("")))
    opened.callback(publisher.close)
    pause = Pause()
    functions = LiveFunctions(publisher, pause, beside)
    services = MapServices(functions.functions())
    request = ServeRequest(PublishRequest(()), port=None)
    return LiveServing(publisher, services, functions, pause, request, opened), services


def asking(live: LiveServing, ask: Callable[[], None], at: int = 5) -> Follower:
    """A follower; `ask` runs in a thread from frame `at` on."""

    def follow(slam: Slam, frame: Frame, report: StepReport) -> None:
        if frame.index == at:
            threading.Thread(target=ask, daemon=True).start()
        live.follow(slam, frame, report)

    return follow


def test_a_run_is_held_and_its_map_saved_meanwhile(room: Path, tmp_path: Path) -> None:
    told: dict[str, object] = {}

    def ask() -> None:
        services.call("pause")
        until(lambda: services.call("status")["pauses"] == 1)
        frames = services.call("status")["frames"]
        told["saved"] = services.call("save_map", {"name": "now"})
        with pytest.raises(ConfigError, match="is there already"):
            services.call("save_map", {"name": "now"})
        (tmp_path / "mine.txt").write_text("MINE")
        with pytest.raises(ConfigError, match="mine.txt is there already"):
            services.call("save_map", {"name": "mine"})
        for name in (5, None, ["a"]):
            with pytest.raises(ConfigError, match="name"):
                services.call("save_map", {"name": name})
        time.sleep(0.2)
        told["same"] = services.call("status")["frames"] == frames
        services.call("pause", {"on": False})
        told["seconds"] = services.call("status")["paused_s"]

    with ExitStack() as opened:
        live, services = live_serving(KeptOutlet(everybody=0), tmp_path, opened)
        outcome = run_of(room, tmp_path / "run", asking(live, ask))
        assert len(outcome.result.frames) == 24 and told["same"] is True
        live.finish(outcome)
        assert services.call("status")["live"] is False  # the saved run answers now
        assert outcome.folder.timing().model_dump()["publishing"]["outlets"]["kept"]["failure"] == ""
    assert (tmp_path / "mine.txt").read_text() == "MINE" and not (tmp_path / "mine.ply").exists()
    saved = read_gaussian_ply(tmp_path / "now.ply")
    assert len(saved) == told["saved"]["gaussians"] > 0  # type: ignore[index]
    assert len((tmp_path / "now.txt").read_text().splitlines()) == 1 + told["saved"]["frames"]  # type: ignore[index]


def test_a_reset_ends_the_run_and_saves_it(room: Path, tmp_path: Path) -> None:
    with ExitStack() as opened:
        live, services = live_serving(KeptOutlet(everybody=0), tmp_path, opened)
        outcome = run_of(room, tmp_path / "run", asking(live, lambda: services.call("reset") and None))
        assert isinstance(outcome.error, KeyboardInterrupt) and 6 <= len(outcome.result.frames) < 24
        assert (tmp_path / "run" / "map.ply").is_file() and not live.stays


def test_a_signal_ends_a_pause() -> None:
    pause, heard = Pause(), list[int]()
    before = signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        pause.switch(True)
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        pause.hold()
        assert heard == [signal.SIGINT] and not pause.is_on and pause.seconds > 0.05
        os.kill(os.getpid(), signal.SIGINT)
        assert len(heard) == 2  # as before the pause
    finally:
        signal.signal(signal.SIGINT, before)
