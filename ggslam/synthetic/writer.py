# SPDX-License-Identifier: Apache-2.0
"""Writes a generated recording in the plain folder layout."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

from ggslam import __version__
from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import matrix_to_quaternion
from ggslam.synthetic.raycast import RayCaster
from ggslam.synthetic.scene import Scene
from ggslam.synthetic.scenes import SCENES, SceneKind
from ggslam.synthetic.sensor import disparity_distortion, noisy_color, noisy_depth
from ggslam.synthetic.trajectory import camera_path

DEPTH_SCALE = 5000.0
LARGEST_DISTORTION = 10.0
FOCAL_LENGTH = 0.75
"""As a share of the image width: 67 degrees of view."""


def write_synthetic_sequence(
    folder: str | Path,
    *,
    frames: int | None = None,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    noise: bool = True,
    trajectory: str | None = None,
    frame_rate: float | None = None,
    scene: Scene | str = "room",
    depth_distortion: float | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Ray-casts a recording of a room, a house or a corridor: rgb/, depth/, masks/, camera.yaml and poses.txt.

    The same arguments give the same recording. The folder appears only when it is complete.

    Args:
        folder: to be made; must not exist or be empty, unless `overwrite`.
        frames: how many; None: 60 of the room, 480 of the house, 720 of the corridor, whose length follows.
        width, height: size of the images.
        seed: of textures, the unrest of the hand, and noise.
        noise: depth and colour noise of a sensor; otherwise depth is exact to 0.1 mm.
        trajectory: see `camera_path`; None: "route" through the house, "walk" along the corridor, "loop" elsewhere.
        frame_rate: frames per second, for the timestamps; None: 30 in the room, else 10.
        scene: "room": a furnished room; "loop": a house with a ring of rooms and corridors; "corridor": a long
            corridor; or a scene of one's own, for which None means as for the room.
        depth_distortion: what the depth camera always measures wrongly, in steps of disparity, see
            `disparity_distortion`; nothing without noise. None: 0.3 in the house, else 0.
        overwrite: replaces a recording of this generator that is already there.
        progress: called with (frames done, frames).

    Returns:
        The folder.

    Raises:
        SequenceError: impossible arguments, or the folder cannot be written.
    """
    target = Path(folder)
    kind = _kind_of(scene)
    frames = kind.frames if frames is None else frames
    frame_rate = kind.frame_rate if frame_rate is None else frame_rate
    trajectory = kind.trajectory if trajectory is None else trajectory
    distortion = kind.depth_distortion if depth_distortion is None else depth_distortion
    _check_numbers(width, height, frame_rate, distortion)
    _check_target(target, overwrite)
    scene = scene if isinstance(scene, Scene) else kind.build(seed, frames)
    poses = camera_path(scene, frames, trajectory, seed)
    focal = FOCAL_LENGTH * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    work = _folder_beside(target)
    try:
        _write_images(work, scene, camera, poses, seed, noise, distortion, progress)
        _write_description(work, scene, camera, poses, seed, noise, trajectory, frame_rate, distortion)
        work.chmod(0o755)  # mkdtemp makes it private
        _put_in_place(work, target)
    except OSError as error:
        raise SequenceError(f"{target}: cannot be written: {error}") from None
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return target


def _check_numbers(width: int, height: int, frame_rate: float, distortion: float) -> None:
    if not 0 <= distortion <= LARGEST_DISTORTION:
        raise SequenceError(f"depth_distortion: expected 0 to {LARGEST_DISTORTION:g} steps, found {distortion}")
    if width < 16 or height < 16 or not frame_rate > 0:
        raise SequenceError(
            f"expected at least 16x16 pixels and a positive frame rate, found {width}x{height} and {frame_rate}"
        )


def _folder_beside(target: Path) -> Path:
    """A new hidden folder on the same file system."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise SequenceError(f"{target}: cannot be written: {error.strerror}") from None


def _kind_of(scene: Scene | str) -> SceneKind:
    name = "room" if isinstance(scene, Scene) else scene
    if name not in SCENES:
        raise SequenceError(f"scene: expected one of {', '.join(SCENES)}, found '{name}'")
    return SCENES[name]


def _put_in_place(work: Path, target: Path) -> None:
    """Renames a finished folder to its final name; what stood there goes only after that succeeded."""
    if not target.exists():
        work.rename(target)
        return
    former = Path(tempfile.mkdtemp(prefix=f".{target.name}-former-", dir=target.parent))
    target.rename(former)  # replaces the empty folder
    try:
        work.rename(target)
    except OSError:
        former.rename(target)
        raise
    shutil.rmtree(former, ignore_errors=True)


def _check_target(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise SequenceError(f"{target}: expected a folder to make, found a file")
    if not any(target.iterdir()):
        return
    description = target / "camera.yaml"
    generated = description.is_file() and "generator:" in description.read_text(encoding="utf-8", errors="replace")
    if not (overwrite and generated):
        what = "holds a generated recording already" if generated else "is not empty"
        raise SequenceError(f"{target}: {what}; choose another folder")


def _write_images(
    folder: Path, scene: Scene, camera: Camera, poses: np.ndarray, seed: int, noise: bool,
    distortion: float, progress: Callable[[int, int], None] | None,
) -> None:  # fmt: skip
    for name in ("rgb", "depth", "masks"):
        (folder / name).mkdir()
    caster = RayCaster(scene, seed)
    offset = disparity_distortion(camera, distortion, seed) if distortion else 0.0
    for i, pose in enumerate(poses):
        images = caster.render(camera, pose)
        color, depth = images.color, images.depth
        if noise:
            rng = np.random.default_rng([seed, 4, i])
            color, depth = noisy_color(color, rng), noisy_depth(depth, camera, rng, offset)
        raw = np.rint(np.minimum(depth * DEPTH_SCALE, 65535)).astype(np.uint16)
        _write_png(folder / "rgb" / f"{i:06d}.png", cv2.cvtColor(color, cv2.COLOR_RGB2BGR))
        _write_png(folder / "depth" / f"{i:06d}.png", raw)
        _write_png(folder / "masks" / f"{i:06d}.png", images.mask)
        if progress is not None:
            progress(i + 1, len(poses))


def _write_png(path: Path, image: np.ndarray) -> None:
    done, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise SequenceError(f"{path}: image cannot be encoded")
    path.write_bytes(content.tobytes())


def _write_description(
    folder: Path, scene: Scene, camera: Camera, poses: np.ndarray, seed: int, noise: bool, trajectory: str, rate: float,
    distortion: float,
) -> None:  # fmt: skip
    description = {
        "generator": f"ggslam synth {__version__}",
        "seed": seed,
        "noise": noise,
        "trajectory": trajectory,
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "depth_scale": DEPTH_SCALE,
        "frame_rate": rate,
        **({"depth_distortion": distortion} if distortion and noise else {}),
        "instances": dict(scene.instance_names),
    }
    (folder / "camera.yaml").write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")
    lines = ["# timestamp tx ty tz qx qy qz qw (camera to world)"]
    for i, T in enumerate(poses):
        w, x, y, z = matrix_to_quaternion(T[:3, :3])
        numbers = (*T[:3, 3], x, y, z, w)
        lines.append(f"{i / rate:.6f} " + " ".join(f"{value:.9f}" for value in numbers))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
