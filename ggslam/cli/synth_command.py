# SPDX-License-Identifier: Apache-2.0
"""`ggslam synth`: make a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli.console import console, progress_bar

EPILOG = "[bold]Example[/]  ggslam synth demo/room --frames 60"


def synth(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to write the recording.")],
    frames: Annotated[int, typer.Option(help="Number of frames.", min=2)] = 60,
    width: Annotated[int, typer.Option(help="Image width.", min=16)] = 320,
    height: Annotated[int, typer.Option(help="Image height.", min=16)] = 240,
    seed: Annotated[int, typer.Option(help="Of room and camera path.", min=0)] = 0,
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="Depth noise of a Kinect-like sensor.")] = True,
) -> None:
    """Generate a recording: a textured, furnished room with exact poses and instance masks."""
    from ggslam.sequences.synthetic import write_synthetic_sequence

    with progress_bar() as bar:
        task = bar.add_task("render", total=frames, info="")
        write_synthetic_sequence(
            folder, frames=frames, width=width, height=height, seed=seed, noise=noise,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    console.print(f"wrote {folder}: {frames} frames of {width}x{height}", highlight=False, markup=False)
