# SPDX-License-Identifier: Apache-2.0
"""Shows a map in a browser while it grows, at a small, bounded cost to the run."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ggslam.jobs.view.pictures import FramePictureTuning, table_of
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import GaussianTensors
from ggslam.reporting.pictures import color_of_depth, color_to_uint8, depth_range
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.slam.result import StepReport
from ggslam.slam.slam import Slam
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import vertical_fov, view_from_behind
from ggslam.viewer.safe_text import plain
from ggslam.viewer.scene_nodes import SceneNodes
from ggslam.viewer.server import keep_fitting
from ggslam.viewer.splats import most_visible, splats_of

if TYPE_CHECKING:
    import viser


class LiveViewTuning(Tuning):
    """What a growing map's page costs and shows."""

    processor_share = 0.03
    """Share of one processor that showing the map may take; the viewer rests accordingly."""
    min_rest_s = 1.0
    """Shortest rest between two pictures, in seconds."""
    max_splats = 150_000
    """Most Gaussians that are shown: the most visible ones."""
    max_path_points = 2000
    """Most points of the camera's path."""
    sending_factor = 2.0
    """Processor time of a picture with sending it, over the time without."""
    keyframe_size_m = 0.05
    """Size of a keyframe's mark, in metres."""


@dataclass
class _Snapshot:
    """A snapshot for the page, copied so that the run can continue."""

    gaussians: GaussianTensors
    poses: np.ndarray
    keyframes: np.ndarray
    frame: Frame
    T_world_camera: np.ndarray | None
    text: str


class LiveView:
    """Follows a run (its `follow` is a `Follower` of `ggslam.jobs.run.pipeline.execute`).

    Nothing is copied while no browser is connected. Otherwise the thread of the run copies the map now and then;
    another thread makes pictures of the copy, and rests until it has used no more than
    `LiveViewTuning.processor_share` of a processor.

    Args:
        server: with an empty page.
        title: above the controls.
        max_splats: show no more.
    """

    def __init__(self, server: viser.ViserServer, title: str, max_splats: int = LiveViewTuning.max_splats) -> None:
        self._server, self._title, self._max_splats = server, title, max_splats
        self._nodes = SceneNodes(server)
        self._text = server.gui.add_markdown(f"**{plain(title)}**  \nwaiting for the first frame")
        self._image = server.gui.add_image(np.full((8, 16, 3), 36, np.uint8), format="jpeg", jpeg_quality=80)
        self._rasterizer: CpuRasterizer | None = None
        self._camera: Camera | None = None
        self._ready = threading.Event()
        self._ready.set()
        self._given = threading.Condition()
        self._snapshot: _Snapshot | None = None
        self._ended = False
        self.updates = 0
        """How many times the map was sent."""
        self._thread = threading.Thread(target=self._work, name="viewer-live", daemon=True)
        self._thread.start()

    def follow(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        """After a frame, in the thread that tracks."""
        if not self._ready.is_set() or not self._server.get_clients() or not slam.mapper.keyframes:
            return
        self._ready.clear()
        snapshot = _snapshot(slam, frame, report, self._title)
        with self._given:
            self._camera, self._snapshot = slam.camera, snapshot
            self._given.notify()

    def close(self) -> None:
        """Stops following; the page keeps what it shows."""
        with self._given:
            self._ended = True
            self._given.notify()
        self._thread.join(timeout=10.0)

    # --- the viewer's own thread ------------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._given:
                self._given.wait_for(lambda: self._snapshot is not None or self._ended)
                snapshot, self._snapshot = self._snapshot, None
                if self._ended or snapshot is None:
                    return
            began = time.thread_time()
            self._show(snapshot)
            rest = max(
                LiveViewTuning.min_rest_s,
                LiveViewTuning.sending_factor * (time.thread_time() - began) / LiveViewTuning.processor_share,
            )
            with self._given:
                self._given.wait_for(lambda: self._ended, timeout=rest)
            self._ready.set()

    def _show(self, snapshot: _Snapshot) -> None:
        camera = self._camera
        assert camera is not None
        if not self.updates:
            start = view_from_behind(snapshot.poses[0], 2.0)
            self._server.scene.set_up_direction("-y")
            for client in self._server.get_clients().values():
                client.camera.position, client.camera.look_at = start.position, start.look_at
            first = self._server.initial_camera
            first.position, first.look_at, first.fov = start.position, start.look_at, vertical_fov(camera)
            keep_fitting(self._server, camera)
        rows = most_visible(snapshot.gaussians, self._max_splats)
        picture = self._compare(snapshot, camera)
        with self._server.atomic():
            self._nodes.set_splats({0: splats_of(snapshot.gaussians, rows)})
            self._nodes.set_path([snapshot.poses[:, :3, 3]])
            self._nodes.set_keyframes(snapshot.keyframes, camera, LiveViewTuning.keyframe_size_m)
            if snapshot.T_world_camera is not None:
                self._nodes.set_frame(
                    snapshot.T_world_camera, camera, 2 * LiveViewTuning.keyframe_size_m, snapshot.frame.color
                )
            self._text.content, self._image.image = snapshot.text, picture
        self.updates += 1

    def _compare(self, snapshot: _Snapshot, camera: Camera) -> np.ndarray:
        """The newest frame beside what the map shows there."""
        frame, size = (
            snapshot.frame,
            (FramePictureTuning.width, round(camera.height * FramePictureTuning.width / camera.width)),
        )
        near, far = depth_range(frame.depth)
        cells = [("recorded", frame.color)]
        if snapshot.T_world_camera is not None:
            if self._rasterizer is None:  # kernels of one context take turns; the run must not wait for these
                self._rasterizer = CpuRasterizer(context=NativeContext(1))
            view = self._rasterizer.forward(
                snapshot.gaussians, camera.resize(*size), inverse(snapshot.T_world_camera), features=False
            )
            depth = np.where(view.alpha.numpy() > 0.5, view.expected_depth.numpy(), 0)
            cells += [("rendered", color_to_uint8(view.image.numpy()))]
            cells += [("depth, recorded", color_of_depth(frame.depth, near, far))]
            cells += [("depth, rendered", color_of_depth(depth, near, far))]
        return table_of(cells, size)


def _snapshot(slam: Slam, frame: Frame, report: StepReport, title: str) -> _Snapshot:
    """Copies what is shown. In real time another thread trains the map meanwhile: rows of one copy may then be of
    different steps, which is gone with the next."""
    g = slam.map
    views = [g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh, g.features[:, :0]]
    count = min(len(view) for view in views)
    with slam.mapper.in_turn():
        copies = GaussianTensors(*(view[:count].to("cpu", copy=True) for view in views))
    located = [f for f in slam.frames if f.status != "lost"]
    located = located[:: max(1, len(located) // LiveViewTuning.max_path_points)]
    poses = np.stack([slam.pose_of(f) for f in located])
    keyframes = np.stack([keyframe.T_world_camera for keyframe in slam.mapper.keyframes])
    pose = None if report.frame.status == "lost" else slam.pose_of(report.frame)
    psnr = f"{report.psnr:.1f} dB" if np.isfinite(report.psnr) else "-"
    text = (
        f"**{plain(title)}**  \nframe {report.frame.frame_index} · {quantity(len(keyframes), 'keyframe')}"
        f" · {report.gaussians:,} Gaussians · PSNR {psnr} · overlap {report.frame.overlap:.0%} · {report.frame.status}"
    )
    return _Snapshot(copies, poses, keyframes, frame, pose, text)
