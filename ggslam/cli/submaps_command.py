# SPDX-License-Identifier: Apache-2.0
"""`ggslam submaps`: a map in cells on disk: make one, add a visit to it, list it."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar, table
from ggslam.cli.observer import ProgressObserver
from ggslam.errors import ConfigError
from ggslam.system.json_files import json_ready
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.jobs.submaps.fill import StoreListing, SubmapsRequest
    from ggslam.submaps.store_objects import ObjectEvent

EPILOG = """
[bold]Examples[/]

  ggslam submaps runs/kitchen --out kitchen.grid --visit monday

  ggslam submaps data/kitchen_again --out kitchen.grid --visit tuesday --poses localized/kitchen_again/trajectory.txt

  ggslam submaps kitchen.grid --since tuesday

  ggslam submaps campus.grid --serve 0.0.0.0:7000 --token SECRET

  ggslam submaps robot1.grid --send server:7000 --token SECRET

  ggslam submaps scans/monday --out campus.grid --set submaps.partial_radius=40
"""


class ListingTuning(Tuning):
    """How much of a store is listed."""

    problems = 5
    """Damaged files."""
    objects = 40
    """Objects."""
    cells = 4
    """Cells of an object."""


_WORDS = {"look": "changed look"}

SourcePath = Annotated[
    Path,
    typer.Argument(metavar="SOURCE", help="A grid store, to list it; with --out: a run, a cloud, or a recording (RGB-D "
                   "or laser scans) with poses."),
]  # fmt: skip

Spacing = Annotated[
    float | None,
    typer.Option(
        help="S: edge of a cell of a new store, metres (default 2, or what suits a LiDAR).", min=1e-3, max=1e6
    ),
]
Axes = Annotated[str | None, typer.Option(help="World axes of a new store's grid: xyz (default), xz or xy.")]
Voxel = Annotated[
    float | None, typer.Option(help="Keep one point in each cube of this edge, metres; 0 keeps all.", min=0)
]
Radius = Annotated[
    float | None,
    typer.Option(
        help="R: record a cell from within this distance of its centre, metres (default 1, or 0.9 S for a LiDAR).",
        min=0,
    ),
]
Refresh = Annotated[
    float | None, typer.Option(help="T: seconds before a cell is recorded again (default 300).", min=0)
]
SensorRange = Annotated[
    float | None,
    typer.Option(help="Leave out points farther than this, metres (default 10, or what suits a LiDAR).", min=1e-3),
]


Serve = Annotated[
    str | None,
    typer.Option(metavar="[HOST:]PORT", help="Take cells over TCP into the grid store SOURCE until Ctrl-C."),
]
Send = Annotated[
    str | None, typer.Option(metavar="HOST:PORT", help="Send cells of the grid store SOURCE to a --serve.")
]
Token = Annotated[
    str | None,
    typer.Option(envvar="GGSLAM_TOKEN", help="Secret of --serve and --send; without one --serve makes one up."),
]


def submaps(
    context: typer.Context,
    source: SourcePath,
    out: Annotated[Path | None, typer.Option(metavar="STORE", help="Grid store to make, or to add a visit to.")] = None,
    visit: Annotated[str | None, typer.Option(help="Name of the visit; default: the source's name.")] = None,
    since: Annotated[str | None, typer.Option(metavar="VISIT", help="List what changed since this visit.")] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Trajectory file in the map's world, instead of the recording's own poses.")
    ] = None,
    at: Annotated[
        float | None, typer.Option(help="Start of this visit, in seconds on a clock that all visits share.")
    ] = None,
    spacing: Spacing = None,
    axes: Axes = None,
    voxel: Voxel = None,
    radius: Radius = None,
    refresh: Refresh = None,
    sensor_range: SensorRange = None,
    start: options.Start = 0,
    stop: options.Stop = None,
    stride: options.Stride = 1,
    scale: options.Scale = None,
    format_name: options.Format = None,
    depth_scale: options.DepthScale = None,
    camera: options.OwnCamera = None,
    intrinsics: options.Intrinsics = None,
    columns: options.Columns = None,
    body: options.Body = None, body_frame: options.BodyFrame = None,
    overrides: options.Settings = None,
    serve: Serve = None, send: Send = None, token: Token = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what is in the store as JSON.")] = False,
) -> None:  # fmt: skip
    """Make a grid store, add a visit to one, list its cells, parts, visits, objects and what changed, or send it."""
    from ggslam.jobs.submaps.fill import SubmapsRequest, list_store
    from ggslam.jobs.submaps.settings import store_overrides
    from ggslam.runs.recordings import SequenceRequest

    given = {"spacing": spacing, "axes": axes, "voxel": voxel, "radius": radius, "refresh": refresh,
             "sensor_range": sensor_range}  # fmt: skip
    settings = {**store_overrides(overrides), **{name: v for name, v in given.items() if v is not None}}
    if (serve is not None) + (send is not None) + (out is not None) > 1:
        raise ConfigError("--serve, --send, --out: choose one")
    if serve is not None:
        options.refuse_others(context, "--serve", {"source", "serve", "token", "overrides", *given})
        return _serve(source, serve, token, settings)
    if send is not None:
        options.refuse_others(context, "--send", {"source", "send", "token"})
        return _send(source, send, token)
    if out is not None:
        reading = SequenceRequest(
            source, format=format_name, start=start, stop=stop, stride=stride, scale=scale, depth_scale=depth_scale,
            camera=camera, intrinsics=intrinsics,
        )  # fmt: skip
        _make(SubmapsRequest(source, out, visit, poses, at, settings, reading, columns, tuple(body or ()), body_frame))
    listing = list_store(source if out is None else out, since)
    if as_json:
        typer.echo(json.dumps(json_ready(listing.to_dict()), indent=1))
    else:
        _print(listing)


def _serve(path: Path, address: str, token: str | None, settings: Mapping[str, Any]) -> None:
    """Takes cells into a store, which is made if there is none, until Ctrl-C."""
    from ggslam.jobs.submaps.cell_server import CellServer, address_of, listen, shown_address
    from ggslam.jobs.submaps.stores import open_or_create, settings_of_store
    from ggslam.jobs.view.serve import wait_for_interrupt

    def tell(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    secret = secrets.token_hex(8) if token is None else token
    with (
        listen(*address_of(address)) as listener,  # before a store is made
        open_or_create(path, replace(settings_of_store(path), **settings)) as store,
        CellServer(store, listener, secret, tell) as server,
    ):
        at, shown = shown_address(*server.address), "" if token is not None else f" with --token {secret}"
        wait_for_interrupt(lambda: tell(f"{path} takes cells at {at}{shown} (Ctrl-C ends)"))


def _send(path: Path, address: str, token: str | None) -> None:
    from ggslam.jobs.submaps.cell_server import address_of, send_store

    host, port = address_of(address)
    if token is None:
        raise ConfigError("--send needs --token: the server's")
    sent = send_store(path, host, port, token)
    console.print(
        f"{quantity(sent.written, 'cell')} written, {sent.kept} of the server's kept, {sent.bytes / 1e6:.1f} MB",
        highlight=False,
    )


def _make(request: SubmapsRequest) -> None:
    from ggslam.jobs.changes.store_visits import add_run
    from ggslam.jobs.submaps.fill import make_store
    from ggslam.jobs.submaps.settings import StoreSettings
    from ggslam.submaps.settings import SubmapSettings
    from ggslam.system.settings import tuning_note

    with progress_bar() as bar:
        observer = ProgressObserver(bar)
        if note := tuning_note(StoreSettings(SubmapSettings(**request.settings))):
            observer.note(note)
        make_store(request, observer, partial(add_run, observer=observer))


def _print(listing: StoreListing) -> None:
    s = listing.settings
    console.print(
        f"{listing.path}: {quantity(listing.cells, 'cell')} of {s.spacing:g} m along {s.axes}, "
        f"{listing.bytes / 1e6:.1f} MB; "
        f"R {s.radius:g} m, T {s.refresh:g} s, R' {s.partial_radius:g} m, voxels {100 * s.voxel:g} cm", highlight=False,
        markup=False,
    )  # fmt: skip
    rows = [[name, str(p.cells), str(p.count), f"{p.bytes / 1e6:.2f} MB"] for name, p in listing.parts.items()]
    console.print(table("parts", ["", "cells", "things", "size"], rows))
    if listing.visits:
        rows = [[v.name, str(v.added), str(v.refreshed)] for v in listing.visits]
        console.print(table("visits", ["", "cells added", "cells refreshed"], rows))
    if listing.changes is not None:
        rows = [
            [str(c.key), "yes" if c.added else "", "-" if c.changed is None else f"{100 * c.changed:.1f} %"]
            for c in listing.changes
        ]
        console.print(table(f"{quantity(len(rows), 'cell')} since {listing.since}", ["cell", "new", "changed"], rows))
    _print_objects(listing)
    for problem in listing.problems[:ListingTuning.problems]:
        console.print(problem, highlight=False, markup=False, soft_wrap=True)
    if len(listing.problems) > ListingTuning.problems:
        console.print(f"and {len(listing.problems) - ListingTuning.problems} more files like these", highlight=False)


def _print_objects(listing: StoreListing) -> None:
    if listing.events is not None:
        title = f"{quantity(len(listing.events), 'object')} since {listing.since}"
        rows = [_event_row(event) for event in listing.events]
        console.print(table(title, ["", "object", "moved", "turned", "cells"], rows))
    elif listing.objects is not None:
        present = listing.objects.present()
        title = f"{quantity(len(present), 'object')}, {len(listing.objects.objects) - len(present)} gone"
        rows = [
            [o.label(), str(o.gaussians), str(len(o.cells)), o.first_seen, o.last_seen]
            for o in present[: ListingTuning.objects]
        ]
        console.print(table(title, ["object", "Gaussians", "cells", "first seen", "last seen"], rows))
        if len(present) > ListingTuning.objects:
            console.print(f"and {len(present) - ListingTuning.objects} more objects", highlight=False)
    if listing.unknown:
        names = ", ".join(listing.unknown)
        text = f"no record of objects: {names}" if listing.objects is not None else "no record of objects"
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def _event_row(event: ObjectEvent) -> list[str]:
    motion, cells = event.motion(), " ".join(str(key) for key in event.cells[:ListingTuning.cells])
    if len(event.cells) > ListingTuning.cells:
        cells += f" and {len(event.cells) - ListingTuning.cells} more"
    moved = "" if motion is None else f"{100 * motion[0]:.1f} cm"
    turned = "" if motion is None else f"{motion[1]:.1f} deg" if event.turn_known else "not known"
    return [_WORDS.get(event.kind, event.kind), event.label(), moved, turned, cells]
