# SPDX-License-Identifier: Apache-2.0
"""`ggslam inspect`: what a recording is, or what a coded stream is made of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from ggslam.cli import options
from ggslam.cli.console import console, table
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.scene.camera import Camera
    from ggslam.sequences.inspection import SequenceReport
    from ggslam.sequences.rig_inspection import RigReport

EPILOG = """
[bold]Examples[/]

  ggslam inspect data/rgbd_dataset_freiburg3_cabinet

  ggslam inspect walk.r3d

  ggslam inspect walk.bag --topic pose=/vicon/camera

  ggslam inspect --formats

  ggslam inspect kitchen.bin

  ggslam inspect kitchen.ggz
"""


class ClockReportTuning(Tuning):
    """When depth and colour are of the same time."""

    max_offset_s = 0.005
    """Largest measured offset, in seconds: recordings without any measure up to 0.0032."""


def inspect(
    sequence: Annotated[
        Path | None,
        typer.Argument(metavar="SEQUENCE|STREAM", help="A recording, or what `ggslam encode` wrote: .bin, .ggz, .ggc."),
    ] = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    scale: options.Scale = None,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    pose_convention: options.PoseConvention = None,
    masks: options.Masks = None,
    camera: options.OwnCamera = None,
    intrinsics: options.Intrinsics = None,
    depth_camera: options.DepthCamera = None,
    depth_kind: options.DepthKind = None,
    depth_delay: options.DepthDelay = None,
    upright: options.Upright = False,
    void_id: options.VoidId = None,
    min_confidence: options.MinConfidence = None,
    topics: options.Topics = None,
    formats: Annotated[bool, typer.Option("--formats", help="List the formats that ggslam reads.")] = False,
    skip_bad_frames: options.SkipBadFrames = False,
    samples: int = typer.Option(8, help="Number of frames to read and check.", min=1),
) -> None:
    """Print what was recognised in a recording, and likely mistakes; of a coded file, what is in it and its bytes."""
    from ggslam.sequences import open_sequence, recognise_format

    if formats:
        _print_formats()
        return
    if sequence is None:
        raise typer.BadParameter("give a recording or a stream, or --formats")
    if sequence.suffix.lower() in (".ggz", ".ggc") and not sequence.is_dir():
        _print_contents(sequence)
        return
    is_stream = sequence.is_file() and format_name is None and recognise_format(sequence) is None
    if is_stream or (sequence.suffix and not sequence.exists()):
        _print_stream(sequence)
        return
    from ggslam.sequences.inspection import inspect_sequence
    from ggslam.sequences.rig import RigSequence
    from ggslam.sequences.rig_inspection import inspect_rig

    recording = open_sequence(
        sequence, format=format_name, start=start, stop=stop, stride=stride, scale=scale, masks=masks,
        depth_scale=depth_scale, depth_camera=depth_camera, min_confidence=min_confidence, topics=topics or (),
        pose_convention=pose_convention, camera=camera, intrinsics=intrinsics,
        depth_kind=depth_kind, depth_delay=depth_delay, upright=upright, void_id=void_id,
        on_bad_frame="skip" if skip_bad_frames else "error",
    )  # fmt: skip
    if isinstance(recording, RigSequence):
        _print_rig(inspect_rig(recording, samples=samples, clocks=True))
        return
    report = inspect_sequence(recording, samples=samples, clocks=True)
    _print_lines(_lines(report))
    for reason in report.damaged:
        console.print(f"[red]damaged:[/] {escape(reason)}", highlight=False)
    _print_warnings(report.warnings)


def _print_lines(lines: list[tuple[str, str]]) -> None:
    for name, value in lines:
        console.print(f"[bold]{name:<13}[/] {escape(value)}", highlight=False)


def _print_warnings(warnings: list[str]) -> None:
    for warning in warnings:
        console.print(f"[yellow]warning:[/] {escape(warning)}", highlight=False)


def _print_rig(report: RigReport) -> None:
    """The rig, then each camera with its recording."""
    from math import degrees

    import numpy as np

    from ggslam.scene.poses import turning_angle

    names = ", ".join(camera.name for camera in report.cameras)
    tolerance = f"images at most {1e3 * report.tolerance:g} ms apart were taken together"
    _print_lines([
        ("rig", f"{report.name}: {names}"),
        ("instants", f"{report.instants}, {report.whole} of them with frames of all cameras; {tolerance}"),
    ])  # fmt: skip
    for camera in report.cameras:
        console.print()
        place, turned = camera.T_first_camera[:3, 3], degrees(turning_angle(camera.T_first_camera, np.eye(4)))
        words = f"{quantity(camera.frames, 'frame')}, {camera.together} of them with another camera's"
        if camera is not report.cameras[0]:
            words += f", {1e3 * camera.gap_s[0]:+.1f} ms after it (median; most {1e3 * camera.gap_s[1]:.1f} ms)"
        at = f"at {place[0]:.3f}, {place[1]:.3f}, {place[2]:.3f} m, turned by {turned:.1f} degrees"
        off = f"; true poses have it {100 * camera.off[0]:.1f} cm, {camera.off[1]:.2f} deg off" if camera.off else ""
        lines = [("camera of rig", camera.name), ("in the rig", f"{at} from {report.cameras[0].name}{off}")]
        _print_lines([*lines, ("images of it", words), *_lines(camera.recording)])
        for reason in camera.recording.damaged:
            console.print(f"[red]damaged:[/] {escape(reason)}", highlight=False)
    _print_warnings(report.warnings)


def _print_formats() -> None:
    from ggslam.sequences import FORMATS
    from ggslam.sequences.rig import LAYOUT as RIG_LAYOUT
    from ggslam.sequences.rig import NAME as RIG

    for known in FORMATS:
        console.print(f"[bold]{known.name:<13}[/] {escape(known.layout)}", highlight=False, soft_wrap=True)
    console.print(f"[bold]{RIG:<13}[/] {escape(RIG_LAYOUT)}", highlight=False, soft_wrap=True)


def _print_contents(path: Path) -> None:
    """What is in a .ggz or .ggc."""
    from ggslam.jobs.encode.coded_cells import is_cells_file
    from ggslam.jobs.encode.contents import contents_of_cells, contents_of_run

    found = contents_of_cells(path) if is_cells_file(path) else contents_of_run(path)
    for name, value in found.facts:
        console.print(f"[bold]{name:<17}[/] {escape(value)}", highlight=False, soft_wrap=True)
    rows = [
        [name, str(size), f"{size / max(1, found.gaussians):.2f}"]
        for name, size in [*found.parts.most_common(), ("the file", sum(found.parts.values()))]
    ]
    console.print(table("contained", ["part", "bytes", "bytes a Gaussian"], rows))
    for problem in found.problems:
        console.print(f"[red]damaged:[/] {escape(problem)}", highlight=False, soft_wrap=True)


def _print_stream(path: Path) -> None:
    from ggslam.jobs.encode.coding import list_stream

    listing = list_stream(path)
    for unit in listing.units:
        rate = "" if unit.bits_per_point is None else f"{unit.bits_per_point:8.3f} bits a point"
        console.print(f"[bold]{unit.offset:>9}  {unit.kind:<19}[/] {unit.size:>9} bytes {rate:<21}", highlight=False)
        console.print(f"           {escape(unit.fields)}", highlight=False, soft_wrap=True)
    total, points = sum(listing.parts.values()), listing.points
    rows = [
        [name, str(size), f"{8 * size / points:.3f}" if points else "-"]
        for name, size in [*listing.parts.items(), ("total", total)]
    ]
    console.print(
        table(f"{quantity(points, 'point')}, slices: {listing.slices}", ["part", "bytes", "bits a point"], rows)
    )
    for problem in listing.problems:
        console.print(f"[red]damaged or not supported:[/] {escape(problem)}", highlight=False)


def _camera(c: Camera) -> str:
    return f"{c.width}x{c.height}, fx {c.fx:.2f} fy {c.fy:.2f} cx {c.cx:.2f} cy {c.cy:.2f}"


def _images(r: SequenceReport) -> str:
    """How the stored images become those of `camera`."""
    color, depth = (f"{size[0]}x{size[1]}" for size in (r.color_size, r.depth_size))
    words = [f"colour {color}, depth {depth}"]
    words += ["depth registered to colour"] if r.registered else []
    words += [r.lens] if r.lens else []
    words += [f"depth of confidence below {r.min_confidence} dropped"] if r.min_confidence is not None else []
    return "; ".join(words)


def _times(r: SequenceReport) -> str:
    if r.time_source.startswith("nominal"):
        return f"{r.frames}, without times ({r.time_source} assumed)"
    rate = f" at {r.rate_hz:.1f} Hz" if r.rate_hz > 0 else ""  # NaN: a single frame, or all of one time
    return f"{r.frames}, {r.duration_s:.1f} s{rate} ({r.time_source})"


def _lines(r: SequenceReport) -> list[tuple[str, str]]:
    lines = [
        ("recording", f"{r.name} ({r.format})"),
        ("frames", _times(r)),
        ("camera", _camera(r.camera) + (f" ({r.camera_source})" if r.camera_source else "")),
        ("depth", f"{r.depth_m[0]:.2f} to {r.depth_m[2]:.2f} m, median {r.depth_m[1]:.2f} m; {r.valid_share:.0%} of "
                  f"pixels; {r.depth_scale:g} units a metre"),
        ("images", _images(r)),
        ("poses", f"{quantity(r.posed_frames, 'frame')} ({r.pose_source})" if r.posed_frames else "none"),
    ]  # fmt: skip
    if r.native_camera != r.camera:
        lines.insert(3, ("stored as", _camera(r.native_camera)))
    if r.clocks is not None and abs(r.clocks.seconds) > max(ClockReportTuning.max_offset_s, 2 * r.clocks.error):
        side = "after" if r.clocks.seconds > 0 else "before"
        apart, error = 1e3 * abs(r.clocks.seconds), 1e3 * r.clocks.error
        frames = quantity(r.clocks.frames, "frame")
        words = f"depth {apart:.1f} ms {side} colour (to {error:.1f} ms, by the motion in {frames})"
        lines.append(("clocks", words))
    elif r.clocks is not None and not r.verdicts:
        lines.append(
            ("clocks", f"depth and colour are of the same time, to {1e3 * ClockReportTuning.max_offset_s:.0f} ms")
        )
    if r.motion is not None:
        step, turn = r.motion.step_m, r.motion.turn_deg
        lines.append(("motion", f"path {r.motion.path_m:.2f} m; a frame: {step[0] * 100:.1f} cm and {turn[0]:.1f} "
                                f"deg (median), {step[2] * 100:.1f} cm and {turn[2]:.1f} deg (most)"))  # fmt: skip
    if r.pose_depth_error is not None:
        lines.append(("consistency", f"depth agrees with the poses to {r.pose_depth_error:.1%}"))
    if r.alignment is not None and r.alignment.doubtful:
        away = f"{r.alignment.off * r.camera.width:.1f} pixels away"
        lines.append(("alignment", f"outlines of depth fit the edges of colour best {away}"))
    elif r.alignment is not None and not r.verdicts:
        lines.append(("alignment", "outlines of depth lie on edges of colour, as they should"))
    if r.mask_kinds:
        kinds = ", ".join(f"{count} {kind}" for kind, count in r.mask_kinds.items())
        masks = f"{len(r.mask_ids)} ids, {r.named_ids} named, {r.labelled_share:.0%} of pixels"
        lines.append(("masks", f"{kinds}; in {r.masked_frames:.0%} of the frames looked at: {masks}"))
    return lines
