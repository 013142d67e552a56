# SPDX-License-Identifier: Apache-2.0
"""`ggslam run`: track and map a recording."""

from __future__ import annotations

import shlex
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ggslam.cli import options, settings_help
from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.cli.summary import print_scores
from ggslam.errors import ConfigError

if TYPE_CHECKING:  # torch is slow to import and `--help` does not need it
    from ggslam.jobs.run.pipeline import RunOutcome, RunRequest

EPILOG = """
[bold]Examples[/]

  ggslam run data/redkitchen --scale 0.5

  ggslam run data/redkitchen --scale 0.5 --iterations 8 --refine 1000 --out runs/kitchen

  ggslam run data/redkitchen --scale 0.5 --realtime 10

  ggslam run data/redkitchen --set mapping.insertion.opacity=0.7 --set seed=1

  ggslam run data/redkitchen --scale 0.5 --log kitchen.rrd

  ggslam run data/redkitchen --scale 0.5 --view

  ggslam run realsense: --stop 900 --record data/desk --out runs/desk

  ggslam run --help-settings

  ggslam run data/second_visit --map runs/kitchen --localize-only --out runs/visit
"""


class DeviceName(str, Enum):
    """What a run computes on."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class TrackerName(str, Enum):
    """How frames are located."""

    gicp = "gicp"
    features = "features"


def run(
    sequence: options.LivePath,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default runs/NAME.")] = None,
    config: Annotated[str | None, typer.Option(help="Preset name or YAML file with settings.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Override one setting; repeatable.")
    ] = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    scale: options.Scale = 1.0,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    pose_convention: options.PoseConvention = None,
    masks: options.Masks = None,
    depth_camera: options.DepthCamera = None,
    min_confidence: options.MinConfidence = None,
    topics: options.Topics = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Keep the frames of a live camera here, as a recording.")
    ] = None,
    iterations: Annotated[int | None, typer.Option(help="Mapping iterations per frame (default 4).")] = None,
    refine: Annotated[int | None, typer.Option(help="Iterations of final refinement after the last frame.")] = None,
    realtime: Annotated[
        float | None, typer.Option(metavar="FPS", help="Frames arrive at this rate; tracker and mapper side by side.")
    ] = None,
    tracker: Annotated[
        TrackerName | None, typer.Option(help="How frames are located: G-ICP (default), or edge and plane features.")
    ] = None,
    device: Annotated[
        DeviceName | None, typer.Option(help="Compute on the CPU (default), on an NVIDIA GPU, or on one if there is.")
    ] = None,
    earlier: Annotated[
        Path | None, typer.Option("--map", metavar="RUN", help="Start in the map of this run instead of an empty one.")
    ] = None,
    localize_only: Annotated[
        bool, typer.Option("--localize-only", help="With --map: locate the frames, leave the map as it is.")
    ] = False,
    loops: Annotated[
        bool | None, typer.Option("--loops/--no-loops", help="Close loops and look lost frames up (default: yes).")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads; default: all processors.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of all random draws.", min=0)] = None,
    skip_bad_frames: Annotated[bool, typer.Option(help="Skip damaged frames instead of stopping at them.")] = False,
    log: Annotated[
        str | None, typer.Option(metavar="rerun|FILE.rrd", help="Stream poses, images and map to rerun, or to a file.")
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show the map in a browser while it grows, and after")] = False,
    host: options.Host = "127.0.0.1",
    port: options.Port = 8080,
    evaluate: Annotated[bool, typer.Option("--eval/--no-eval", help="Score the run at the end.")] = True,
    overwrite: Annotated[bool, typer.Option(help="Replace a finished run in the output folder.")] = False,
    help_settings: settings_help.HelpSettings = False,
    help_setting: settings_help.HelpSetting = None,
) -> None:
    """Track the camera, build the map, write a run folder and score it."""
    from ggslam.jobs.run.pipeline import RunRequest  # imports torch: only when needed
    from ggslam.runs.recordings import LiveRequest, SequenceRequest
    from ggslam.sequences.live import is_live

    shortcuts = {
        "mapping.iterations_per_frame": iterations, "refine_iterations": refine, "realtime_fps": realtime,
        "threads": threads, "seed": seed, "loops.enabled": loops,
        "tracker": None if tracker is None else tracker.value, "device": None if device is None else device.value,
    }  # fmt: skip
    overrides = [*(settings or []), *(f"{name}={value}" for name, value in shortcuts.items() if value is not None)]
    reading: dict[str, Any] = {
        "path": sequence, "format": format_name, "start": start, "stop": stop, "stride": stride, "scale": scale,
        "masks": masks, "depth_scale": depth_scale, "on_bad_frame": "skip" if skip_bad_frames else "error",
        "depth_camera": depth_camera, "min_confidence": min_confidence, "topics": tuple(topics or ()),
        "pose_convention": pose_convention,
    }  # fmt: skip
    live = is_live(sequence)
    if record is not None and not live:
        raise ConfigError("--record is for live cameras: a recording is kept already")
    request = RunRequest(
        sequence=LiveRequest(**reading, record=record) if live else SequenceRequest(**reading),
        out=out, config=config, overrides=overrides, evaluate=evaluate, overwrite=overwrite, map=earlier,
        localize_only=localize_only,
    )  # fmt: skip
    _run_and_show(request, log, (host, port) if view else None)


def _run_and_show(request: RunRequest, log: str | None, address: tuple[str, int] | None) -> None:
    """Runs, logged and shown on a page as asked; the page stays until Ctrl-C."""
    from ggslam.jobs.run.pipeline import execute
    from ggslam.jobs.view.viewing import wait_for_interrupt
    from ggslam.jobs.watch.watching import watching

    with watching(log, address, request.sequence.path.resolve().name) as watchers:
        page = watchers.page
        if page is not None:
            console.print(f"the map as it grows: {page.address}", highlight=False, markup=False)
        with progress_bar() as bar:
            outcome = execute(request, ProgressObserver(bar), watchers.follower)
        _print(outcome)
        watchers.finish(outcome)
        if page is not None and outcome.error is None:
            text = f"{page.address} shows the run (Ctrl-C ends)"
            wait_for_interrupt(lambda: console.print(text, highlight=False, markup=False))
    if outcome.error is not None:
        raise outcome.error


def _print(outcome: RunOutcome) -> None:
    console.print(f"{outcome.folder.path}: {outcome.headline()}", highlight=False, markup=False)
    if outcome.metrics is not None:
        print_scores(outcome.metrics)
    if outcome.error is None:
        path = shlex.quote(str(outcome.folder.path))
        for hint in (f"next: ggslam view {path}", f"      ggslam export {path} --format mesh --out mesh.ply"):
            console.print(hint, highlight=False, markup=False, soft_wrap=True)  # commands are copied: no line breaks
