# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run's map from the poses of its frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError
from ggslam.objects.rendered_ids import object_ids
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import RenderBuffers
from ggslam.reporting.pictures import (
    color_of_depth,
    color_of_ids,
    color_to_uint8,
    depth_range,
    identity_picture,
    legend,
    write_picture,
)
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MapInParts
from ggslam.runs.objects_in_parts import ObjectsInParts
from ggslam.runs.publishing import change_in_run
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.system.atomic import make_folder

KINDS = ("color", "depth", "alpha", "ids", "pca")
OBJECT_KINDS = ("ids", "pca")
"""Pictures of a run with objects only: each object in its colour; identity vectors by principal components."""
Painter = Callable[[RenderBuffers, GaussianMap], np.ndarray]


def select_frames(folder: RunFolder, numbers: str | None, every: int | None, count: int = 8) -> list[int]:
    """Frame numbers from a list like "0,50,100", or every n-th, or `count` spread evenly.

    Raises:
        ConfigError: not a number, or no such frame in the run.
    """
    known = sorted(folder.keyframes().poses())
    if not known:
        raise ConfigError(f"{folder.path}: no frame of this run was located, so there is nowhere to look from")
    if numbers is not None:
        try:
            wanted = [int(number) for number in numbers.split(",")]
        except ValueError:
            raise ConfigError(f"`frames`: expected numbers like 0,50,100, found {numbers!r}") from None
        missing = [number for number in wanted if number not in known]
        if missing:
            raise ConfigError(f"`frames`: the run has frames {known[0]} to {known[-1]}, not {missing[0]}")
        return wanted
    if every is not None:
        return known[::every]
    return [known[i] for i in np.unique(np.linspace(0, len(known) - 1, count).round().astype(int))]


def render_frames(
    folder: RunFolder, frames: list[int], what: list[str], out: Path, width: int | None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Path]:  # fmt: skip
    """Renders frames to `out`/frame000123_color.png and so on, with ids a legend.png, too; returns the files.

    Raises:
        ConfigError: `what` names something that is not in `KINDS`.
        RunFolderError: objects are asked of a run that has none.
    """
    unknown = [kind for kind in what if kind not in KINDS]
    if unknown:
        raise ConfigError(f"`what`: expected some of {','.join(KINDS)}, found {unknown[0]!r}")
    objects = ObjectsInParts.of(folder) if set(what) & set(OBJECT_KINDS) else None
    parts = folder.map_in_parts() if objects is None else objects.map
    make_folder(out)
    with change_in_run(out):
        return _render(folder, frames, what, out, width, parts, objects, progress)


def _render(
    folder: RunFolder, frames: list[int], what: list[str], out: Path, width: int | None, parts: MapInParts,
    objects: ObjectsInParts | None, progress: Callable[[int], None],
) -> list[Path]:  # fmt: skip
    rasterizer = CpuRasterizer()
    painters = _painters() if objects is None else {**_painters(), **_object_painters(objects, rasterizer, what)}
    poses, recording = folder.keyframes().poses(), folder.sequence()
    written = []
    for done, frame in enumerate(frames):
        T_camera_world, camera = inverse(poses[frame]), recording.camera_of(frame)
        if width is not None:
            camera = camera.resize(width, round(camera.height * width / camera.width))
        gaussians = parts.in_view(camera, T_camera_world)
        view = rasterizer.forward(gaussians, camera, T_camera_world, features=objects is not None)
        for kind in what:
            written.append(out / f"frame{frame:06d}_{kind}.png")
            write_picture(written[-1], painters[kind](view, gaussians))
        progress(done + 1)
    if objects is not None and "ids" in what:
        written.append(out / "legend.png")
        write_picture(written[-1], legend([(f"{o.id} {o.name or ''}", o.color) for o in objects.table.objects]))
    return written


def _painters() -> dict[str, Painter]:
    return {
        "color": lambda view, _: color_to_uint8(view.image.numpy()),
        "depth": lambda view, _: _depth_picture(view.expected_depth.numpy(), view.alpha.numpy()),
        "alpha": lambda view, _: (255 * np.clip(view.alpha.numpy(), 0, 1) + 0.5).astype(np.uint8),
    }


def _object_painters(objects: ObjectsInParts, rasterizer: CpuRasterizer, what: list[str]) -> dict[str, Painter]:
    """Those of `OBJECT_KINDS` that are among `what`."""
    palette = objects.table.palette()

    def ids(view: RenderBuffers, gaussians: GaussianMap) -> np.ndarray:
        return color_of_ids(object_ids(rasterizer, view, objects.around(gaussians)), palette, outlines=True)

    if "pca" not in what:
        return {"ids": ids}
    colors = objects.identity_colors()
    return {"ids": ids, "pca": lambda view, _: identity_picture(view, colors)}


def _depth_picture(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    depth = np.where(alpha > 0.5, depth, 0)
    return color_of_depth(depth, *depth_range(depth))
