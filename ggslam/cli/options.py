# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from ggslam.errors import ConfigError

SequencePath = Annotated[
    Path, typer.Argument(metavar="SEQUENCE", help="Folder or file of the recording; its format is recognised.")
]
MovedSequence = Annotated[
    Path | None, typer.Option("--sequence", help="Where the recording is now, if it was moved after the run.")
]
SkipBadFrames = Annotated[bool, typer.Option(help="Skip damaged frames instead of stopping at the first one.")]
ConfigName = Annotated[str | None, typer.Option("--config", help="Preset name, or YAML file with settings.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Override one setting; repeatable.")
]
Columns = Annotated[
    int | None,
    typer.Option(help="Numbers that a .bin scan stores for each point; default: guessed from the file.", min=3),
]
Body = Annotated[
    list[str] | None,
    typer.Option(metavar="BOX|URDF", help="The robot's own body in view, left out of depth and scans: a box "
                 "xmin,ymin,zmin,xmax,ymax,zmax in the sensor's frame (metres; of a camera x right, y down, z forward) "
                 "or a URDF file. May be repeated."),
]  # fmt: skip
BodyFrame = Annotated[
    str | None, typer.Option(metavar="LINK", help="With a URDF file in --body: the sensor's link in it.")
]
LivePath = Annotated[
    Path | None,
    typer.Argument(
        metavar="SEQUENCE|LIVE",
        help="Folder or file of the recording, or a camera: realsense:[SERIAL], ros2://COLOR,DEPTH (topics of ROS 2), "
        "python:MODULE:CALLABLE. With --resume: where the recording is now, if it was moved.",
    ),
]
MapPath = Annotated[
    Path,
    typer.Argument(metavar="MAP", help="Folder that `ggslam run` wrote, or file of Gaussians: 3DGS or compressed .ply, "
                   ".sog or meta.json, .spz, .splat, .glb, .usda .usdc .usdz, .ggz, or G-PCC .bin."),
]  # fmt: skip
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `ggslam run` wrote.")]
Start = Annotated[int, typer.Option("--start", help="First frame to use.", min=0)]
Stop = Annotated[int | None, typer.Option(help="Stop before this frame.", min=1)]
Stride = Annotated[int, typer.Option(help="Use only every n-th frame.", min=1)]
Scale = Annotated[
    float | None,
    typer.Option(help="Resize the images by this factor, e.g. 0.5. Default 1: the stored size, or 640x480 pixels where "
                 "colour is much finer than depth (phones)."),
]  # fmt: skip
Threads = Annotated[int | None, typer.Option(help="Number of threads; default: one per processor.", min=1, max=1024)]
Format = Annotated[str | None, typer.Option("--format", help="Format of the recording, if it is not recognised.")]
DepthScale = Annotated[
    float | None, typer.Option(help="Units of the depth images per metre, instead of the recording's own.")
]
Masks = Annotated[Path | None, typer.Option(help="Folder with instance masks to use instead of the recording's own.")]
Host = Annotated[str, typer.Option(help="Address to serve the page at; 0.0.0.0 lets other machines connect.")]
Port = Annotated[int, typer.Option(help="Port to serve the page at; 0 takes any free one.", min=0, max=65535)]
DepthCamera = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="File with the calibration of a separate depth camera, T_color_depth included."),
]
OwnCamera = Annotated[
    Path | None,
    typer.Option("--camera", metavar="FILE", help="Calibration file of the colour camera, instead of the recording's "
                 "own: camera.yaml, K.txt, or a file of OpenCV, ORB-SLAM, ROS, Kalibr, Open3D or COLMAP."),
]  # fmt: skip
Intrinsics = Annotated[
    str | None,
    typer.Option(metavar="'FX FY CX CY [K1 ...]'", help="The same as numbers, of colour images as stored: pixels, then "
                 "up to 8 coefficients of distortion in OpenCV's order."),
]  # fmt: skip
MinConfidence = Annotated[
    int | None, typer.Option(help="Drop depth of lower confidence (0, 1, 2; default 1), where the recording stores it.")
]
DepthKind = Annotated[
    str | None,
    typer.Option(metavar="KIND", help="What depth images hold: z (along the optical axis; default), ray (along the "
                 "pixel's ray), inverse or inverse:N (z = N / stored); also mirrored, flipped, none:CODE (CODE means "
                 "nothing measured); with commas between."),
]  # fmt: skip
DepthDelay = Annotated[
    str | None,
    typer.Option(metavar="DELAY", help="How much later depth was taken than the colour stored beside it: 1f (one "
                 "frame), -1f, or 33ms. Colour is then paired with the depth of its own time."),
]  # fmt: skip
Upright = Annotated[
    bool, typer.Option("--upright", help="Rotate colour images by their EXIF orientation.")
]
VoidId = Annotated[
    int | None,
    typer.Option(help="Mask id that means unlabelled, besides 0; VOC and DAVIS use 255.", min=1, max=2**24 - 1),
]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="ROLE=TOPIC", help="ROS topic of color, depth, color_info, ...; repeatable."),
]
PoseConvention = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="How the recording's poses are written, if not camera to world with OpenCV axes: world-to-camera, opengl, "
        "world-to-camera-opengl, wxyz, world-to-camera-wxyz.",
    ),
]


class EngineName(str, Enum):
    """Where cells of a store are worked on."""

    local = "local"
    ray = "ray"


CellEngine = Annotated[
    EngineName,
    typer.Option("--engine", help="Of a store: local: processes on this machine; ray: tasks of a Ray cluster."),
]
CellWorkers = Annotated[
    int | None, typer.Option("--workers", help="Of a store: cells at a time; default: one for every two processors.")
]
CellAddress = Annotated[
    str | None,
    typer.Option(
        "--address",
        help="Address of the Ray cluster; auto: the cluster of this machine. Default: a new cluster on this machine.",
    ),
]


def refuse_others(context: typer.Context, option: str, taken: Iterable[str]) -> None:
    """Raises ConfigError for the options of a command line, but for these parameters, that another one ignores."""
    sources = {one: context.get_parameter_source(one.name or "") for one in context.command.params}
    given = {one for one, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
    names = [next(iter(one.opts)) for one in given if one.name not in set(taken)]
    if names:
        raise ConfigError(f"{option}: {', '.join(sorted(names))} cannot go with it")
