# SPDX-License-Identifier: Apache-2.0
"""`ggslam synth`: make a recording."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ggslam.cli.console import console, progress_bar
from ggslam.errors import SequenceError
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.synthetic import Shutter

EPILOG = """
[bold]Examples[/]

  ggslam synth demo/room --frames 60

  ggslam synth demo/loop --scene loop

  ggslam synth demo/corridor --scene corridor --frames 300

  ggslam synth demo/rig --rig front,back

  ggslam synth demo/monday --changes 5
  ggslam synth demo/tuesday --changes 5 --visit 2

  ggslam synth demo/busy --movers walker,mug,door

  ggslam synth demo/fast --path turns --speed 3 --blur 0.4

  ggslam synth demo/Replica/room0 --layout replica --size 1200x680 --frames 2000 --no-noise
"""


class SceneName(str, Enum):
    """What to record."""

    room = "room"
    loop = "loop"
    corridor = "corridor"
    bare = "bare"


class PathName(str, Enum):
    """How the camera moves."""

    loop = "loop"
    round = "round"
    pan = "pan"
    turns = "turns"
    still = "still"
    route = "route"
    walk = "walk"


class LayoutName(str, Enum):
    """How the recording lies in its folder."""

    plain = "plain"
    replica = "replica"


WidthOption = Annotated[int | None, typer.Option(help="Image width; default 320.", min=16)]
HeightOption = Annotated[int | None, typer.Option(help="Image height; default 240.", min=16)]
LayoutOption = Annotated[
    LayoutName,
    typer.Option(
        help="plain: rgb/, depth/, masks/, camera.yaml, poses.txt; replica: as Replica's recordings: results/, "
        "traj.txt, cam_params.json, 90 degrees of view."
    ),
]
SizeOption = Annotated[
    str | None, typer.Option(metavar="WxH", help="Size of the images, like 1200x680; instead of --width and --height.")
]
BlurOption = Annotated[
    float, typer.Option(help="Share of the time between two frames for which the shutter is open.", min=0, max=1)
]
RollingOption = Annotated[
    float,
    typer.Option(help="Share of the frame time between reading the first and the last row of an image.", min=0, max=1),
]
PathOption = Annotated[
    PathName | None,
    typer.Option(
        help="loop: around the room and back; round: around it, seeing all of it; pan: turning on the spot; turns: "
        "looking quickly from side to side; still: a tripod; route, walk: along a loop's or a corridor's way. "
        "Default: loop in the room, else the scene's way."
    ),
]
MoversOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help="What moves while the room is recorded: some of walker,mug,door; movers.json tells where it is in each "
        "frame. The same seed and frames without it: the same, with nothing that moves.",
    ),
]
RigOption = Annotated[
    str | None,
    typer.Option(
        metavar="CAMERAS",
        help="Record with several cameras fixed to one another: some of front,left,back,right, or degrees to the "
        "right, like 0,45,-30.",
    ),
]
SceneOption = Annotated[
    SceneName,
    typer.Option(
        help="room: one furnished room; loop: a walk through four rooms and four corridors, back into the first; "
        "corridor: a walk along a furnished corridor, longer with more frames, without a loop; bare: the same "
        "without furniture."
    ),
]


def synth(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write the recording to.")],
    scene: SceneOption = SceneName.room,
    frames: Annotated[
        int | None,
        typer.Option(help="Number of frames; default: room 60, with movers 120, loop 480, corridors 720.", min=2),
    ] = None,
    width: WidthOption = None, height: HeightOption = None,
    size: SizeOption = None,
    layout: LayoutOption = LayoutName.plain,
    seed: Annotated[int, typer.Option(help="Seed of textures, camera path and noise.", min=0)] = 0,
    path: PathOption = None,
    speed: Annotated[int, typer.Option(help="Factor on the camera's motion between two frames.", min=1)] = 1,
    blur: BlurOption = 0.0,
    rolling: RollingOption = 0.0,
    depth_delay: Annotated[
        float, typer.Option(help="Share of the frame time by which depth is later than colour.", min=-0.4, max=0.4)
    ] = 0.0,
    depth_distortion: Annotated[
        float | None,
        typer.Option(help="Fixed error of the depth camera, in steps of disparity; default 0, and 0.3 for the loop."),
    ] = None,
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="Add depth noise like a Kinect's.")] = True,
    rig: RigOption = None,
    rig_delay: Annotated[
        float, typer.Option(help="Seconds by which each camera of a rig is later than the one before it.", min=0)
    ] = 0.0,
    changes: Annotated[
        int | None,
        typer.Option(
            help="Number of things that differ between two visits; the second visit writes them to changes.json."
        ),
    ] = None,
    visit: Annotated[int, typer.Option(help="Which of the two visits to record.", min=1, max=2)] = 1,
    movers: MoversOption = None,
) -> None:
    """Generate a recording: textured, furnished rooms with exact poses and instance masks."""
    from ggslam.synthetic import SCENES, Shutter, SynthTuning

    if frames is None:
        frames = SynthTuning.frames_with_movers if movers is not None else SCENES[scene.value].frames
    width, height = _size_of(size, width, height)
    write = _writer(rig, rig_delay, changes, visit, movers, speed, Shutter(blur, rolling, depth_delay), layout.value)
    cameras = f" by each of {rig}" if rig is not None else ""
    with progress_bar() as bar:
        task = bar.add_task("render", total=frames, info="")
        write(
            folder, frames=frames, width=width, height=height, seed=seed, noise=noise, scene=scene.value,
            depth_distortion=depth_distortion, trajectory=None if path is None else path.value,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    console.print(
        f"wrote {folder}: {quantity(frames, 'frame')} of {width}x{height}{cameras}", highlight=False, markup=False
    )


def _size_of(text: str | None, own_width: int | None, own_height: int | None) -> tuple[int, int]:
    """Width and height: of a text like 1200x680, or one by one.

    Raises:
        SequenceError: it is not like that, or both are given.
    """
    if text is None:
        return own_width or 320, own_height or 240
    if own_width is not None or own_height is not None:
        raise SequenceError("--size: not with --width or --height")
    width, _, height = text.partition("x")
    if not (width.isascii() and width.isdecimal() and height.isascii() and height.isdecimal()):
        raise SequenceError(f"--size: expected WxH, like 1200x680, found '{text}'")
    return int(width), int(height)


def _writer(
    rig: str | None, delay: float, changes: int | None, visit: int, movers: str | None, speed: int, shutter: Shutter,
    layout: str,
) -> Callable[..., Path]:  # fmt: skip
    """What writes the recording, with the options that the others do not have."""
    from ggslam.synthetic import write_synthetic_rig, write_synthetic_sequence

    if changes is None and visit > 1:
        raise SequenceError("--visit: only with --changes there are two visits")
    if rig is None:
        moving = [] if movers is None else movers.split(",")
        return partial(
            write_synthetic_sequence, changes=changes, visit=visit, movers=moving, speed=speed, shutter=shutter,
            layout=layout,
        )  # fmt: skip
    asked = {
        "--changes": changes is not None, "--movers": movers is not None, "--speed": speed != 1,
        "--blur": shutter.blur, "--rolling": shutter.rolling, "--depth-delay": shutter.depth_delay,
        "--layout": layout != "plain",
    }  # fmt: skip
    for option, given in asked.items():
        if given:
            raise SequenceError(f"{option}: not with --rig")
    return partial(write_synthetic_rig, cameras=rig.split(","), delay=delay)
