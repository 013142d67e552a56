# SPDX-License-Identifier: Apache-2.0
"""Pictures of a map from any pose."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ggslam.errors import ConfigError
from ggslam.jobs.render.artist import Artist
from ggslam.jobs.render.orbit_path import map_sample, plain_camera
from ggslam.jobs.render.outputs import write_beside
from ggslam.jobs.render.shots import Size, fill_size, look_at_pose
from ggslam.reporting.pictures import write_picture
from ggslam.runs.folder import RunFolder
from ggslam.runs.publishing import change_in_run
from ggslam.scene.camera import Camera
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.atomic import make_folder
from ggslam.volumes.map_upright import upright_of

FORMS = '"x y z qx qy qz qw" (TUM, camera to world) or "from x y z at x y z [up x y z]"'


def parse_pose(text: str, up: np.ndarray | None = None) -> np.ndarray:
    """T_world_camera [4, 4] of a pose in one of the `FORMS`.

    Args:
        text: the pose; commas count as spaces.
        up: [3] for poses that do not tell it; None: (0, -1, 0), up in the first camera's image.

    Raises:
        ConfigError: it is something else.
    """
    words = text.replace(",", " ").split()
    keys = [word.lower() for word in words[::4]]
    if keys[:2] == ["from", "at"] and len(words) in (8, 12) and keys[2:] in ([], ["up"]):
        points = [_numbers(words[i + 1 : i + 4], text) for i in range(0, len(words), 4)]
        above = points[2] if len(points) == 3 else np.array([0.0, -1.0, 0.0]) if up is None else up
        return look_at_pose(points[0], points[1], above)
    if len(words) != 7:
        raise ConfigError(f"`pose`: expected {FORMS}, found {text!r}")
    numbers = _numbers(words, text)
    if not 0.99 < np.linalg.norm(numbers[3:]) < 1.01:
        raise ConfigError(f"`pose`: the quaternion qx qy qz qw of {text!r} has not length 1")
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(numbers[[6, 3, 4, 5]])
    T[:3, 3] = numbers[:3]
    return T


def _numbers(words: list[str], text: str) -> np.ndarray:
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        raise ConfigError(f"`pose`: expected {FORMS}, found {text!r}")
    if np.abs(numbers).max() > 1e6:
        raise ConfigError(f"`pose`: expected places within 1e6 m of the origin, found {text!r}")
    return numbers


def parse_poses(folder: RunFolder, texts: Sequence[str]) -> list[np.ndarray]:
    """T_world_camera [4, 4] of poses in the `FORMS`; the map tells up where they do not.

    Raises:
        ConfigError: see `parse_pose`.
    """
    up: np.ndarray | None = None
    words = " ".join(texts).lower()
    if "from" in words and folder.has_poses:
        poses = folder.keyframes().poses()
        up = upright_of(map_sample(folder), np.stack([poses[frame] for frame in sorted(poses)])).up
    return [parse_pose(text, up) for text in texts]


def render_poses(
    folder: RunFolder, poses: Sequence[np.ndarray], what: Sequence[str], out: Path, size: Size | None = None
) -> list[Path]:
    """Renders views from T_world_camera [4, 4] to `out`/view000_color.png and so on; returns the files.

    Args:
        folder: of the run, or a file of Gaussians.
        poses: where the camera is.
        what: see `render_run`.
        out: a folder; or, for one picture, a .png.
        size: of the pictures; None: as the run saw them.

    Raises:
        ConfigError: unknown kinds of pictures, or several for one .png.
        RunFolderError: objects are asked of a run that has none.
    """
    artist, camera = Artist(folder, what), usual_camera(folder, size)
    single = out.suffix.lower() == ".png"
    if single and len(poses) * len(artist.kinds) != 1:
        raise ConfigError(f"`out`: {len(poses) * len(artist.kinds)} pictures need a folder, found {out.name!r}")
    if out.suffix.lower() in (".jpg", ".jpeg", ".webp", ".gif", ".bmp", ".tif", ".tiff") and not out.is_dir():
        raise ConfigError(f"`out`: expected a folder or a name that ends with .png, found {out.name!r}")
    written = []
    with write_beside(out) if single else change_in_run(out):
        if not single:
            make_folder(out)
        for number, pose in enumerate(poses):
            for kind, picture in artist.pictures(camera, pose).items():
                written.append(out if single else out / f"view{number:03d}_{kind}.png")
                write_picture(written[-1], picture)
    return written


def usual_camera(folder: RunFolder, size: Size | None) -> Camera:
    """The camera of a run's recording at a size; of a file of Gaussians a plain one."""
    if folder.has_poses:
        return fill_size(folder.sequence().camera, size)
    return plain_camera(size or (1280, 720))
