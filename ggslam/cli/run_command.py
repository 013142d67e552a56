# SPDX-License-Identifier: Apache-2.0
"""`ggslam run`: track and map a recording."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.markup import escape

from ggslam.cli import network, options, settings_help
from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver
from ggslam.cli.summary import print_scores, print_verdict
from ggslam.errors import ConfigError, TrackingLostError

if TYPE_CHECKING:  # torch is slow to import and `--help` does not need it
    from ggslam.jobs.run.encoding import EncodeRequest
    from ggslam.jobs.run.pipeline import RunOutcome, RunRequest
    from ggslam.jobs.serve.serving import ServeRequest
    from ggslam.middleware.opening import NodeRequest
    from ggslam.runs.recordings import SequenceRequest

EPILOG = """
[bold]Examples[/]

  ggslam run data/redkitchen --scale 0.5

  ggslam run data/redkitchen --scale 0.5 --iterations 8 --out runs/kitchen

  ggslam run data/redkitchen --scale 0.5 --realtime 10

  ggslam run data/redkitchen --set mapping.insertion.opacity=0.7 --set seed=1

  ggslam run data/redkitchen --scale 0.5 --log kitchen.rrd

  ggslam run data/redkitchen --scale 0.5 --view

  ggslam run realsense: --stop 900 --record data/desk --out runs/desk

  ggslam run ros2://camera/color,camera/depth --realtime 30 --out runs/robot

  ggslam run data/redkitchen --scale 0.5 --energy

  ggslam run --help-settings

  ggslam run data/second_visit --map runs/kitchen --localize-only --out runs/visit

  ggslam run --resume runs/kitchen

  ggslam run data/redkitchen --scale 0.5 --encode kitchen.bin --encode-with slices=4
"""

_SHORTCUTS = {
    "mapping.iterations_per_frame": "iterations", "refine_iterations": "refine", "realtime_fps": "realtime",
    "threads": "threads", "seed": "seed", "loops.enabled": "loops", "tracker": "tracker", "device": "device",
}  # fmt: skip
"""Settings that have options of their own, with their parameters."""
_MODEL = "masks.model"
"""Setting that whoever goes on with a run has to know, if it has one."""
_WITH_RESUME = {"sequence", "resume", "checkpoint_every", "log", "view", "publish", "host", "port", "middleware",
                "domain", "namespace", "address", "evaluate", "strict", "energy", "encode", "encode_with"}  # fmt: skip
"""Options that change nothing of what a run computes."""


STRICT_EXIT_CODE: Final = 3
"""Exit code under --strict of a run that ended but is bad, or whose recording seems wrong."""


class TrackerName(str, Enum):
    """How a run tracks the camera."""

    gicp = "gicp"
    edges_planes = "edges_planes"


class DeviceName(str, Enum):
    """What a run computes on."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


Out = Annotated[Path | None, typer.Option(help="Folder for the results; default runs/NAME.")]
Record = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="Keep the frames of a live camera in this folder, as a recording.")
]
Iterations = Annotated[int | None, typer.Option(help="Mapping iterations per frame (default 4).")]
Refine = Annotated[
    int | None,
    typer.Option(
        help="Mapping iterations after the last frame (default: 1.3 to 3 x the iterations so far, more for few frames)."
    ),
]
Realtime = Annotated[
    float | None, typer.Option(metavar="FPS", help="Deliver frames at this rate; tracker and mapper run side by side.")
]
Tracker = Annotated[
    TrackerName | None,
    typer.Option(help="gicp: track by generalised ICP (default); edges_planes: by edges and planes."),
]
Loss = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Add a loss of your own to the mapper's: module:function or "
                 "path/to/file.py:function, called as function(view, keyframe) in every mapping iteration."),
]  # fmt: skip
Device = Annotated[
    DeviceName | None, typer.Option(help="Compute on the CPU (default), on an NVIDIA GPU, or on a GPU if there is one.")
]
EarlierRun = Annotated[
    Path | None, typer.Option("--map", metavar="RUN", help="Start in the map of this run instead of an empty one.")
]
LocalizeOnly = Annotated[
    bool, typer.Option("--localize-only", help="With --map: locate the frames and do not change the map.")
]
Loops = Annotated[
    bool | None, typer.Option("--loops/--no-loops", help="Close loops and relocalize lost frames (default: yes).")
]
Threads = Annotated[int | None, typer.Option(help="Number of threads; default: one per processor.")]
Seed = Annotated[int | None, typer.Option(help="Seed of all random draws.", min=0)]
Log = Annotated[
    str | None, typer.Option(metavar="rerun|FILE.rrd", help="Stream poses, images and map to rerun, or to a file.")
]
ShowPage = Annotated[bool, typer.Option("--view", help="Show the map in a browser during and after the run.")]
Publish = Annotated[
    str | None,
    typer.Option(metavar="LIST", help="Publish poses and the map as it grows, and what came out until Ctrl-C: "
                 "foxglove[:PORT], ros2, http[:PORT] (functions, see ggslam serve), FILE.mcap, with commas between."),
]  # fmt: skip
Evaluate = Annotated[bool, typer.Option("--eval/--no-eval", help="Score the run at the end.")]
Check = Annotated[
    bool, typer.Option("--check/--no-check", help="Check depth first, and refuse it if it is certainly wrong.")
]
Resume = Annotated[
    Path | None,
    typer.Option(metavar="RUN", help="Continue an interrupted run with its own settings and recording."),
]
CheckpointEvery = Annotated[
    int | None,
    typer.Option(
        metavar="FRAMES", min=0,
        help="Save a checkpoint every FRAMES frames; 0: never. Default: as often as costs 1 % of the time.",
    ),
]
EncodeTo = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Also code the run, as `ggslam encode RUN FILE` does afterwards, byte for byte. "
                 "Slices are coded beside scoring, for no point is final before the last refinement ends; a .ggz, "
                 "which holds the run's records, at the end. With --resume name it again."),
]
EncodeWith = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="Option of `ggslam encode` for --encode, as qp=28 or no-ids; repeatable."),
]
Strict = Annotated[
    bool, typer.Option("--strict", help="Exit with code 3 if the verdict is bad or something seems wrong.")
]
Energy = Annotated[
    bool, typer.Option("--energy", help="Tell the joules that each part uses; without sensors, processor seconds.")
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace a finished run in the output folder, and the file of --encode.")
]


def run(
    context: typer.Context,
    sequence: options.LivePath = None,
    out: Out = None,
    config: options.ConfigName = None,
    settings: options.Settings = None,
    start: options.Start = 0, stop: options.Stop = None, stride: options.Stride = 1,
    scale: options.Scale = None,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    pose_convention: options.PoseConvention = None,
    masks: options.Masks = None,
    camera: options.OwnCamera = None, intrinsics: options.Intrinsics = None,
    depth_camera: options.DepthCamera = None,
    depth_kind: options.DepthKind = None, depth_delay: options.DepthDelay = None,
    upright: options.Upright = False, void_id: options.VoidId = None,
    min_confidence: options.MinConfidence = None,
    topics: options.Topics = None,
    record: Record = None,
    middleware: network.Middleware = network.MiddlewareName.zenoh, domain: network.Domain = 0,
    namespace: network.Namespace = "", address: network.Address = "",
    iterations: Iterations = None, refine: Refine = None,
    realtime: Realtime = None,
    tracker: Tracker = None,
    device: Device = None, loss: Loss = None,
    earlier: EarlierRun = None,
    localize_only: LocalizeOnly = False,
    loops: Loops = None,
    threads: Threads = None, seed: Seed = None,
    skip_bad_frames: options.SkipBadFrames = False, check: Check = True,
    log: Log = None, view: ShowPage = False, publish: Publish = None,
    host: options.Host = "127.0.0.1", port: options.Port = 8080,
    evaluate: Evaluate = True, overwrite: Overwrite = False,
    strict: Strict = False, energy: Energy = False,
    resume: Resume = None, checkpoint_every: CheckpointEvery = None,
    encode: EncodeTo = None, encode_with: EncodeWith = None,
    help_settings: settings_help.HelpSettings = False, help_setting: settings_help.HelpSetting = None,
) -> None:  # fmt: skip
    """Track the camera, build the map, write a run folder and score it."""
    from ggslam.jobs.run.pipeline import execute
    from ggslam.runs.recordings import SequenceRequest

    node = network.node_request(middleware, domain, namespace, address)
    page, served = (host, port) if view else None, _serve_request(publish, host, node, overwrite)
    watched = _Watched(log, page, strict, energy, served, out)
    coded_as = _encode_request(context, encode, encode_with)
    if resume is not None:
        return _go_on(context, resume, sequence, checkpoint_every, evaluate, settings, loss, coded_as, watched)
    reading = SequenceRequest(
        _recording(sequence), format_name, start, stop, stride, scale, masks, depth_scale,
        "skip" if skip_bad_frames else "error", depth_camera, min_confidence, tuple(topics or ()), pose_convention,
        camera, intrinsics, depth_kind, depth_delay, upright, void_id,
    )  # fmt: skip
    given = overrides_of(context.params)
    request = replace(
        _request(reading, record, node), out=out, config=config, overrides=given, evaluate=evaluate,
        overwrite=overwrite, map=earlier, localize_only=localize_only, checkpoint_every=checkpoint_every, check=check,
        loss=loss, energy=energy, encode=coded_as,
    )  # fmt: skip
    _run_and_show(partial(execute, request), reading.path.resolve().name, watched)


def _serve_request(publish: str | None, host: str, node: NodeRequest, overwrite: bool) -> ServeRequest | None:
    """How the run is published; None: it is not. Raises ConfigError for places that are none."""
    if publish is None:
        return None
    from ggslam.jobs.serve.outlets import FOXGLOVE_PORT, PublishRequest, parse_places
    from ggslam.jobs.serve.serving import ServeRequest

    places = parse_places(publish)
    port = FOXGLOVE_PORT if places.foxglove_port is None else places.foxglove_port
    return ServeRequest(PublishRequest(places.names, host, port, node, overwrite), host, places.http_port)


def _encode_request(context: typer.Context, out: Path | None, words: list[str] | None) -> EncodeRequest | None:
    """What the run is to be coded as. Raises ConfigError for options that are none."""
    from ggslam.cli.encode_command import run_encoding

    if out is None:
        if words:
            raise ConfigError("--encode-with goes with --encode")
        return None
    return run_encoding(context, out, words or [])


def _recording(sequence: Path | None) -> Path:
    if sequence is None:
        raise ConfigError("expected a recording (SEQUENCE), or --resume with a run")
    return sequence


def overrides_of(parameters: Mapping[str, Any]) -> list[str]:
    """What `--set` says, and the options that stand for a setting.

    Args:
        parameters: of this command.
    """
    given = {name: parameters[parameter] for name, parameter in _SHORTCUTS.items()}
    values = {name: value.value if isinstance(value, Enum) else value for name, value in given.items()}
    chosen = [f"{name}={value}" for name, value in values.items() if value is not None]
    return [*(parameters["settings"] or []), *chosen]


def _go_on(
    context: typer.Context, run: Path, recording: Path | None, checkpoint_every: int | None, evaluate: bool,
    settings: list[str] | None, loss: str | None, coded_as: EncodeRequest | None, watched: _Watched,
) -> None:  # fmt: skip
    """Goes on with a run that was cut off."""
    from ggslam.jobs.run.pipeline import resume

    models = [value for name, _, value in (text.partition("=") for text in settings or []) if name == _MODEL]
    given = refuse_other_options(context, ["loss", *(["settings"] if len(models) == len(settings or []) else [])])
    model = models[-1] if models else None
    again = partial(resume, run, recording=recording, checkpoint_every=checkpoint_every, model=model, loss=loss)
    again = partial(again, energy=watched.energy, encode=coded_as)
    again = partial(again, evaluate=evaluate) if "evaluate" in given else again
    _run_and_show(again, run.resolve().name, watched)


def refuse_other_options(context: typer.Context, more: Iterable[str] = ()) -> set[str]:
    """With --resume only options that do not change the result are taken, and those named in `more`; returns the
    parameters that were given.

    Raises:
        ConfigError: another one was given; it is named.
    """
    options_of = {parameter.name or "": parameter.opts[0] for parameter in context.command.params}
    sources = {name: context.get_parameter_source(name) for name in options_of}
    given = {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
    for name in sorted(given - _WITH_RESUME - set(more)):
        raise ConfigError(f"--resume: a resumed run keeps its options; {options_of[name]} cannot be changed")
    return given


def _request(reading: SequenceRequest, record: Path | None, node: NodeRequest) -> RunRequest:
    """A run of a recording, or of a live camera, which one of ROS 2 is found by `node`.

    Raises:
        ConfigError: what is no live camera is to be recorded.
    """
    from ggslam.jobs.run.pipeline import RunRequest
    from ggslam.runs.recordings import LiveRequest
    from ggslam.sequences.live import is_live

    if is_live(reading.path):
        return RunRequest(LiveRequest(**vars(reading), record=record).join(node))
    if record is not None:
        raise ConfigError("--record is for live cameras: a recording is kept already")
    return RunRequest(reading)


@dataclass(frozen=True)
class _Watched:
    """Where a run is logged, and the host and port of the page that shows it; None: not. Whether verdicts are
    failures, and whether energy is counted. How it is published, and the folder of its results, as far as it was told.
    """

    log: str | None
    address: tuple[str, int] | None
    strict: bool
    energy: bool = False
    served: ServeRequest | None = None
    out: Path | None = None


def _run_and_show(run: Callable[..., RunOutcome], name: str, watched: _Watched) -> None:
    """Runs, logged and shown on a page as asked; the page stays until Ctrl-C."""
    from ggslam.jobs.view.serve import wait_for_interrupt
    from ggslam.jobs.watch.watchers import watch_run

    beside = Path("runs") if watched.out is None else watched.out.resolve().parent
    with watch_run(watched.log, watched.address, name, watched.served, beside) as watchers:
        page, served = watchers.page, watchers.served
        for line in [] if served is None else served.lines:
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        if page is not None:
            console.print(f"the map as it grows: {page.address}", highlight=False, markup=False)
        with progress_bar() as bar:
            outcome = run(observer=ProgressObserver(bar), follower=watchers.follower, waiting=watchers.while_waiting)
        _print(outcome)
        watchers.finish(outcome)
        if outcome.error is None and (page is not None or (served is not None and served.stays)):
            text = f"{page.address} shows the run (Ctrl-C ends)" if page is not None else "published (Ctrl-C ends)"
            wait_for_interrupt(lambda: console.print(text, highlight=False, markup=False))
        if served is not None:
            console.print(served.publisher.line(), highlight=False, markup=False, soft_wrap=True)
    if outcome.error is not None:
        raise outcome.error
    if outcome.encode_failure is not None:
        raise outcome.encode_failure
    if failure := _failure(outcome):
        raise TrackingLostError(f"{failure}; what there is was saved to {outcome.folder.path}")
    if watched.strict and (outcome.verdicts or (outcome.verdict is not None and outcome.verdict.grade == "bad")):
        raise typer.Exit(STRICT_EXIT_CODE)


def _print(outcome: RunOutcome) -> None:
    console.print(f"{outcome.folder.path}: {outcome.headline()}", highlight=False, markup=False)
    if outcome.metrics is not None and not _failure(outcome):  # scores of the few frames that were located mislead
        print_scores(outcome.metrics)
    if outcome.energy is not None:
        console.print(outcome.energy.text(), highlight=False, markup=False)
    if outcome.latency is not None:
        console.print(outcome.latency.text(), highlight=False, markup=False)
    for verdict in outcome.verdicts:
        console.print(f"[yellow]{verdict.severity}:[/] {escape(verdict.text)}", highlight=False)
    if outcome.verdict is not None:
        print_verdict(outcome.verdict)
    if outcome.encoded:
        console.print(outcome.encoded, highlight=False, markup=False, soft_wrap=True)
    if _failure(outcome):
        return
    for hint in next_commands(outcome.folder.path) if outcome.error is None else go_on_command(outcome.folder.path):
        console.print(hint, highlight=False, markup=False, soft_wrap=True)  # commands are copied: no line breaks


def _failure(outcome: RunOutcome) -> str:
    """Why the run is no result, as a sentence; "": it is one."""
    return "" if outcome.verdict is None else outcome.verdict.failure


def go_on_command(run: Path) -> list[str]:
    """How a run that was cut off goes on, if it can."""
    from ggslam.jobs.run import resuming
    from ggslam.runs.checkpoints import Checkpoints, has_checkpoints

    if not has_checkpoints(run):
        return []
    start = Checkpoints(run).start()
    model = start.config.get("masks", {}).get("model", "")
    return [f"next: {resuming.go_on_command(run, model, start.loss)}"]


def next_commands(run: Path) -> list[str]:
    """What to try next, in words that can be copied; only what works with the packages that are installed."""
    path = shlex.quote(str(run))
    return [f"next: ggslam view {path}", f"      ggslam export {path} --format mesh --out mesh.ply"]
