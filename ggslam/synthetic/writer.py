# SPDX-License-Identifier: Apache-2.0
"""Writes a generated recording."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.synthetic.changes import MadeChange, room_at_two_visits
from ggslam.synthetic.exposure import Shutter
from ggslam.synthetic.layouts import PLAIN, Layout, layout_named
from ggslam.synthetic.movers import MovingScene, find_movers, movers_of
from ggslam.synthetic.raycast import RayImages
from ggslam.synthetic.scene import Scene
from ggslam.synthetic.scenes import SCENES, SceneKind
from ggslam.synthetic.sensor import disparity_distortion, noisy_color, noisy_depth
from ggslam.synthetic.trajectory import camera_path
from ggslam.system.atomic import write_failure
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import FileTuning, read_untrusted


class SynthTuning(Tuning):
    """What generated recordings are like."""

    max_distortion = 10.0
    """Largest distortion of depth, in steps of disparity."""
    frames_with_movers = 120
    """Frames of a recording with movers."""


CHANGES_FILE = "changes.json"
MOVERS_FILE = "movers.json"
PLAIN_SHUTTER = Shutter()


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
    speed: int = 1,
    shutter: Shutter = PLAIN_SHUTTER,
    changes: int | None = None,
    visit: int = 1,
    movers: Sequence[str] = (),
    layout: str = PLAIN.name,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Ray-casts a recording of a room, a house or a corridor: images, masks, calibration and poses; with movers also
    movers.json.

    The same arguments give the same recording. The folder appears only when it is complete.

    Args:
        folder: to be made; must not exist or be empty, unless `overwrite`.
        frames: how many; None: 60 of the room, 120 if something moves in it, 480 of the house, 720 of the corridor,
            whose length follows.
        width, height: size of the images.
        seed: of textures, the unrest of the hand, and noise.
        noise: depth and colour noise of a sensor; otherwise depth is exact to 0.1 mm.
        trajectory: see `camera_path`; None: "route" through the house, "walk" along the corridor, "loop" elsewhere.
        frame_rate: frames per second, for the timestamps; None: 30 in the room, else 10.
        scene: "room": a furnished room; "loop": a house with a ring of rooms and corridors; "corridor": a long
            corridor; or a scene of one's own, for which None means as for the room.
        depth_distortion: what the depth camera always measures wrongly, in steps of disparity, see
            `disparity_distortion`; nothing without noise. None: 0.3 in the house, else 0.
        speed: how many times as far as usual the camera moves between two frames.
        shutter: how colour is blurred, rows read and depth delayed.
        changes: things of the room that differ between its two visits (see `room_at_two_visits`); the second one's
            folder has them in changes.json. The camera goes all around ("round") if no trajectory is given.
        visit: which of the two, 1 or 2; the second goes the other way round.
        movers: what moves while the room is recorded, of `MOVERS`: each rests, moves and rests again. Without them the
            same frames and seed give the same recording with nothing that moves.
        layout: of the folder, see `LAYOUTS`: "plain", with 67 degrees of view, or "replica", with 90 degrees.
        overwrite: replaces a recording of this generator that is already there.
        progress: called with (frames done, frames).

    Returns:
        The folder.

    Raises:
        SequenceError: impossible arguments, or the folder cannot be written.
    """
    target, made, files = Path(folder), list[MadeChange](), layout_named(layout)
    if wanted := movers_of(movers):
        if scene != "room" or changes is not None:
            raise SequenceError("movers: only the room has things that move, and not at two visits")
        frames = SynthTuning.frames_with_movers if frames is None else frames
    if changes is not None:
        scene, made = _scene_of_visit(scene, seed, changes, visit)
        trajectory = trajectory or "round"
    plan = plan_recording(
        width, height, frames, seed, noise, trajectory, frame_rate, scene, depth_distortion, speed, shutter, files
    )  # fmt: skip
    poses = plan.poses
    if visit > 1:  # another hand, and the way back
        poses = _poses(plan.scene, len(poses), plan.trajectory, seed + 1, speed)[::-1].copy()
    check_target(target, files.file, overwrite)
    moving = find_movers(plan.scene, plan.camera, poses, seed, wanted)
    plan = replace(plan, scene=moving.scene)
    with new_folder(target) as work:
        write_recording(work, plan, poses, plan.times, number=visit - 1, progress=progress, moving=moving)
        if wanted:
            truth = {"recording": target.resolve().name, **moving.truth()}
            (work / MOVERS_FILE).write_text(json.dumps(truth) + "\n", encoding="utf-8")
        if visit > 1:
            text = json.dumps({"changes": [change.to_dict() for change in made]}, indent=1)
            (work / CHANGES_FILE).write_text(text + "\n", encoding="utf-8")
    return target


def _scene_of_visit(scene: Scene | str, seed: int, changes: int, visit: int) -> tuple[Scene, list[MadeChange]]:
    if scene != "room":
        raise SequenceError("changes: only the room has two visits")
    if visit not in (1, 2):
        raise SequenceError(f"visit: expected 1 or 2, found {visit}")
    first, second, made = room_at_two_visits(seed, changes)
    return (first, second)[visit - 1], made


@dataclass(frozen=True)
class RecordingPlan:
    """A recording about to be made; see `write_synthetic_sequence`.

    Attributes:
        scene, camera, seed, noise, trajectory, frame_rate: of it.
        distortion: of its depth camera, steps of disparity.
        poses: T_world_camera, float64 [n, 4, 4].
        shutter: of its camera.
        layout: of its folder.
    """

    scene: Scene
    camera: Camera
    seed: int
    noise: bool
    trajectory: str
    frame_rate: float
    distortion: float
    poses: np.ndarray
    shutter: Shutter = PLAIN_SHUTTER
    layout: Layout = PLAIN

    @property
    def times(self) -> np.ndarray:
        """Seconds, float64 [n]."""
        return np.arange(len(self.poses)) / self.frame_rate


def plan_recording(
    width: int, height: int, frames: int | None, seed: int, noise: bool, trajectory: str | None,
    frame_rate: float | None, scene: Scene | str, depth_distortion: float | None, speed: int = 1,
    shutter: Shutter = PLAIN_SHUTTER, layout: Layout = PLAIN,
) -> RecordingPlan:  # fmt: skip
    """What is to be recorded, of arguments as of `write_synthetic_sequence`.

    Raises:
        SequenceError: they are impossible.
    """
    kind = _kind_of(scene)
    frames = kind.frames if frames is None else frames
    frame_rate = kind.frame_rate if frame_rate is None else frame_rate
    trajectory = kind.trajectory if trajectory is None else trajectory
    distortion = kind.depth_distortion if depth_distortion is None else depth_distortion
    _check_numbers(width, height, frame_rate, distortion)
    if speed < 1:
        raise SequenceError(f"speed: expected 1 or more, found {speed}")
    scene = scene if isinstance(scene, Scene) else kind.build(seed, frames * speed)
    focal = layout.focal * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    poses = _poses(scene, frames, trajectory, seed, speed)
    return RecordingPlan(scene, camera, seed, noise, trajectory, frame_rate, distortion, poses, shutter, layout)


def _poses(scene: Scene, frames: int, trajectory: str, seed: int, speed: int) -> np.ndarray:
    """Every `speed`-th pose of a path, float64 [frames, 4, 4]."""
    return np.ascontiguousarray(camera_path(scene, frames * speed, trajectory, seed)[::speed])


def write_recording(
    folder: Path, plan: RecordingPlan, poses: np.ndarray, times: np.ndarray, number: int = 0,
    progress: Callable[[int, int], None] | None = None, moving: MovingScene | None = None,
) -> None:  # fmt: skip
    """Ray-casts a recording into a folder that is there.

    Args:
        folder: to write to.
        plan: what is recorded.
        poses: T_world_camera, float64 [n, 4, 4], and `times`, seconds, of its frames.
        number: of the camera, if several record the same: the sensor of each has its own noise.
        progress: called with (frames done, frames).
        moving: the scene, if something moves in it.
    """
    _write_images(folder, plan, poses, number, progress, moving or MovingScene(plan.scene, plan.seed))
    _write_description(folder, plan, poses, times)
    if (times != plan.times).any():  # else they follow from the frame rate
        (folder / "timestamps.txt").write_text("".join(f"{time:.6f}\n" for time in times.tolist()), encoding="utf-8")


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """A folder to write to, which becomes `target` when all is well.

    Raises:
        SequenceError: it cannot be written.
    """
    work = _folder_beside(target)
    try:
        yield work
        work.chmod(0o755)  # mkdtemp makes it private
        _put_in_place(work, target)
    except OSError as error:
        raise _failure(target, error) from None
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _check_numbers(width: int, height: int, frame_rate: float, distortion: float) -> None:
    if not 0 <= distortion <= SynthTuning.max_distortion:
        raise SequenceError(f"depth_distortion: expected 0 to {SynthTuning.max_distortion:g} steps, found {distortion}")
    if width < 16 or height < 16 or not frame_rate > 0:
        raise SequenceError(
            f"expected at least 16x16 pixels and a positive frame rate, found {width}x{height} and {frame_rate}"
        )


def _failure(target: Path, error: OSError) -> SequenceError:
    """The error to raise when the operating system would not write; a full disk is not the user's fault."""
    failure = SequenceError(f"{target}: cannot be written: {error.strerror or error}")
    failure.exit_code = write_failure(target, error).exit_code
    return failure


def _folder_beside(target: Path) -> Path:
    """A new hidden folder on the same file system."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise _failure(target, error) from None


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


def check_target(target: Path, file: str, overwrite: bool) -> None:
    """Raises SequenceError unless a recording can be made at `target`: nothing is there, or with `overwrite` one of
    this generator, which `file` in it says."""
    if not target.exists():
        return
    if not target.is_dir():
        raise SequenceError(f"{target}: expected a folder to make, found a file")
    if not any(target.iterdir()):
        return
    description = target / file
    generated = description.is_file() and b"ggslam synth " in read_untrusted(
        description, FileTuning.max_text_bytes, SequenceError
    )
    if not (overwrite and generated):
        what = "holds a generated recording already" if generated else "is not empty"
        raise SequenceError(f"{target}: {what}; choose another folder")


def _write_images(
    folder: Path, plan: RecordingPlan, poses: np.ndarray, number: int, progress: Callable[[int, int], None] | None,
    moving: MovingScene,
) -> None:  # fmt: skip
    plan.layout.make_folders(folder)
    offset = disparity_distortion(plan.camera, plan.distortion, plan.seed + number) if plan.distortion else 0.0
    for i, pose in enumerate(poses):
        images = moving.render(i, plan.camera, pose)
        color, depth, mask = images.color, images.depth, images.mask
        if not plan.shutter.is_plain:
            of_color, of_depth, of_mask = moving.at_another_pose()
            color = plan.shutter.color(of_color, plan.camera, poses, i)
            depth = plan.shutter.depth(of_depth, plan.camera, poses, i)
            mask = plan.shutter.mask(of_mask, plan.camera, poses, i)
        if plan.noise:
            rng = np.random.default_rng([plan.seed, 4, i, *([number] if number else [])])
            color, depth = noisy_color(color, rng), noisy_depth(depth, plan.camera, rng, offset)
        plan.layout.write_images(folder, i, RayImages(color, depth, mask))
        if progress is not None:
            progress(i + 1, len(poses))


def _write_description(folder: Path, plan: RecordingPlan, poses: np.ndarray, times: np.ndarray) -> None:
    facts = {
        "generator": f"ggslam synth {__version__}",
        "seed": plan.seed,
        "noise": plan.noise,
        "trajectory": plan.trajectory,
        **({} if plan.shutter.is_plain else {"shutter": asdict(plan.shutter)}),
        "frame_rate": plan.frame_rate,
        **({"depth_distortion": plan.distortion} if plan.distortion and plan.noise else {}),
        "instances": dict(plan.scene.instance_names),
    }
    plan.layout.write_description(folder, facts, plan.camera, poses, times.tolist())
