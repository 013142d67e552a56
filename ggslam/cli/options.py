# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SequencePath = Annotated[
    Path, typer.Argument(metavar="SEQUENCE", help="Folder or file of the recording; its format is recognised.")
]
LivePath = Annotated[
    Path,
    typer.Argument(
        metavar="SEQUENCE|LIVE",
        help="Folder or file of the recording, or a camera: realsense:[SERIAL], python:MODULE:CALLABLE.",
    ),
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `ggslam run` wrote.")]
Start = Annotated[int, typer.Option(help="First frame to use.")]
Stop = Annotated[int | None, typer.Option(help="Frame to stop before.")]
Stride = Annotated[int, typer.Option(help="Use every n-th frame.")]
Scale = Annotated[float, typer.Option(help="Resize the images by this factor, e.g. 0.5.")]
Format = Annotated[str | None, typer.Option("--format", help="Recording format, if it is not recognised.")]
DepthScale = Annotated[float | None, typer.Option(help="Raw depth units per metre, to override the recording's.")]
Masks = Annotated[Path | None, typer.Option(help="Folder with instance masks, if not the recording's own.")]
Host = Annotated[str, typer.Option(help="Address of the page; 0.0.0.0: other machines can connect, too.")]
Port = Annotated[int, typer.Option(help="Port of the page; 0: any free one.", min=0, max=65535)]
DepthCamera = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="YAML with the calibration of a depth camera beside the colour camera."),
]
MinConfidence = Annotated[
    int | None, typer.Option(help="Drop depth less sure than 0, 1 or 2, where the recording tells (default 1).")
]
Topics = Annotated[
    list[str] | None, typer.Option("--topic", metavar="ROLE=TOPIC", help="Of a ROS bag: color, depth, color_info, ...")
]
PoseConvention = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="What the recording's poses are, if not camera to world with OpenCV axes: world-to-camera, opengl, "
        "world-to-camera-opengl, wxyz, world-to-camera-wxyz.",
    ),
]
