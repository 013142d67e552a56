# SPDX-License-Identifier: Apache-2.0
"""`ggslam serve`: a finished run for robots and their tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ggslam.cli import network, options
from ggslam.cli.console import console

EPILOG = """
[bold]Examples[/]

  ggslam serve runs/kitchen

  ggslam serve runs/kitchen --publish ros2 --middleware dds --robot 0.4,0.18

  ggslam serve runs/kitchen --publish kitchen.mcap --no-http

  curl 'http://localhost:8090/query_distance?token=TOKEN' -d '{"points": [[0, 0, 1]]}'

[bold]Functions[/] (over HTTP: POST a JSON object to /NAME; GET / lists them; over ROS 2: service ggslam/NAME)

  status, verdicts                            what is published; how good the run is

  save_map        name                        copy the run to a folder NAME beside it

  localize        color, depth                pose of an image (PNG, JPEG) with depth (PNG, 16 bits), both in base64;
  [, depth_scale, camera]                     without camera they are scaled to the run's

  query_distance  points                      metres to the nearest surface, null where nothing is known; frame: map
  [, frame]                                   (default) or floor

  plan            start, goal                 a path of points, or the reason why there is none
  [, frame, robot]

[bold]Frames[/] map: the run's own (first camera: x right, y down, z forward); floor: z up; odom; camera: x forward;
camera_optical: z forward, its pose in map is trajectory.txt's.
"""

RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `ggslam run` wrote.")]
Publish = Annotated[
    str | None,
    typer.Option(metavar="LIST", help="Where to publish: foxglove[:PORT], ros2, http[:PORT], FILE.mcap, with commas. "
                 "Default: foxglove, if it is installed."),
]  # fmt: skip
FoxglovePort = Annotated[
    int, typer.Option(help="Port that Foxglove connects to; 0 takes any free one.", min=0, max=65535)
]
HttpPort = Annotated[
    int, typer.Option(help="Port to answer questions at; 0 takes any free one.", min=0, max=65535)
]
Robots = Annotated[
    list[str] | None,
    typer.Option("--robot", metavar="[NAME:]HEIGHT,RADIUS[,STEP]", help="Also publish a grid of what this robot meets, "
                 "metres; repeatable."),
]  # fmt: skip
Changes = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="What `ggslam changes RUN NEWER --out FOLDER` wrote, to publish, too."),
]


def serve(
    run: RunPath,
    publish: Publish = None,
    http: Annotated[
        bool | None,
        typer.Option("--http/--no-http", help="Answer questions over HTTP; default: unless all goes into files."),
    ] = None,
    host: options.Host = "127.0.0.1",
    port: HttpPort = 8090,
    foxglove_port: FoxglovePort = 8765,
    middleware: network.Middleware = network.MiddlewareName.zenoh,
    domain: network.Domain = 0,
    namespace: network.Namespace = "",
    address: network.Address = "",
    robot: Robots = None,
    changes: Changes = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file of --publish that is there.")] = False,
) -> None:
    """Publish a finished run to Foxglove, ROS 2 or an MCAP file, and answer what robots ask of it."""
    from ggslam.jobs.serve.outlets import Places, PublishRequest, parse_places
    from ggslam.jobs.serve.serving import ServeRequest, serve_map
    from ggslam.jobs.view.serve import wait_for_interrupt
    from ggslam.runs.folder import RunFolder

    places = Places(("foxglove",)) if publish is None else parse_places(publish)
    node = network.node_request(middleware, domain, namespace, address)
    foxglove = foxglove_port if places.foxglove_port is None else places.foxglove_port
    through = PublishRequest(places.names, host, foxglove, node, overwrite, optional=publish is None)
    answers = not places.only_files if http is None else http
    asked = places.http_port if places.http_port is not None else port if answers else None
    request = ServeRequest(through, host, asked, tuple(robot or ()), changes)
    with serve_map(RunFolder.open(run), request) as serving:
        for line in serving.lines:
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        if asked is None and places.only_files:
            serving.finish_files()
        else:
            wait_for_interrupt(_announce)
        for channel, problem in serving.problems().items():
            console.print(f"note: {channel}: {problem}", highlight=False, markup=False, soft_wrap=True)
        console.print(serving.publisher.line(), highlight=False, markup=False, soft_wrap=True)


def _announce() -> None:
    console.print("Ctrl-C ends", highlight=False, markup=False)
    console.file.flush()  # a log that nobody sees until the end helps nobody
