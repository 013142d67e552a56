# SPDX-License-Identifier: Apache-2.0
"""Shows a map in a browser while it grows, at a small, bounded cost to the run."""

from __future__ import annotations

import threading
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ggslam.errors import ConfigError
from ggslam.jobs.view.pictures import FramePictureTuning, table_of
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import GaussianTensors, focal_of
from ggslam.reporting.pictures import color_of_depth, color_to_uint8, depth_range
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import SH_C0
from ggslam.scene.poses import inverse
from ggslam.slam.map_copy import shown_gaussians
from ggslam.slam.result import StepReport
from ggslam.slam.slam import Slam
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import CameraTuning, top_view, vertical_fov, view_from_behind
from ggslam.viewer.packed_splats import SCALES, pack_splats
from ggslam.viewer.page_server import PageServer
from ggslam.viewer.page_source import Download
from ggslam.viewer.scene_values import jpeg, packed_chunk
from ggslam.viewer.splats import colors_to_uint8, most_visible


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
    sending_factor = 1.2
    """Processor time of a picture with sending it, over the time without."""
    compression = 1
    """Effort of compression, 1 to 9: a picture of a growing map is read once, by a page nearby."""


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
    """Follows a run (its `follow` is a `Follower` of `ggslam.jobs.run.pipeline.execute`); a `PageSource`.

    Nothing is copied while no page is open. Otherwise the thread of the run copies the map now and then; another thread
    packs the copy, and rests until it has used no more than `LiveViewTuning.processor_share` of a processor.

    Args:
        server: of the page.
        title: of the page.
        max_splats: show no more.
    """

    def __init__(self, server: PageServer, title: str, max_splats: int = LiveViewTuning.max_splats) -> None:
        self._server, self._title, self._max_splats = server, title, max_splats
        self._rasterizer: CpuRasterizer | None = None
        self._camera: Camera | None = None
        self._ready = threading.Event()
        self._ready.set()
        self._given = threading.Condition()
        self._snapshot: _Snapshot | None = None
        self._ended = False
        self._scene: dict[str, Any] = {"title": title, "about": "waiting for the first frame", "waiting": True}
        self._packed, self._picture = b"", b""
        self.updates = 0
        """How many times the map was shown."""
        server.show(self)
        self._thread = threading.Thread(target=self._work, name="viewer-live", daemon=True)
        self._thread.start()

    def follow(self, slam: Slam, frame: Frame, report: StepReport) -> None:
        """After a frame, in the thread that tracks."""
        if not self._ready.is_set() or not self._server.watchers or not slam.mapper.keyframes:
            return
        self._ready.clear()
        snapshot = _snapshot(slam, frame, report)
        with self._given:
            self._camera, self._snapshot = slam.camera, snapshot
            self._given.notify()

    def close(self) -> None:
        """Stops following; the page keeps what it shows."""
        with self._given:
            self._ended = True
            self._given.notify()
        self._thread.join(timeout=10.0)

    # --- as the page asks ---------------------------------------------------------------------------------------------

    def scene(self) -> dict[str, Any]:
        """See `PageSource`."""
        return {**self._scene, "version": self.updates, "served": True, "live": True, "editable": False}

    def splats(self, chunk: str, level: int) -> bytes:
        """See `PageSource`."""
        if not self._packed:
            raise ConfigError("there is no map yet")
        return self._packed

    def frame_picture(self, frame: int) -> bytes:
        """See `PageSource`; the newest frame, whichever is asked for."""
        if not self._picture:
            raise ConfigError("there is no frame yet")
        return self._picture

    def answer(self, action: str, values: Any) -> dict[str, Any] | Download:
        """See `PageSource`."""
        raise ConfigError("the map still grows; it can be edited when the run is done")

    # --- the viewer's own thread --------------------------------------------------------------------------------------

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
        rows = most_visible(snapshot.gaussians, self._max_splats)
        g, owners = snapshot.gaussians, np.zeros(len(rows), np.uint16)
        colors = colors_to_uint8(0.5 + SH_C0 * g.sh.numpy()[rows, 0])
        packed, low, high = pack_splats(g, rows, colors, owners, None, level=LiveViewTuning.compression)
        header = {"count": len(rows), "low": low, "high": high, "scales": SCALES, "identity": False}
        scene = _scene_of(snapshot, camera, self._title, g.means.numpy()[rows])
        scene["chunks"] = [{"id": "map", "count": len(rows), "levels": [len(rows)], "low": low, "high": high}]
        picture = jpeg(self._compare(snapshot, camera))
        first, number = not self.updates, self.updates + 1
        self._packed = packed_chunk({**header, "version": number}, packed)
        self._scene, self._picture = scene, picture
        self.updates = number  # last: a page that asks meanwhile asks again when it is told
        T = None if snapshot.T_world_camera is None else snapshot.T_world_camera.ravel().tolist()
        what = ("scene", "splats", "camera") if first else ("path", "splats", "camera")
        self._server.tell(*what, version=self.updates, text=snapshot.text, T_world_camera=T)

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


def _scene_of(snapshot: _Snapshot, camera: Camera, title: str, centers: np.ndarray) -> dict[str, Any]:
    """What a page is told of a growing map, see `scene_values`."""
    up, positions, fov = -snapshot.poses[0, :3, 1], snapshot.poses[:, :3, 3], vertical_fov(camera)
    start = view_from_behind(snapshot.poses[0], CameraTuning.look_ahead_m)
    top = top_view(centers, positions, snapshot.poses[0, :3, 2], up, fov)
    return {
        "title": title, "caption": "", "about": snapshot.text, "up": up, "fov": fov,
        "floor": {"height": None, "found": False},
        "camera": {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
                   "cx": camera.cx, "cy": camera.cy},
        "trained_focals": [focal_of(camera)],
        "objects": [], "unlabelled": 0, "views": {"Start": asdict(start), "Top": asdict(top)},
        "path": [positions.round(4)], "keyframes": [T.round(5).ravel() for T in snapshot.keyframes],
        "frames": [], "movers": [], "changes": [], "annotations": [], "camera_keys": [], "edits": [], "redo": 0,
    }  # fmt: skip


def _snapshot(slam: Slam, frame: Frame, report: StepReport) -> _Snapshot:
    """Copies what is shown."""
    copies = shown_gaussians(slam)
    located = [f for f in slam.frames if f.status != "lost"]
    located = located[:: max(1, len(located) // LiveViewTuning.max_path_points)]
    poses = np.stack([slam.pose_of(f) for f in located])
    keyframes = np.stack([keyframe.T_world_camera for keyframe in slam.mapper.keyframes])
    pose = None if report.frame.status == "lost" else slam.pose_of(report.frame)
    psnr = f"{report.psnr:.1f} dB" if np.isfinite(report.psnr) else "-"
    text = (
        f"frame {report.frame.frame_index} · {quantity(len(keyframes), 'keyframe')} · {report.gaussians:,} Gaussians"
        f" · PSNR {psnr} · overlap {report.frame.overlap:.0%} · {report.frame.status}"
    )
    return _Snapshot(copies, poses, keyframes, frame, pose, text)
