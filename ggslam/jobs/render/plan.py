# SPDX-License-Identifier: Apache-2.0
"""A floor plan of a map: seen from above in parallel projection, at a stated scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.jobs.render.orbit_path import level_axes
from ggslam.jobs.render.outputs import write_beside
from ggslam.rendering.api import render
from ggslam.reporting.pictures import color_to_uint8, write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_file import open_map
from ggslam.scene.camera_models import OrthographicCamera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.atomic import write_text
from ggslam.system.json_files import write_json
from ggslam.system.tuning import Tuning
from ggslam.volumes.map_upright import upright_of


class PlanTuning(Tuning):
    """What a plan shows."""

    metre_per_pixel = 0.01
    """Scale of a plan that is not told otherwise."""
    share_left_out = 0.5
    """Percent of the Gaussians that may lie beyond each side of the picture: needles and strays."""
    margin_m = 0.1
    """Added on each side, in metres."""
    above_cameras_m = 0.3
    """Height above the middle of the cameras at which the map is cut, in metres: what hangs from the ceiling goes."""
    max_side = 16_384
    """Largest side of the picture in pixels."""
    background = (1.0, 1.0, 1.0)
    """Colour of where nothing is."""


@dataclass(frozen=True)
class Plan:
    """Where a plan lies in the world.

    Attributes:
        camera: of the picture.
        T_world_camera: float64 [4, 4]; the camera looks down from the cut.
        up: [3], the world's direction up.
        floor: height along `up`, metres from the world's origin; None: none was found.
        cut: height at which the map is cut, metres above the floor, or along `up` without one.
    """

    camera: OrthographicCamera
    T_world_camera: np.ndarray
    up: np.ndarray
    floor: float | None
    cut: float

    def T_plan_world(self) -> np.ndarray:
        """[4, 4], from the world to the plan: x to the right and y to the top of the picture, z the height above the
        floor, metres; the world's origin lies at (0, 0)."""
        R = self.T_world_camera[:3, :3].T * np.array([[1.0], [-1.0], [-1.0]])
        T = np.eye(4)
        T[:3, :3] = R
        T[2, 3] = -(self.floor or 0.0)
        return T

    def world_file(self) -> str:
        """The six numbers of a world file (.pgw): what a pixel is in x and y, and where the first one's centre is."""
        first = self.T_world_camera[:3, :3].T @ self.T_world_camera[:3, 3]
        scale = 1 / self.camera.scale
        x, y = first[0] - self.camera.cx * scale, -(first[1] - self.camera.cy * scale)
        return "".join(f"{value:.10g}\n" for value in (scale, 0, 0, -scale, x, y))


def render_plan(
    run: str | Path | RunFolder, out: str | Path, *, metre_per_pixel: float | None = None, cut: float | None = None
) -> Plan:
    """Renders a floor plan, as `ggslam render --plan` does: a .png, a world file beside it that GIS programs read
    (.pgw), and a .json with scale, floor and transform.

    Args:
        run: the run, or its folder; or a file of Gaussians, whose y axis is then taken to point down.
        out: the picture, a .png.
        metre_per_pixel: scale; None: 0.01.
        cut: height in metres above the floor, from which on nothing is shown; None: 0.3 m above the middle of the
            cameras, so that the ceiling does not hide the room.

    Raises:
        ConfigError: not a .png, a scale that gives no picture, or nothing is below the cut.
        RunFolderError: no run, or the files cannot be written.
    """
    folder = run if isinstance(run, RunFolder) else open_map(run)
    out, scale = Path(out), PlanTuning.metre_per_pixel if metre_per_pixel is None else metre_per_pixel
    if out.suffix.lower() != ".png":
        raise ConfigError(f"`plan`: expected a name that ends with .png, found {out.name!r}")
    if not 1e-4 <= scale <= 10:
        raise ConfigError(f"`metre_per_pixel`: expected 0.0001 to 10, found {scale:g}")
    gaussians = folder.gaussians()
    plan = find_plan(gaussians, _poses_of(folder), scale, cut)
    with torch.no_grad():
        view = render(gaussians, plan.camera, T_world_camera=plan.T_world_camera, features=False,
                      near_plane=1e-3, background=PlanTuning.background)  # fmt: skip
    with write_beside(out, out.with_suffix(".pgw"), out.with_suffix(".json")):
        write_picture(out, color_to_uint8(view.image.numpy()))
        write_text(out.with_suffix(".pgw"), plan.world_file())
        write_json(out.with_suffix(".json"), {
            "metre_per_pixel": scale, "up": plan.up.tolist(), "floor_m": plan.floor, "cut_m": plan.cut,
            "T_plan_world": plan.T_plan_world().tolist(), "width": plan.camera.width, "height": plan.camera.height,
        })  # fmt: skip
    return plan


def _poses_of(folder: RunFolder) -> np.ndarray:
    """T_world_camera [N, 4, 4] of the frames; of a file of Gaussians one, level, so high that nothing is cut."""
    if folder.has_poses:
        poses = folder.keyframes().poses()
        return np.stack([poses[frame] for frame in sorted(poses)])
    return np.eye(4)[None]


def find_plan(gaussians: GaussianMap, poses: np.ndarray, metre_per_pixel: float, cut: float | None) -> Plan:
    """Where the plan of a map lies.

    Args:
        gaussians: the map.
        poses: T_world_camera [N, 4, 4] of the frames; the first one looks to the top of the picture.
        metre_per_pixel: scale.
        cut: see `render_plan`.

    Raises:
        ConfigError: see `render_plan`.
    """
    found = upright_of(gaussians, poses)
    ahead, left, up = level_axes(found.up, poses[0, :3, 2])
    opaque = (gaussians.opacity_logits > 0).numpy()
    places = gaussians.means.numpy()[opaque].astype(np.float64) @ np.stack([-left, -ahead, up]).T
    base = 0.0 if found.floor is None else found.floor
    cut_at = float(np.median(poses[:, :3, 3] @ up)) + PlanTuning.above_cameras_m if cut is None else base + cut
    places = places[places[:, 2] < cut_at]
    if not len(places):
        raise ConfigError(f"`cut`: nothing of the map is lower than {cut_at - base:g} m above the floor")
    share = PlanTuning.share_left_out
    low, high = np.percentile(places[:, :2], [share, 100 - share], axis=0)
    low, high = low - PlanTuning.margin_m, high + PlanTuning.margin_m
    width, height = (int(np.ceil(side / metre_per_pixel)) for side in high - low)
    if max(width, height) > PlanTuning.max_side:
        raise ConfigError(
            f"`metre_per_pixel`: the plan would have {width}x{height} pixels, at most {PlanTuning.max_side} a side are "
            f"drawn: {max(high - low) / PlanTuning.max_side:.2g} or more"
        )
    T = np.eye(4)
    T[:3, :3] = np.stack([-left, -ahead, -up], 1)  # x to the right, y to the bottom, z down
    T[:3, 3] = T[:3, :3] @ np.array([low[0], low[1], -cut_at])
    camera = OrthographicCamera(width, height, 1 / metre_per_pixel, 0.0, 0.0)
    return Plan(camera, T, up, found.floor, cut_at - base)
