# SPDX-License-Identifier: Apache-2.0
"""`ggslam inspect`: what a recording is."""

from __future__ import annotations

import typer

from ggslam.cli import options
from ggslam.cli.console import console

EPILOG = "[bold]Example[/]  ggslam inspect data/rgbd_dataset_freiburg3_cabinet"


def inspect(
    sequence: options.SequencePath,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    scale: options.Scale = 1.0,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    samples: int = typer.Option(8, help="Frames to read and look at.", min=1),
) -> None:
    """Print what was recognised in a recording, and likely mistakes."""
    from ggslam.sequences import open_sequence
    from ggslam.sequences.inspection import inspect_sequence

    recording = open_sequence(
        sequence, format=format_name, start=start, stop=stop, stride=stride, scale=scale, depth_scale=depth_scale
    )
    report = inspect_sequence(recording, samples=samples)
    for name, value in report.lines():
        console.print(f"[bold]{name:<14}[/] {value}", highlight=False)
    for warning in report.warnings:
        console.print(f"[yellow]warning:[/] {warning}", highlight=False)
