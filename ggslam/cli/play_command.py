# SPDX-License-Identifier: Apache-2.0
"""`ggslam play`: a recording as a camera of ROS 2."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

import typer

from ggslam.cli import network, options
from ggslam.cli.console import console, progress_bar
from ggslam.cli.observer import ProgressObserver

EPILOG = """
[bold]Examples[/]

  ggslam play data/redkitchen

  ggslam play demo/room --fps 30 --loop --prefix robot1/camera

  ggslam play data/walk --compressed --depth 32FC1 --middleware dds --domain 3

  ggslam run ros2://camera/color,camera/depth?idle=5      (in another terminal)
"""


class DepthEncoding(str, Enum):
    """How depth is written."""

    whole_millimetres = "16UC1"
    metres = "32FC1"


Prefix = Annotated[str, typer.Option(metavar="NAME", help="Topics are NAME/color, NAME/depth and NAME/camera_info.")]
Rate = Annotated[float, typer.Option(min=0.001, max=1000, help="How much faster than it was recorded.")]
Fps = Annotated[float | None, typer.Option(min=0.001, max=1000, help="Frames a second, whatever was recorded.")]
Compressed = Annotated[
    bool, typer.Option("--compressed", help="Colour as JPEG (NAME/color/compressed), depth as PNG "
                       "(NAME/depth/compressedDepth).")
]  # fmt: skip
Depth = Annotated[
    DepthEncoding, typer.Option(help="16UC1: whole millimetres (default); 32FC1: metres, compressed up to 10 m.")
]
Loop = Annotated[bool, typer.Option("--loop", help="Begin again at the end, until Ctrl-C.")]
RecordedStamps = Annotated[
    bool, typer.Option("--recorded-stamps", help="Keep the recording's time stamps; default: when a frame is sent.")
]
Wait = Annotated[
    float, typer.Option(metavar="SECONDS", min=0, help="Longest wait until somebody listens; 0: begin at once.")
]


def play(
    sequence: options.SequencePath,
    prefix: Prefix = "camera",
    rate: Rate = 1.0, fps: Fps = None, loop: Loop = False,
    compressed: Compressed = False, depth: Depth = DepthEncoding.whole_millimetres,
    recorded_stamps: RecordedStamps = False, wait: Wait = 60.0,
    middleware: network.Middleware = network.MiddlewareName.zenoh, domain: network.Domain = 0,
    namespace: network.Namespace = "", address: network.Address = "",
    start: options.Start = 0, stop: options.Stop = None, stride: options.Stride = 1,
    scale: options.Scale = None,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    camera: options.OwnCamera = None, intrinsics: options.Intrinsics = None,
    topics: options.Topics = None,
    skip_bad_frames: options.SkipBadFrames = False,
) -> None:  # fmt: skip
    """Publish a recording into topics of ROS 2, as a camera would."""
    from ggslam.jobs.play.camera_topics import TopicForm
    from ggslam.jobs.play.play import PlayRequest
    from ggslam.jobs.play.play import play as play_recording
    from ggslam.runs.recordings import SequenceRequest

    reading = SequenceRequest(
        sequence, format_name, start, stop, stride, scale, depth_scale=depth_scale, camera=camera,
        intrinsics=intrinsics, topics=tuple(topics or ()), on_bad_frame="skip" if skip_bad_frames else "error",
    )  # fmt: skip
    request = PlayRequest(
        reading, network.node_request(middleware, domain, namespace, address),
        TopicForm(prefix, compressed, depth is DepthEncoding.metres), rate, fps, loop, recorded_stamps, wait or None,
    )  # fmt: skip
    with progress_bar() as bar:
        played = play_recording(request, ProgressObserver(bar))
    console.print(played.text(), highlight=False, markup=False)
    played.stopped.raise_if_any()
