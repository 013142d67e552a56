# SPDX-License-Identifier: Apache-2.0
"""`ggslam render`: pictures, films and plans of a run's map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.runs.folder import RunFolder

EPILOG = """
[bold]Examples[/]

  ggslam render runs/kitchen --frames 0,50,100

  ggslam render runs/kitchen --what color,depth --every 5 --width 1280 --out pictures

  ggslam render runs/kitchen --what color,ids,pca

  ggslam render statue.sog --every 1

  ggslam render runs/kitchen --film fly.mp4 --size 1280x720

  ggslam render runs/kitchen --film round.gif --path orbit --seconds 6 --size 480x360

  ggslam render runs/kitchen --film both.mp4 --what color,depth,side-by-side

  ggslam render runs/kitchen --pose "from 0 0 0 at 1 0 2" --what color --out view.png

  ggslam render runs/kitchen --plan plan.png --metre-per-pixel 0.005
"""


def render(
    context: typer.Context,
    run: options.MapPath,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the pictures; default RUN/renders, or NAME_renders beside a file.")
    ] = None,
    frames: Annotated[str | None, typer.Option(help="Frames, e.g. 0,50,100; default: 8, spread evenly.")] = None,
    every: Annotated[int | None, typer.Option(help="Render every n-th frame instead.", min=1)] = None,
    what: Annotated[
        str | None,
        typer.Option(help="Some of color, depth, alpha, ids, pca, separated by commas; of a film along the recorded "
                     "path also side-by-side. Default: color,depth, of a film color."),
    ] = None,
    width: Annotated[
        int | None, typer.Option(help="Width of the pictures; default: that of the run's images.", min=16, max=8192)
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of a film's or pose's pictures; default: as recorded.")
    ] = None,
    pose: Annotated[
        list[str] | None,
        typer.Option(help="Render from here: 'x y z qx qy qz qw' (TUM) or 'from x y z at x y z [up x y z]'; "
                     "repeatable."),
    ] = None,
    film: Annotated[Path | None, typer.Option(help="Write a film: .mp4, .gif or .webp.", metavar="FILE")] = None,
    path: Annotated[
        str | None,
        typer.Option(help="Way of the film: recorded (default), orbit, keys (set on the run's page), or a JSON file of "
                     "camera keys.", metavar="PATH"),
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Pictures a second; default 30, of a .gif 15.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Length of the film; default: as recorded; orbit 12.")] = None,
    smoothing: Annotated[
        float | None, typer.Option(help="Smoothing of the recorded path in seconds; 0: none; default 0.25.")
    ] = None,
    sequence: options.MovedSequence = None,
    plan: Annotated[
        Path | None, typer.Option(help="Write a floor plan to scale: a .png with a world file.", metavar="FILE")
    ] = None,
    metre_per_pixel: Annotated[float | None, typer.Option(help="Scale of the plan; default 0.01.")] = None,
    cut: Annotated[
        float | None, typer.Option(help="Height above the floor where the plan cuts; default: just above the cameras.")
    ] = None,
) -> None:  # fmt: skip
    """Render a run's map from the poses of its frames or from anywhere, as a film, or as a floor plan to scale."""
    from ggslam.runs.map_file import open_map

    _refuse_unused(_way(pose=pose, film=film, plan=plan), context.params)
    folder, kinds = open_map(run), "color,depth" if what is None else what
    if film is not None:
        chosen = size if size is not None or width is None else _size_of_width(folder, width)
        _film(folder, film, path, fps, seconds, chosen, "color" if what is None else what, smoothing, sequence)
    elif plan is not None:
        _plan(folder, plan, 0.01 if metre_per_pixel is None else metre_per_pixel, cut)
    elif pose:
        _poses(folder, pose, kinds, out, size)
    else:
        _frames(folder, frames, every, kinds.split(","), out, width)


USED: Final = {
    "frames": ("frames", "every", "out", "width", "what"),
    "pose": ("out", "size", "what"),
    "film": ("width", "size", "path", "fps", "seconds", "smoothing", "sequence", "what"),
    "plan": ("metre_per_pixel", "cut"),
}
"""Options that each way of rendering takes."""


def _way(**given: object) -> str:
    """Which of the ways is asked for; raises ConfigError for two."""
    wanted = [name for name, value in given.items() if value not in (None, [])]
    if len(wanted) > 1:
        raise ConfigError(f"`{wanted[0]}` and `{wanted[1]}`: expected one of them, found both")
    return wanted[0] if wanted else "frames"


def _refuse_unused(way: str, given: dict[str, object]) -> None:
    """Raises ConfigError for an option that would be ignored; `given` are the command's parameters."""
    for name, value in given.items():
        if value not in (None, []) and name not in (*USED[way], "run", "pose", "film", "plan"):
            others = " or ".join(f"`{other}`" for other in USED if name in USED[other])
            raise ConfigError(f"`{name}`: goes with {others}" + ("" if way == "frames" else f", not with `{way}`"))


def _frames(
    folder: RunFolder, frames: str | None, every: int | None, what: list[str], out: Path | None, width: int | None
) -> None:
    from ggslam.jobs.render.frames import render_frames, select_frames

    numbers = select_frames(folder, frames, every)
    with progress_bar() as bar:
        task = bar.add_task("render", total=len(numbers), info="")
        written = render_frames(
            folder, numbers, what, out or folder.output("renders"), width,
            progress=lambda done: bar.update(task, completed=done),
        )  # fmt: skip
    _say(f"wrote {quantity(len(written), 'picture')} to {out or folder.output('renders')}")


def _film(
    folder: RunFolder, film: Path, path: str | None, fps: float | None, seconds: float | None, size: str | None,
    what: str, smoothing: float | None, sequence: Path | None,
) -> None:  # fmt: skip
    from ggslam.jobs.render.film import render_film
    from ggslam.jobs.render.shots import parse_size

    path = path if path is not None else "recorded" if folder.has_poses else "orbit"
    smoothing = 0.25 if smoothing is None else smoothing
    with progress_bar() as bar:
        task = bar.add_task("film", total=None, info="")
        note = render_film(
            folder, film, path=path, fps=fps, seconds=seconds, size=None if size is None else parse_size(size),
            what=what.split(","), smoothing=smoothing, recording=sequence,
            progress=lambda done, count: bar.update(task, completed=done, total=count),
        )  # fmt: skip
    _say(f"wrote {film}" + (f" ({note})" if note else ""))


def _plan(folder: RunFolder, plan: Path, metre_per_pixel: float, cut: float | None) -> None:
    from ggslam.jobs.render.plan import render_plan

    made = render_plan(folder, plan, metre_per_pixel=metre_per_pixel, cut=cut)
    above = "the floor" if made.floor is not None else "the first camera (no floor was found)"
    _say(
        f"wrote {plan}: {made.camera.width}x{made.camera.height} pixels of {metre_per_pixel:g} m, cut {made.cut:.2f} m "
        f"above {above}; {plan.with_suffix('.pgw').name} and {plan.with_suffix('.json').name} hold its place"
    )


def _poses(folder: RunFolder, poses: list[str], what: str, out: Path | None, size: str | None) -> None:
    from ggslam.jobs.render.shots import parse_size
    from ggslam.jobs.render.single_views import parse_poses, render_poses

    target = out or folder.output("renders")
    written = render_poses(
        folder, parse_poses(folder, poses), what.split(","), target, None if size is None else parse_size(size)
    )
    _say(f"wrote {quantity(len(written), 'picture')} to {target}")


def _size_of_width(folder: RunFolder, width: int) -> str:
    camera = folder.sequence().camera
    return f"{width}x{round(camera.height * width / camera.width)}"


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False)
