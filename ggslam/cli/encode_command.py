# SPDX-License-Identifier: Apache-2.0
"""`ggslam encode`: a cloud or a map as a G-PCC stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar, table
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity

if TYPE_CHECKING:
    from ggslam.coding import CodecSettings, CodingReport
    from ggslam.coding.study import StudyRow
    from ggslam.jobs.run.encoding import EncodeRequest

EPILOG = """
[bold]Examples[/]

  ggslam encode runs/kitchen kitchen.bin

  ggslam encode scan.pcd scan.bin --voxel 0.01 --qp 28 --slices 4 --split interval

  ggslam encode runs/kitchen kitchen_map.bin --preset splat --rate r03

  ggslam encode runs/kitchen kitchen.ggz --slices 4

  ggslam encode house.grid house.ggc --workers 4

  ggslam encode scan.pcd scan.bin --voxel 0.01 --geometry-qp 8

  ggslam encode runs/kitchen study/ --sweep all
"""


class Split(str, Enum):
    """How slices are cut."""

    by_count = "count"
    by_interval = "interval"
    by_octree = "octree"


class Preset(str, Enum):
    """What is coded."""

    pointcloud = "pointcloud"
    splat = "splat"


class Rate(str, Enum):
    """Quality of the splat preset."""

    r01 = "r01"
    r02 = "r02"
    r03 = "r03"
    r04 = "r04"


class Sweep(str, Enum):
    """What to vary in a study."""

    qp = "qp"
    geometry = "geometry"
    geometry_qp = "geometry-qp"
    both = "both"
    all = "all"


Slicing = Annotated[
    Split,
    typer.Option(
        help="How slices are cut: equal numbers of points, equal intervals of the longest axis, or octree cubes."
    ),
]
GeometryQp = Annotated[
    int,
    typer.Option(
        help="Quantiser of the positions within the octree; adding 8 doubles the step, 0: lossless.", min=0, max=96
    ),
]
Varied = Annotated[
    Sweep | None,
    typer.Option(help="Write a study, with tables, plots and pictures: over QPs of colours (qp), geometry scales "
                 "(geometry), QPs of positions (geometry-qp), the first two (both) or all of them."),
]  # fmt: skip
Source = Annotated[
    Path,
    typer.Argument(metavar="INPUT", help="PLY or PCD file, file of Gaussians (3DGS .ply, .sog, .spz, ...), folder that "
                   "`ggslam run` wrote, or grid store."),
]
Out = Annotated[
    Path,
    typer.Argument(
        metavar="OUT", help="Stream to write; a .ggz: of a run, with all that merging needs; a .ggc: of a grid store, "
        "cell by cell; with --sweep a folder."
    ),
]  # fmt: skip


def encode(
    context: typer.Context,
    source: Source,
    out: Out,
    qp: Annotated[
        int, typer.Option(help="Quantiser of colours and reflectance; adding 6 doubles the step.", min=4, max=51)
    ] = 22,
    chroma_offset: Annotated[int, typer.Option(help="Added to --qp for chroma.", min=-51, max=51)] = 0,
    geometry_scale: Annotated[float, typer.Option(help="Resolution of the positions; 0.5: half.", min=1e-6)] = 1.0,
    geometry_qp: GeometryQp = 0,
    voxel: Annotated[
        float | None, typer.Option(help="Voxel size in metres; default: the cloud's own grid, else --bits.", min=1e-9)
    ] = None,
    bits: Annotated[
        int, typer.Option(help="Bits of the longest side of a cloud without a grid.", min=1, max=21)
    ] = 10,
    slices: Annotated[int, typer.Option(help="Number of slices, coded in parallel.", min=1, max=65536)] = 1,
    split: Slicing = Split.by_count,
    threads: options.Threads = None,
    preset: Annotated[
        Preset, typer.Option(help="pointcloud: positions and what they carry; splat: whole Gaussians of a 3DGS PLY.")
    ] = Preset.pointcloud,
    rate: Annotated[Rate, typer.Option(help="Quality of splat, r01 smallest; instead of --qp and --bits.")] = Rate.r03,
    ids: Annotated[
        bool, typer.Option("--ids/--no-ids", help="Also code object ids and other whole numbers, without loss.")
    ] = True,
    sweep: Varied = None,
    plots: Annotated[bool, typer.Option("--plots/--no-plots", help="Draw a study's plots.")] = True,
    engine: options.CellEngine = options.EngineName.local,
    workers: options.CellWorkers = None,
    address: options.CellAddress = None,
) -> None:
    """Encode a point cloud or a Gaussian map as an MPEG G-PCC stream (ISO/IEC 23090-9), in parallel slices."""
    from ggslam.jobs.encode.coded_cells import is_cells_file
    from ggslam.jobs.encode.coding import encode_file
    from ggslam.jobs.submaps.stores import is_store
    from ggslam.runs.map_container import is_container

    contained, of_store = is_container(out), is_cells_file(out)
    _refuse_ignored(context, Preset.splat if contained or of_store else preset, sweep, of_store)
    if of_store != is_store(source):
        raise ConfigError(f"a grid store becomes a .ggc, and nothing else does: found {source} and {out}")
    settings = _settings(context.params)
    if sweep is not None:
        _study(source, out, settings, _kinds(sweep), plots)
        return
    if of_store:
        return _encode_store(source, out, settings, rate, (engine, workers, address))
    if contained:
        return _contain(source, out, settings, rate)
    done = encode_file(source, out, settings, preset.value, rate.value, ids)
    _print_report(done.report, rate if preset is Preset.splat else None)
    for note in done.notes:
        console.print(f"note: {note}", highlight=False, markup=False)
    console.print(f"wrote {done.path}", highlight=False, markup=False)


def _settings(values: Mapping[str, Any]) -> CodecSettings:
    """What the options of this command say of the codec."""
    from ggslam.coding import CodecSettings

    split = _word(values["split"])
    return CodecSettings(
        qp=values["qp"], chroma_offset=values["chroma_offset"], geometry_scale=values["geometry_scale"],
        geometry_qp=values["geometry_qp"], voxel_size=values["voxel"], geometry_bits=values["bits"],
        slices=values["slices"], threads=values["threads"], split="cube" if split == "octree" else split,
    )  # fmt: skip


def _word(value: Enum | str) -> Any:
    """The value of a choice, which typer keeps as a word until the command is called."""
    return value.value if isinstance(value, Enum) else value


def run_encoding(context: typer.Context, out: Path, words: Sequence[str]) -> EncodeRequest:
    """What `ggslam encode RUN OUT` with options would code a run as that is still to be made.

    Args:
        context: of another command.
        out: the file.
        words: options of this command, as "qp=28" or "no-ids".

    Raises:
        ConfigError: options that are none, or not for a run.
    """
    from ggslam.jobs.run.encoding import EncodeRequest
    from ggslam.runs.map_container import is_container

    parted = [word.partition("=") for word in words]
    if any(name in ("", "help") for name, _, _ in parted):
        raise ConfigError("--encode-with: expected an option of `ggslam encode` that says how to code, as qp=28")
    typed = [part for name, sign, value in parted for part in (f"--{name}", *([value] if sign else []))]
    group = context.parent
    command = None if group is None else group.command.get_command(group, "encode")  # type: ignore[attr-defined]
    assert command is not None
    own = command.make_context("encode", ["RUN", str(out), *typed], parent=group)
    values = own.params
    if values["sweep"] is not None:
        raise ConfigError("--encode-with: --sweep writes a study, which is made of a finished run")
    preset = Preset(_word(values["preset"]))
    _refuse_ignored(own, Preset.splat if is_container(out) else preset, None, False)
    return EncodeRequest(out, _settings(values), preset.value, _word(values["rate"]), values["ids"])


def _encode_store(
    source: Path, out: Path, settings: CodecSettings, rate: Rate,
    where: tuple[options.EngineName, int | None, str | None],
) -> None:  # fmt: skip
    """The Gaussians of a store, cell by cell."""
    from ggslam.cli.observer import ProgressObserver
    from ggslam.jobs.encode.store_coding import encode_store
    from ggslam.jobs.tasks.engines import Engine

    with progress_bar() as bar:
        engine = Engine(where[0].value, *where[1:])
        done = encode_store(source, out, rate.value, settings, engine, ProgressObserver(bar))
    total = out.stat().st_size
    console.print(
        f"{quantity(done.gaussians, 'Gaussian')} in {quantity(len(done.sizes), 'cell')}: {quantity(total, 'byte')}, "
        f"{total / max(1, done.gaussians):.1f} "
        f"a Gaussian; in the store {done.store_bytes}, {done.store_bytes / max(1, total):.1f} times as many; "
        f"{done.seconds:.1f} s", highlight=False,
    )  # fmt: skip
    _print_loss(rate)
    for line in (f"wrote {out}", *(f"left out: {line}" for line in done.failures.values())):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if done.failures:
        raise typer.Exit(done.exit_code)


def _contain(source: Path, out: Path, settings: CodecSettings, rate: Rate) -> None:
    """A run in a container."""
    from ggslam.jobs.encode.stream_output import check_stream_output
    from ggslam.runs.folder import RunFolder
    from ggslam.runs.map_container import write_container

    check_stream_output(out, [source])
    done = write_container(RunFolder.open(source), out, rate.value, settings)
    total = out.stat().st_size
    rows = [[name, str(size), f"{size / max(1, done.gaussians):.1f}"] for name, size in done.sizes.items()]
    rows.append(["the file", str(total), f"{total / max(1, done.gaussians):.1f}"])
    console.print(table("contained", ["member", "bytes", "bytes a Gaussian"], rows))
    console.print(
        f"{quantity(done.gaussians, 'Gaussian')}; the same files of the run take {quantity(done.run_bytes, 'byte')}, "
        f"{done.run_bytes / max(1, total):.1f} times as many", highlight=False,
    )  # fmt: skip
    _print_loss(rate)
    for note in done.notes:
        console.print(f"note: {note}", highlight=False, markup=False)
    console.print(f"wrote {out}", highlight=False, markup=False)


def _print_loss(rate: Rate) -> None:
    from ggslam.coding.splats import loss_words

    console.print(loss_words(rate.value), highlight=False, soft_wrap=True)


def _refuse_ignored(context: typer.Context, preset: Preset, sweep: Sweep | None, of_store: bool) -> None:
    """Raises ConfigError for an option that the others leave without effect."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = {name for name, source in sources.items() if source is not None and source.name != "DEFAULT"}
    if not of_store and given & {"engine", "workers", "address"}:
        raise ConfigError("--engine, --workers and --address are for grid stores, and this is none")
    if of_store and "threads" in given:
        raise ConfigError("--threads is not for grid stores: their cells are coded by --workers")
    if preset is Preset.splat:
        for name in ("qp", "chroma_offset", "bits", "geometry_qp", "sweep"):
            if name in given:
                option = name.replace("_", "-")
                raise ConfigError(f"--{option} goes with --preset pointcloud; the quality of --preset splat is --rate")
    elif "rate" in given:
        raise ConfigError("--rate goes with --preset splat; the quality of --preset pointcloud is --qp")
    if sweep is not None and given & {"qp", "geometry_scale", "geometry_qp"}:
        raise ConfigError("--qp, --geometry-scale and --geometry-qp are what --sweep varies")
    if sweep is not None and "ids" in given:
        raise ConfigError("--sweep codes no ids: leave --ids and --no-ids out")
    if sweep is None and "plots" in given:
        raise ConfigError("--plots goes with --sweep")


def _print_report(report: CodingReport, rate: Rate | None) -> None:
    parts = {"geometry": report.geometry_bytes, **report.attribute_bytes}
    parts["headers"] = report.total_bytes - sum(parts.values())
    rows = [[name, str(size), _rate(size, report.input_points)] for name, size in parts.items()]
    rows.append(["total", str(report.total_bytes), _rate(report.total_bytes, report.input_points)])
    console.print(table("coded", ["part", "bytes", "bits a point"], rows))
    merged = "" if report.points == report.input_points else f", {report.points} after those in one voxel were merged"
    speed = report.input_points / max(report.seconds, 1e-9) / 1e6
    console.print(
        f"{quantity(report.input_points, 'point')}{merged}; slices: {len(report.slices)}; {report.seconds:.2f} s, "
        f"{speed:.2f} million points/s", highlight=False,
    )  # fmt: skip
    if rate is not None:
        _print_loss(rate)


def _rate(size: int, points: int) -> str:
    return f"{8 * size / points:.3f}"


def _kinds(sweep: Sweep) -> Sequence[str]:
    """The sweeps of a study."""
    from ggslam.coding.study import SWEEPS

    several = {Sweep.both: SWEEPS[:2], Sweep.all: SWEEPS}
    return several.get(sweep, (sweep.value.replace("-", "_"),))


def _study(source: Path, out: Path, settings: CodecSettings, kinds: Sequence[str], plots: bool) -> None:
    from ggslam.coding.study import sweep_steps
    from ggslam.jobs.encode.coding import study_cloud
    from ggslam.jobs.encode.study import write_study

    steps = sweep_steps(kinds)
    cloud = study_cloud(source, settings)
    with progress_bar() as bar:
        task = bar.add_task("sweep", total=len(steps), info="")

        def show(row: StudyRow) -> None:
            bar.update(task, advance=1, info=row.step.words())

        study = write_study(cloud, steps, settings, out, plots, show)
    columns = ["step", "points", "bits", "Y dB", "D1 dB", "D2 dB", "enc. s", "dec. s", "enc. cpu s", "J"]
    title = f"{quantity(len(cloud.grid), 'point')}; bits per point of these"
    console.print(table(title, columns, [_study_cells(row) for row in study.rows]))
    for note in study.notes:
        console.print(f"note: {note}", highlight=False, markup=False)
    files = quantity(len(study.files), "file")
    console.print(f"wrote {files} and the pictures to {out}", highlight=False, markup=False)


def _study_cells(row: StudyRow) -> list[str]:
    return [
        row.step.words(), str(row.decoded_points), _rate(row.total_bytes, row.input_points), f"{row.color.y:.2f}",
        f"{row.d1:.2f}", f"{row.d2:.2f}", f"{row.encode_s:.2f}", f"{row.decode_s:.2f}",
        f"{row.encode_cpu_s:.2f}", "-" if row.joules is None else f"{row.joules:.1f}",
    ]  # fmt: skip
