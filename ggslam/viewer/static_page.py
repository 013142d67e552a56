# SPDX-License-Identifier: Apache-2.0
"""One HTML file that shows a map without server and network: splats in 19 to 26 bytes each, compressed, with a small
WebGL program of our own."""

from __future__ import annotations

import base64
import html
import json
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggslam.rendering.types import Gaussians
from ggslam.scene.gaussian_map import SH_C0
from ggslam.system.tuning import Tuning
from ggslam.viewer.cameras import CameraTuning, Viewpoint, top_view, vertical_fov, view_of_pose
from ggslam.viewer.model import ListedObject, ViewedMap
from ggslam.viewer.splats import DrawnSplatTuning, colors_to_uint8, opacities_of

STATIC = Path(__file__).with_name("static")
MAP_SCRIPTS = (
    "splat_rules.js", "unpack.js", "displacement.js", "seen_shapes.js", "sorter.js", "webgl_programs.js",
    "splat_textures.js", "webgl_renderer.js", "splat_projector.js", "tile_painter.js", "painting_worker.js",
    "painter_pool.js", "processor_renderer.js", "map_lines.js", "picker.js", "resolution.js", "map_view.js",
    "chunk_levels.js",
)  # fmt: skip
"""What `MapView` consists of, in the order in which a page needs it."""
_PARTS = (*MAP_SCRIPTS, "camera.js", "page.js")


class StaticPageTuning(Tuning):
    """What a page of one file holds."""

    min_size_m = 1e-4
    """Smallest standard deviation that is stored, in metres."""
    pictures = 24
    """Most frames with pictures."""
    max_path_points = 2000
    """Most points of each path."""


SCALES = (float(np.log(StaticPageTuning.min_size_m)), float(np.log(DrawnSplatTuning.max_size_m)))
"""Logarithms of the smallest and largest standard deviation that are written, 255 steps (4 %) apart."""



def pack_splats(
    gaussians: Gaussians, rows: np.ndarray, colors: np.ndarray, owners: np.ndarray, identity: np.ndarray | None,
    seen: np.ndarray | None = None,
) -> tuple[bytes, np.ndarray, np.ndarray]:  # fmt: skip
    """Splats as compressed bytes, column by column.

    Args:
        gaussians: the map.
        rows: int [N], which of them.
        colors: uint8 [N, 3], theirs.
        owners: object ids uint16 [N], theirs.
        identity: colours of their identity vectors uint8 [N, 3], or None.
        seen: from where they were seen, uint8 [N, 4] of `viewed_sides`, or None.

    Returns:
        The bytes, and the lowest and highest corner [3] of the centres, between which these are written in 65,535
        steps an axis.
    """
    means = gaussians.means.numpy()[rows].astype(np.float64)
    low, high = (means.min(axis=0), means.max(axis=0)) if len(means) else (np.zeros(3), np.ones(3))
    steps = np.rint((means - low) / np.maximum(high - low, 1e-9) * 65535).astype(np.uint16)
    scales = (gaussians.log_scales.numpy()[rows] - SCALES[0]) / (SCALES[1] - SCALES[0])
    turns = gaussians.quaternions.numpy()[rows]
    turns = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
    columns = [_halves(steps[:, axis]) for axis in range(3)]
    columns += [
        np.rint(255 * np.clip(scales, 0, 1)).astype(np.uint8).T,
        (np.rint(127 * turns) + 128).astype(np.uint8).T,
    ]
    columns += [colors.T, np.rint(255 * opacities_of(gaussians)[rows]).astype(np.uint8), _halves(owners)]
    columns += [] if identity is None else [identity.T]
    columns += [] if seen is None else [seen.T]
    return zlib.compress(b"".join(np.ascontiguousarray(column).tobytes() for column in columns), 9), low, high


def _halves(values: np.ndarray) -> np.ndarray:
    """Low bytes, then high bytes, uint8 [2, N], of uint16 [N]: columns of one kind compress better."""
    return np.stack([values & 255, values >> 8]).astype(np.uint8)


def static_page(
    model: ViewedMap, title: str, gaussians: Gaussians, rows: np.ndarray, identity: np.ndarray | None,
    owners: np.ndarray, seen: np.ndarray | None = None,
) -> str:  # fmt: skip
    """The page as text.

    Args:
        model: the map.
        title: of the page.
        gaussians, rows, identity, owners, seen: as in `pack_splats`.
    """
    colors = colors_to_uint8(0.5 + SH_C0 * gaussians.sh.numpy()[rows, 0])
    packed, low, high = pack_splats(gaussians, rows, colors, owners, identity, seen)
    objects = model.objects()
    frames = list(model.frame_poses)
    shown = [
        frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, StaticPageTuning.pictures).round().astype(int))
    ]
    poses = np.stack(list(model.frame_poses.values()))
    start = view_of_pose(poses[0], CameraTuning.look_ahead_m)
    fov = vertical_fov(model.camera)
    top = top_view(gaussians.means.numpy()[rows], poses[:, :3, 3], poses[0, :3, 2], model.up, fov)
    scene = {
        "count": len(rows), "low": low, "high": high, "scales": SCALES, "identity": identity is not None,
        "seen": seen is not None,
        "objects": [_object_values(record) for record in objects], "unlabelled": int((owners == 0).sum()),
        "about": model.describe(), "up": model.up, "fov": fov,
        "views": {"Start": _view(start), "Top": _view(top)},
        "path": [walk[:: max(1, len(poses) // StaticPageTuning.max_path_points)].round(4) for walk in model.walks],
        "frames": [
            {"frame": frame, "picture": _jpeg(model.frame_picture(frame)[0]),
             "view": _view(view_of_pose(model.frame_poses[frame], CameraTuning.look_ahead_m))} for frame in shown
        ],
    }  # fmt: skip
    script = "\n".join((STATIC / name).read_text(encoding="utf-8") for name in _PARTS)
    page = (STATIC / "page.html").read_text(encoding="utf-8")
    page = page.replace("@TITLE@", html.escape(title)).replace("@SCRIPT@", script)
    return page.replace("@SCENE@", _json(scene)).replace("@SPLATS@", base64.b64encode(packed).decode("ascii"))


def _object_values(record: ListedObject) -> dict[str, Any]:
    return {"id": record.id, "name": record.name, "color": record.color, "gaussians": record.gaussians}


def _view(view: Viewpoint) -> dict[str, Any]:
    return asdict(view)


def _jpeg(picture: np.ndarray) -> str:
    """A picture uint8 [H, W, 3] as an address that holds it."""
    data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def _json(values: Any) -> str:
    """JSON that cannot end the element of the page that it is in, whatever names it holds."""
    text = json.dumps(values, default=lambda array: np.asarray(array).tolist())
    return text.replace("<", "\\u003c").replace("@", "\\u0040")
