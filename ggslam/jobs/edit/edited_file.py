# SPDX-License-Identifier: Apache-2.0
"""Edits of a file of Gaussians: of its objects, if Gaussians have object ids, or of the whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.formats.positions import PositionTuning, coordinate_step
from ggslam.formats.splat_formats import write_splats
from ggslam.formats.table import splat_writer
from ggslam.jobs.edit.edit import Edit
from ggslam.objects.editing import Change, rigid_motion
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.splat_editing import scene_without_objects
from ggslam.runs.map_file import MapFile
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.atomic import make_folder
from ggslam.system.plurals import quantity

WHOLE = "all"
"""What the whole of a file without objects is called."""


def edit_file(
    source: MapFile, edits: Sequence[Edit], out: Path | None, overwrite: bool,
    apply: Callable[[SegmentedMap, Edit], Change], vector: Callable[[str, str], tuple[float, float, float]],
) -> tuple[Path, list[str]]:  # fmt: skip
    """Writes the edited map; returns where, and the edits as sentences.

    Args:
        source: the file.
        edits: what to do. Without object ids, only "move" of "all" is an edit.
        out: file to write, whose name says the format; None: `NAME-edited` beside the file.
        overwrite: replace a file that is there.
        apply: does an edit to a map with objects.
        vector: reads three numbers; the first argument names them.

    Raises:
        ConfigError: unknown objects, values that cannot be read, or a file that is there already.
        FormatError, MissingDependency, RunFolderError: it cannot be written.
    """
    target = out or edited_name(source.path)
    splat_writer(target)
    if target.exists() and (not overwrite or target.samefile(source.path)):
        raise ConfigError(f"{target}: is there already; use `overwrite` or another `out`")
    names: dict[int, str] | None = None
    if source.has_objects() or any(edit.selection or edit.kind == "assign" for edit in edits):
        has_objects = source.has_objects()
        scene = source.segmented_map() if has_objects else scene_without_objects(source.gaussians())
        texts = [
            _edit_whole(source.path, scene.gaussians, edit, vector) if _is_whole(edit) else apply(scene, edit).text
            for edit in edits
        ]
        gaussians, names = scene.gaussians, {record.id: record.name or "" for record in scene.table.objects}
    else:
        gaussians = source.gaussians()
        texts = [_edit_whole(source.path, gaussians, edit, vector) for edit in edits]
    if not len(gaussians):
        raise ConfigError(f"{target}: nothing is left to write")
    make_folder(target.parent)
    write_splats(target, gaussians, names)
    return target, texts


def _is_whole(edit: Edit) -> bool:
    """Whether an edit moves everything: what has no object, too."""
    return edit.kind == "move" and edit.objects.strip().casefold() == WHOLE


def _edit_whole(
    path: Path, gaussians: GaussianMap, edit: Edit, vector: Callable[[str, str], tuple[float, float, float]]
) -> str:
    if not _is_whole(edit):
        raise ConfigError(
            f"{path}: its Gaussians have no object ids, so that it can only be moved as a whole: `move` {WHOLE}, "
            f"found `{edit.kind}` {edit.objects}"
        )
    shift = vector("move", edit.value)
    turn = vector("rotation", edit.rotation) if edit.rotation else (0.0, 0.0, 0.0)
    middle = gaussians.means.double().mean(0).numpy()
    step = coordinate_step(float(np.abs(middle + shift).max()))
    if step > PositionTuning.coarse_m:
        raise ConfigError(
            f"`move` {WHOLE} {_text(shift)}: Gaussians are in single precision, which has steps of {step:.3g} m there; "
            "large offsets belong to the program that shows the map"
        )
    gaussians.move(torch.arange(len(gaussians)), torch.from_numpy(rigid_motion(middle, shift, turn)))
    turned = f", turned by {_text(turn)} degrees" if np.any(turn) else ""
    return f"moved all by {_text(shift)} m{turned}: {quantity(len(gaussians), 'Gaussian')}"


def _text(values: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def edited_name(path: Path) -> Path:
    """What an edited file is called: NAME-edited with the same ending; of what cannot be written again a PLY."""
    name = path.name
    for ending in (".compressed.ply", path.suffix):
        if name.lower().endswith(ending.lower()) and ending:
            target = path.with_name(f"{name[: -len(ending)]}-edited{ending}")
            try:
                splat_writer(target)
            except ConfigError:
                return target.with_suffix(".ply")
            return target
    return path.with_name(f"{name}-edited.ply")
