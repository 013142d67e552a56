# SPDX-License-Identifier: Apache-2.0
"""Editing any Gaussians of a map, whatever objects they belong to: remove, keep, move, recolour, assign to an object.

Every function changes the map it is given and returns what it did, as those of `editing` do for whole objects. The
table of objects is made anew; an object of which nothing is left is gone.
"""

from __future__ import annotations

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.objects.editing import (
    Change,
    EditingTuning,
    Vector,
    checked_name,
    enrol,
    forget,
    free_id,
    names_of,
    no_gaussians,
    number_text,
    opacity_centroid,
    rebuild_table,
    rename_object,
    rigid_motion,
)
from ggslam.objects.encoding import assign
from ggslam.objects.recoloring import recolor
from ggslam.objects.segmented_map import ObjectVotes, SegmentedMap
from ggslam.objects.segmented_rows import copies_of, keep_rows
from ggslam.objects.table import ObjectTable
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.plurals import quantity


def scene_without_objects(gaussians: GaussianMap) -> SegmentedMap:
    """A map as one of which nothing belongs to an object."""
    classifier = IdentityClassifier.empty(gaussians.feature_channels)
    return SegmentedMap(gaussians, classifier, ObjectTable("masks", len(gaussians)))


def remove_gaussians(scene: SegmentedMap, rows: np.ndarray) -> Change:
    """Removes Gaussians (bool [N]). What they hid is not closed: nobody said that a thing was there.

    Raises:
        ConfigError: none, or all of the map.
    """
    count = _check_rows(rows)
    if count == len(rows):
        raise ConfigError("all of the map is selected; nothing would be left")
    before = copies_of(scene.gaussians, rows)
    keep_rows(scene, ~rows)
    _forget_empty(scene)
    return Change(f"removed {quantity(count, 'selected Gaussian')}", before, no_gaussians(scene))


def keep_gaussians(scene: SegmentedMap, rows: np.ndarray) -> Change:
    """Removes everything but some Gaussians (bool [N]).

    Raises:
        ConfigError: none is selected.
    """
    count = _check_rows(rows)
    before = copies_of(scene.gaussians, ~rows)
    keep_rows(scene, rows)
    _forget_empty(scene)
    text = f"kept {quantity(count, 'selected Gaussian')}, {len(before.means)} removed"
    return Change(text, before, no_gaussians(scene))


def move_gaussians(
    scene: SegmentedMap, rows: np.ndarray, shift: Vector, rotate_degrees: Vector = (0.0, 0.0, 0.0)
) -> Change:
    """Moves Gaussians (bool [N]) rigidly.

    Args:
        scene: the map.
        rows: which.
        shift: metres along the world's axes.
        rotate_degrees: about lines through their centroid along the world's x, then y, then z axis, before the shift.

    Raises:
        ConfigError: none is selected, or farther than `EditingTuning.max_distance_m`.
    """
    count = _check_rows(rows)
    before = copies_of(scene.gaussians, rows)
    centre = opacity_centroid(before)
    if not np.abs(centre + shift).max() <= EditingTuning.max_distance_m:
        raise ConfigError(f"moved by {number_text(shift)} m: it would be over {EditingTuning.max_distance_m:g} m away")
    scene.gaussians.move(torch.from_numpy(rows), torch.from_numpy(rigid_motion(centre, shift, rotate_degrees)))
    rebuild_table(scene)
    touched = tuple(int(i) for i in np.unique(scene.gaussians.object_id.numpy()[rows]) if i)
    text = f"moved {quantity(count, 'selected Gaussian')} by {number_text(shift)} m"
    text += f", turned by {number_text(rotate_degrees)} degrees" if any(rotate_degrees) else ""
    return Change(text, before, copies_of(scene.gaussians, rows), made=touched)  # no recording shows them there


def recolor_gaussians(scene: SegmentedMap, rows: np.ndarray, color: tuple[int, int, int]) -> Change:
    """Gives Gaussians (bool [N]) a mean colour (0 to 255); see `recoloring.recolor`.

    Raises:
        ConfigError: none is selected.
    """
    count = _check_rows(rows)
    before = copies_of(scene.gaussians, rows)
    recolor(scene.gaussians, rows, color)
    code = "".join(f"{value:02x}" for value in color)
    text = f"recoloured {quantity(count, 'selected Gaussian')} to #{code}"
    return Change(text, before, copies_of(scene.gaussians, rows))


def assign_gaussians(scene: SegmentedMap, rows: np.ndarray, object_id: int | None, name: str = "") -> Change:
    """Gives Gaussians (bool [N]) to an object, a new one, or none.

    Args:
        scene: the map.
        rows: which.
        object_id: of the object; 0: none; None: a new one.
        name: of a new object; "": it has none.

    Raises:
        ConfigError: none is selected, no such object, a name that cannot be, or no id is left.
    """
    count, g = _check_rows(rows), scene.gaussians
    sources, new = set(np.unique(g.object_id.numpy()[rows]).tolist()), object_id is None
    if object_id is None:
        name = checked_name(scene.table, name) if name.strip() else ""
        object_id = free_id({*scene.table.ids(), *scene.classifier.class_ids.tolist()})
        enrol(scene, rows, object_id)
    elif object_id:
        scene.table.record(object_id)
        sources.add(object_id)
        assign(g, scene.classifier, rows, object_id)
    else:
        g.object_id[torch.from_numpy(rows)] = 0
        g.features[torch.from_numpy(rows)] = 0
    if scene.votes is not None:  # or labelling by votes would take the edit back
        ids, weights = scene.votes.ids.copy(), scene.votes.weights.copy()
        ids[rows] = 0
        ids[rows, 0] = object_id
        weights[rows, 0] = np.maximum(weights[rows].sum(1), 1.0) if object_id else 0
        weights[rows, 1:] = 0
        scene.votes = ObjectVotes(ids, weights)
    _forget_empty(scene)
    if new and name:
        rename_object(scene, object_id, name)
    whose = scene.table.record(object_id).label() if object_id else "no object"
    nothing = no_gaussians(scene)
    belong = "belongs" if count == 1 else "belong"
    text = f"{quantity(count, 'selected Gaussian')} {belong} to {whose}"
    return Change(text, nothing, nothing, assigned=(object_id, tuple(sorted(sources))))


def _check_rows(rows: np.ndarray) -> int:
    count = int(rows.sum())
    if not count:
        raise ConfigError("nothing is selected")
    return count


def _forget_empty(scene: SegmentedMap) -> None:
    """Makes the table anew; objects without Gaussians go, from the classifier and the votes, too."""
    left = set(np.unique(scene.gaussians.object_id.numpy()).tolist())
    gone = [i for i in scene.table.ids() if i not in left]
    names = {i: name for i, name in names_of(scene.table).items() if i in left}
    if gone:
        forget(scene, gone)
    rebuild_table(scene, names)
