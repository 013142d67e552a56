# SPDX-License-Identifier: Apache-2.0
"""`ggslam export`: a run's map in other forms."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ggslam.cli import options
from ggslam.cli.console import console, progress_bar
from ggslam.cli.old_names import Command
from ggslam.jobs.export.up_axis import UpAxis
from ggslam.volumes.output_frame import OutputFrame

EPILOG = """
[bold]Examples[/]

  ggslam export runs/kitchen --out kitchen.ply

  ggslam export runs/kitchen --out kitchen.glb

  ggslam export runs/kitchen --format gltf --out kitchen_splats.glb

  ggslam export runs/kitchen --zoom 4 --out kitchen.sog

  ggslam export runs/kitchen --up y --out kitchen.ply

  ggslam export runs/kitchen --out kitchen.usdz

  ggslam export statue.sog --out statue.spz

  ggslam export kitchen.grid --format streamed-sog --out kitchen_web/

  ggslam export runs/kitchen --objects mug,7 --out objects/

  ggslam export runs/kitchen --movers --out movers/

  ggslam export runs/kitchen --format segmented --out kitchen_objects.ply

  ggslam export runs/kitchen --format points --voxel 0.005 --out clouds/

  ggslam export runs/kitchen --format nerfstudio --out kitchen_nerfstudio/
"""


class ExportCommand(Command):
    """Its help names the formats, whose table loads torch: only when somebody asks for help."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._words: dict[str | None, str] = {}

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Shows the help."""
        self.name_formats()
        super().format_help(ctx, formatter)

    def name_formats(self) -> None:
        """Puts names, endings and meanings of the formats into the help of the options."""
        from ggslam.formats.table import endings, names_of, readers, writers
        from ggslam.formats.writer import Takes

        gaussians = [known for known in writers() if known.takes in (Takes.GAUSSIANS, Takes.OBJECT_COLORS)]
        named = {
            "{endings}": " ".join(endings()),
            "{readers}": ", ".join(known.name for known in readers()),
            "{cells}": names_of([known for known in writers() if known.in_cells]),
            "{folders}": ", ".join(known.name for known in writers() if known.in_cells or not known.endings),
            "{formats}": "; ".join(f"{known.name}: {known.text}" for known in writers()),
            "{by_object}": names_of([known for known in gaussians if known.by_object and known.name != "ply"]),
            "{points}": names_of([known for known in writers() if known.takes is Takes.POINTS]),
            "{views}": names_of([known for known in writers() if known.takes is Takes.VIEWS]),
        }
        for parameter in self.params:
            words = self._words.setdefault(parameter.name, getattr(parameter, "help", None) or "")
            for place, text in named.items():
                words = words.replace(place, text)
            parameter.help = words  # type: ignore[attr-defined]


OutPath = Annotated[
    Path,
    typer.Option(
        help="File to write; its name says the format ({endings}; meta.json and lod-meta.json: SOG and streamed SOG in "
        "their folder). A folder for {folders}, and for several --objects with ply; with mesh, --objects takes either."
    ),
]
FormatName = Annotated[
    str | None, typer.Option("--format", help="{formats}. Default: what the name of --out says.")
]  # fmt: skip
Voxel = Annotated[
    float | None,
    typer.Option(help="Metres between points ({points}, {views}; default 0.01), or the edge of a mesh's "
                 "voxels (default: volumes.tsdf.voxel of the run, 0.02); defaults are larger in large scenes."),
]  # fmt: skip
MinOpacity = Annotated[
    float, typer.Option(help="Leave out fainter Gaussians (not for trajectory, mesh; {points}: with --discs).")
]
Discs = Annotated[
    bool,
    typer.Option("--discs", help="{points}: sample the discs of all Gaussians. Default: the surface that the "
                 "keyframes see, rendered and fused, one point a voxel."),
]  # fmt: skip
Objects = Annotated[
    str | None,
    typer.Option(help="Objects by name or id (mug,7), or all. ply: a file for each (of one, --out may be the "
                 "file); mesh, {by_object}: only these."),
]  # fmt: skip
Movers = Annotated[
    bool,
    typer.Option("--movers", help="Write the points of each thing that moved, in its own frame, as a PLY of its own "
                 "into the folder --out, and movers.json, which tells where it was."),
]  # fmt: skip
Plain = Annotated[bool, typer.Option("--plain", help="Write only the fields of 3DGS: no object ids, no identities.")]
Keyframes = Annotated[
    bool, typer.Option("--keyframes", help="{views}: write only keyframes and held-out frames.")
]
Rendered = Annotated[
    bool,
    typer.Option("--rendered", help="mesh: fuse depth rendered from the map instead of the recording's. This is the "
                 "default where the recording is gone or the run was edited."),
]  # fmt: skip

Frame = Annotated[
    OutputFrame,
    typer.Option(help="mesh: its frame: map, that of the run; floor: z up, z = 0 on the floor, with a file floor.yaml "
                 "beside it that tells where that is."),
]  # fmt: skip

Zoom = Annotated[
    float,
    typer.Option(help="Formats of Gaussians: how many times larger than the run's images they will be drawn (of a map "
                 "trained at 320x240, 4 for a window of 1280x960; 0.5 for one of 160x120): right at that size, softer "
                 "or fainter at others."),
]  # fmt: skip

Up = Annotated[
    UpAxis | None,
    typer.Option(help="Formats of Gaussians: turn the map so that this axis points up, by its floor: y (most viewers: "
                 "three.js, Unity), z (Blender, ROS), -y (SuperSplat). SPZ, glTF and OpenUSD have y upwards."),
]  # fmt: skip


SourcePath = Annotated[
    Path,
    typer.Argument(metavar="MAP", help="Folder that `ggslam run` wrote; file of Gaussians ({readers}, .ggz); "
                   "for {cells} also a grid store that `ggslam submaps` wrote."),
]  # fmt: skip


def export(
    run: SourcePath,
    out: OutPath,
    asked: FormatName = None,
    voxel: Voxel = None,
    min_opacity: MinOpacity = 0.0,
    objects: Objects = None,
    movers: Movers = False,
    plain: Plain = False,
    discs: Discs = False,
    keyframes: Keyframes = False,
    sequence: options.MovedSequence = None,
    rendered: Rendered = False,
    zoom: Zoom = 1.0,
    frame: Frame = OutputFrame.map,
    up: Up = None,
) -> None:
    """Write a run's map, trajectory or images in a format that other programs read."""
    from ggslam.cli.observer import ProgressObserver
    from ggslam.jobs.export.export_run import export_run

    with progress_bar() as bar:
        message = export_run(
            run, out, asked, voxel=voxel, objects=objects, movers=movers, min_opacity=min_opacity, plain=plain,
            discs=discs, keyframes=keyframes, recording=sequence, rendered=rendered, zoom=zoom, frame=frame.value,
            up=up, observer=ProgressObserver(bar),
        )  # fmt: skip
    console.print(message, highlight=False, markup=False)
