# SPDX-License-Identifier: Apache-2.0
"""`ggslam plan`: a path through a map for a robot that drives or flies."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from ggslam.cli.console import console
from ggslam.errors import ConfigError
from ggslam.system.plurals import quantity
from ggslam.volumes.output_frame import OutputFrame

if TYPE_CHECKING:
    from ggslam.driving.planner import PlannedPath

NO_PATH_EXIT_CODE: Final = 3
MOST_METRES: Final = 1e7
"""Largest coordinate of a place."""
EPILOG = """
[bold]Examples[/]

  ggslam plan runs/kitchen --from 0.5 -1 0 --to 2.5 1 0 --frame floor --robot 0.4,0.2 --out path

  ggslam plan runs/kitchen --from 0 0 0 --to 1.5 -0.4 2 --fly --clearance 0.3

  ggslam plan office.bt --from 1 2 0 --to 30 12 0 --unknown

  ggslam plan map.yaml --from 1 2 0 --to 8 3 0
"""

MapPath = Annotated[
    Path,
    typer.Argument(metavar="MAP", help="Folder of `ggslam volumes`, a run or a grid store with volumes, an OctoMap "
                   "(.bt, .ot), or a map of ROS's map_server (.yaml)."),
]  # fmt: skip
From = Annotated[
    tuple[float, float, float], typer.Option("--from", metavar="X Y Z", help="Where the path starts, metres.")
]
To = Annotated[tuple[float, float, float], typer.Option("--to", metavar="X Y Z", help="Where it ends, metres.")]
RobotSize = Annotated[
    str | None,
    typer.Option("--robot", metavar="HEIGHT,RADIUS", help="Size of the robot, metres; a third number is the height "
                 "that it can drive over (default 0.4,0.2,0.05)."),
]  # fmt: skip
Fly = Annotated[bool, typer.Option("--fly", help="Plan in space; otherwise on the floor.")]
Clearance = Annotated[
    float | None,
    typer.Option(min=0, max=50, help="Least distance from the robot's middle to obstacles, metres; default: its "
                 "radius, with --fly that of the ball around it."),
]  # fmt: skip
Unknown = Annotated[bool, typer.Option("--unknown", help="The path may enter what nobody has seen.")]
Margin = Annotated[
    float, typer.Option(min=0, max=20, help="Clearance that a path keeps beyond the least where it can, metres.")
]
Weight = Annotated[
    float, typer.Option(min=0, max=1000, help="Share that a path may be longer than the shortest one for it.")
]
Frame = Annotated[OutputFrame, typer.Option(help="Frame of --from, --to and path.json: map; floor: z up, 0 on it.")]
Out = Annotated[Path | None, typer.Option(help="Folder for path.json and path.png; default: nothing is written.")]


def plan(
    path: MapPath,
    start: From,
    goal: To,
    robot: RobotSize = None,
    fly: Fly = False,
    clearance: Clearance = None,
    unknown: Unknown = False,
    margin: Margin = 0.3,
    weight: Weight = 0.03,
    frame: Frame = OutputFrame.map,
    out: Out = None,
) -> None:
    """Plan a path through a map: short, wide where it can be, smooth; or tell why there is none (exit code 3)."""
    from ggslam.jobs.plan.plan_path import PICTURE, RECORD, plan_path

    _check_place("--from", start)
    _check_place("--to", goal)
    found = plan_path(
        path, start, goal, robot=robot, fly=fly, clearance=clearance, unknown=unknown, margin=margin, weight=weight,
        frame=frame.value, out=out,
    )  # fmt: skip
    _print(found)
    if out is not None:
        console.print(f"wrote {RECORD} and {PICTURE} to {out}", highlight=False, markup=False)
    if not found.is_found:
        raise typer.Exit(NO_PATH_EXIT_CODE)


def _check_place(option: str, place: tuple[float, float, float]) -> None:
    if not all(abs(value) < MOST_METRES for value in place):
        found = " ".join(f"{value:g}" for value in place)
        raise ConfigError(
            f"{option}: expected three numbers of metres within {MOST_METRES / 1e3:,.0f} km, found {found}"
        )


def _print(found: PlannedPath) -> None:
    took = f"{found.milliseconds:.1f} ms, {quantity(found.cells, 'cell')} searched"
    if found.is_found:
        line = (
            f"path of {found.length:.2f} m, {quantity(len(found.points), 'point')}; clearance "
            f"{found.least_clearance:.2f} to {float(found.clearance.max()):.2f} m, {found.asked:.2f} asked ({took})"
        )
    else:
        line = f"no path: {found.reason}" if not str(found.reason).startswith("no way") else str(found.reason)
        line += f" ({took})"
    console.print(line, highlight=False, markup=False, soft_wrap=True)
