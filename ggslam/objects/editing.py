# SPDX-License-Identifier: Apache-2.0
"""Editing a segmented map: remove, keep, move, duplicate, recolour, merge and rename objects.

Every function changes the map it is given and returns what it did. Objects are named by ids; `ObjectTable.select` finds
those of names. An unknown id raises ConfigError before anything is changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.errors import ConfigError
from ggslam.objects.encoding import assign, code_of, with_class
from ggslam.objects.membership import MembershipSettings, members
from ggslam.objects.recoloring import recolor
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.segmented_rows import (
    append_copies,
    copies_of,
    join_gaussians,
    keep_rows,
    merged_votes,
    votes_without,
)
from ggslam.objects.table import ObjectTable, Observation
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

Vector = Sequence[float]


class EditingTuning(Tuning):
    """Limits of edits."""

    max_distance_m = 1000.0
    """Largest distance of a moved object from the origin, in metres: clouds sampled from a map count cells in 21 bits.
    """
    max_name_length = 200
    """Most characters of an object's name."""


@dataclass(frozen=True)
class Change:
    """What an edit did.

    Attributes:
        text: for people.
        before: the Gaussians concerned as they were; empty if nothing can be seen of the edit.
        after: as they are now; empty if they are gone.
        left: by object id, those of `before` that left their place, where there may now be a hole.
        motion: rigid transform [4, 4] that the objects of `left` did; None if they are gone.
        made: ids of new objects.
        merged: the id of the object that stays and that of the one that became a part of it.
        assigned: the id of the object that got Gaussians (0: none), and those of the objects, one or none (0), that
            had them before; of an object that there was already, its own, too.
    """

    text: str
    before: GaussianTensors
    after: GaussianTensors
    left: Mapping[int, GaussianTensors] = field(default_factory=dict)
    motion: np.ndarray | None = None
    made: tuple[int, ...] = ()
    merged: tuple[int, int] | None = None
    assigned: tuple[int, tuple[int, ...]] | None = None


def remove_objects(scene: SegmentedMap, ids: Sequence[int]) -> Change:
    """Removes objects with their floaters. Single Gaussians on other objects that carry a removed label take that of
    their neighbours."""
    what = _labels(scene, ids)
    gone = members(scene.gaussians, scene.classifier, list(ids))
    before, left = copies_of(scene.gaussians, gone), _by_object(scene, gone, ids)
    keep_rows(scene, ~gone)
    forget(scene, ids)
    rebuild_table(scene)
    return Change(f"removed {what}: {quantity(int(gone.sum()), 'Gaussian')}", before, no_gaussians(scene), left)


def keep_objects(scene: SegmentedMap, ids: Sequence[int]) -> Change:
    """Removes everything but these objects."""
    what = _labels(scene, ids)
    own = _own_members(scene, ids)
    kept = np.logical_or.reduce(list(own.values()))
    before = copies_of(scene.gaussians, ~kept)
    _claim(scene, own)
    keep_rows(scene, kept)
    forget(scene, [i for i in scene.table.ids() if i not in ids])
    rebuild_table(scene)
    text = f"kept {what}: {quantity(int(kept.sum()), 'Gaussian')}, {len(before.means)} removed"
    return Change(text, before, no_gaussians(scene))


def move_objects(
    scene: SegmentedMap, ids: Sequence[int], shift: Vector, rotate_degrees: Vector = (0.0, 0.0, 0.0)
) -> Change:
    """Moves objects rigidly, as one group.

    Args:
        scene: the map.
        ids: of the objects.
        shift: metres along the world's axes (those of the first camera: x right, y down, z forward).
        rotate_degrees: about lines through the group's centroid along the world's x, then y, then z axis, before the
            shift. Floaters far from the objects stay where they are and lose their label.

    Raises:
        ConfigError: unknown ids, or farther than `EditingTuning.max_distance_m`.
    """
    what = _labels(scene, ids)
    _check_near(scene, "move", ids, shift)
    rows, stray = _claimed_rows(scene, ids)
    before, left = copies_of(scene.gaussians, rows), _by_object(scene, rows, ids)
    T = rigid_motion(opacity_centroid(before), shift, rotate_degrees)
    scene.gaussians.object_id[torch.from_numpy(stray)] = 0
    scene.gaussians.move(torch.from_numpy(rows), torch.from_numpy(T))
    rebuild_table(scene)
    rest = f", {int(stray.sum())} floaters stay unlabelled" if stray.any() else ""
    text = f"moved {what} by {number_text(shift)} m"
    text += f", turned by {number_text(rotate_degrees)} degrees" if any(rotate_degrees) else ""
    text += f": {quantity(int(rows.sum()), 'Gaussian')}{rest}"
    return Change(text, before, copies_of(scene.gaussians, rows), left, motion=T)


def duplicate_objects(scene: SegmentedMap, ids: Sequence[int], shift: Vector | None = None) -> Change:
    """Copies objects to another place. Each copy is an object of its own, with the next free id and its own class.

    Args:
        scene: the map.
        ids: of the objects.
        shift: metres along the world's axes; None: to the right by a little more than the widest of them measures.

    Raises:
        ConfigError: unknown ids, or farther than `EditingTuning.max_distance_m`, or no id is left.
    """
    what = _labels(scene, ids)
    if shift is None:
        boxes = [scene.table.record(i).box for i in ids]
        shift = (round(1.2 * max(float(np.abs(np.array(b.axes)[:, 0]) @ b.size) for b in boxes), 3), 0.0, 0.0)
    _check_near(scene, "duplicate", ids, shift)
    names, T, first = names_of(scene.table), rigid_motion(np.zeros(3), shift), len(scene.gaussians)
    made: list[int] = []
    before: list[GaussianTensors] = []
    for object_id in ids:
        rows, _ = _claimed_rows(scene, [object_id])
        taken = {*scene.table.ids(), *scene.classifier.class_ids.tolist(), *made}
        new_id = free_id(taken)
        before.append(copies_of(scene.gaussians, rows))
        copies = append_copies(scene, rows)
        scene.gaussians.move(torch.from_numpy(copies), torch.from_numpy(T))
        enrol(scene, copies, new_id)
        if object_id in names:
            names[new_id] = f"{names[object_id]} copy"
        made.append(new_id)
    rebuild_table(scene, names)
    after = copies_of(scene.gaussians, np.arange(len(scene.gaussians)) >= first)
    copies_are = ", ".join(scene.table.record(i).label() for i in made)
    text = f"duplicated {what} by {number_text(shift)} m: {copies_are}"
    return Change(text, join_gaussians(before), after, made=tuple(made))


def recolor_objects(scene: SegmentedMap, ids: Sequence[int], color: tuple[int, int, int]) -> Change:
    """Gives objects a mean colour (0 to 255); see `recoloring.recolor`."""
    what = _labels(scene, ids)
    # Floaters are left out: many are faint and wide, and would cast the new colour over what lies behind them.
    rows = np.logical_or.reduce(list(_own_members(scene, ids).values()))
    before = copies_of(scene.gaussians, rows)
    recolor(scene.gaussians, rows, color)
    code = "".join(f"{value:02x}" for value in color)
    text = f"recoloured {what} to #{code}: {quantity(int(rows.sum()), 'Gaussian')}"
    return Change(text, before, copies_of(scene.gaussians, rows))


def merge_objects(scene: SegmentedMap, kept: int, merged: int) -> Change:
    """Makes the object `merged` a part of `kept`: labels, identity vectors, votes and the table.

    Raises:
        ConfigError: unknown ids, or the same twice.
    """
    what = f"{_labels(scene, [merged])} into {_labels(scene, [kept])}"
    if kept == merged:
        raise ConfigError(f"object {kept} cannot be merged with itself")
    rows = scene.gaussians.object_id.numpy() == merged
    names, seen = names_of(scene.table), _observations(scene.table)
    both = [seen[i] for i in (kept, merged) if i in seen]
    if both:
        # Views in which both were seen cannot be told from the table: the larger number is a lower bound.
        seen[kept] = Observation(
            min(o.first_frame for o in both), max(o.last_frame for o in both), max(o.views for o in both)
        )
    scene.classifier = scene.classifier.without([merged])
    assign(scene.gaussians, scene.classifier, rows, kept)
    if scene.votes is not None:
        scene.votes = merged_votes(scene.votes, merged, kept)
    rebuild_table(scene, names, seen)
    nothing = no_gaussians(scene)
    return Change(f"merged {what}: {quantity(int(rows.sum()), 'Gaussian')}", nothing, nothing, merged=(kept, merged))


def rename_object(scene: SegmentedMap, object_id: int, name: str) -> Change:
    """Names an object.

    Raises:
        ConfigError: unknown id; or a name that would be taken for an id or a list, or is "all", empty or another's.
    """
    what, name = _labels(scene, [object_id]), checked_name(scene.table, name, object_id)
    records = [replace(r, name=name) if r.id == object_id else r for r in scene.table.objects]
    scene.table = replace(scene.table, objects=records)
    return Change(f"renamed {what} to {name}", no_gaussians(scene), no_gaussians(scene))


def checked_name(table: ObjectTable, name: str, object_id: int | None = None) -> str:
    """A name that an object (None: a new one) may have, without spaces around it.

    Raises:
        ConfigError: it would be taken for an id or a list, or is "all", empty or another's.
    """
    name = name.strip()
    if len(name) > EditingTuning.max_name_length:
        raise ConfigError(f"name {name[:20]!r}...: {len(name)} characters, at most {EditingTuning.max_name_length}")
    if not name or name.isdecimal() or "," in name or name.casefold() == "all" or not name.isprintable():
        raise ConfigError(f"name {name!r}: expected a printable word that is no number, without commas, and not 'all'")
    taken = [i for i, other in names_of(table).items() if other.casefold() == name.casefold() and i != object_id]
    if taken:
        raise ConfigError(f"name {name!r}: object {taken[0]} has it already")
    return name


def rigid_motion(centre: np.ndarray, shift: Vector, rotate_degrees: Vector = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Transform [4, 4]: turns about axes through `centre` along x, then y, then z, then shifts by `shift` metres."""
    T = np.eye(4)
    for axis, angle in zip(np.eye(3), np.radians(rotate_degrees), strict=True):
        T[:3, :3] = quaternion_to_matrix(np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])) @ T[:3, :3]
    T[:3, 3] = centre - T[:3, :3] @ centre + np.asarray(shift, float)
    return T


# --- who belongs to what --------------------------------------------------------------------------------------------


def _labels(scene: SegmentedMap, ids: Sequence[int]) -> str:
    """Names of objects for people; raises ConfigError for unknown ids."""
    if not ids:
        raise ConfigError("no object is named")
    return ", ".join(scene.table.record(i).label() for i in ids)


def _check_near(scene: SegmentedMap, kind: str, ids: Sequence[int], shift: Vector) -> None:
    for record in map(scene.table.record, ids):
        place = np.add(record.centroid, shift)
        if not np.abs(place).max() <= EditingTuning.max_distance_m:
            raise ConfigError(
                f"--{kind} {record.label()} by {number_text(shift)} m: it would be farther than "
                f"{EditingTuning.max_distance_m:g} m away, "
                "and Gaussians are in single precision; large offsets belong to the program that shows the map"
            )


def _claimed_rows(scene: SegmentedMap, ids: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Members of objects without floaters, labelled as theirs from now on; and the floaters. bool [N] both."""
    own = _own_members(scene, ids)
    _claim(scene, own)
    rows = np.logical_or.reduce(list(own.values()))
    return rows, np.isin(scene.gaussians.object_id.numpy(), ids) & ~rows


def _own_members(scene: SegmentedMap, ids: Sequence[int]) -> dict[int, np.ndarray]:
    """Members of each object without floaters, bool [N] each."""
    return {i: members(scene.gaussians, scene.classifier, [i], MembershipSettings(floaters=False)) for i in ids}


def group_centroid(scene: SegmentedMap, ids: Sequence[int]) -> np.ndarray:
    """About which `move_objects` turns these objects, [3].

    Raises:
        ConfigError: unknown ids, or none.
    """
    _labels(scene, ids)
    return opacity_centroid(copies_of(scene.gaussians, np.logical_or.reduce(list(_own_members(scene, ids).values()))))


def _by_object(scene: SegmentedMap, rows: np.ndarray, ids: Sequence[int]) -> dict[int, GaussianTensors]:
    """The members `rows` (bool [N]) of some objects, each object's own; one of another label is its neighbour's."""
    index = np.flatnonzero(rows)
    owner = scene.gaussians.object_id.numpy()[index].copy()
    other = ~np.isin(owner, ids)
    if other.all():
        owner[:] = ids[0]
    elif other.any():
        means = scene.gaussians.means.numpy()[index]
        owner[other] = owner[~other][cKDTree(means[~other]).query(means[other])[1]]
    parts = {object_id: np.zeros(len(rows), bool) for object_id in ids}
    for object_id, part in parts.items():
        part[index[owner == object_id]] = True
    return {object_id: copies_of(scene.gaussians, part) for object_id, part in parts.items()}


def _claim(scene: SegmentedMap, own: Mapping[int, np.ndarray]) -> None:
    """Labels the members of objects that had another label or none."""
    for object_id, rows in own.items():
        assign(scene.gaussians, scene.classifier, rows & (scene.gaussians.object_id.numpy() != object_id), object_id)


def free_id(taken: Set[int]) -> int:
    """The next id that no object has; raises ConfigError if there is none."""
    highest = max(taken, default=0)
    found = highest + 1 if highest < 65535 else next((i for i in range(1, 65536) if i not in taken), 0)
    if not found:
        raise ConfigError("no object id is left: ids end at 65535")
    return found


def forget(scene: SegmentedMap, ids: Sequence[int]) -> None:
    """Takes objects that are gone from the classifier, the votes and the labels."""
    scene.classifier = scene.classifier.without(list(ids))
    if scene.votes is not None:
        scene.votes = votes_without(scene.votes, ids)
    g, labels = scene.gaussians, scene.gaussians.object_id.numpy()
    stray, others = np.flatnonzero(np.isin(labels, ids)), np.flatnonzero((labels > 0) & ~np.isin(labels, ids))
    if len(stray) and len(others):
        nearest = others[cKDTree(g.means.numpy()[others]).query(g.means.numpy()[stray])[1]]
        g.object_id[torch.from_numpy(stray)] = g.object_id[torch.from_numpy(nearest)]
        g.features[torch.from_numpy(stray)] = g.features[torch.from_numpy(nearest)]
    elif len(stray):
        g.object_id[torch.from_numpy(stray)] = 0


def enrol(scene: SegmentedMap, rows: np.ndarray, object_id: int) -> None:
    """Gives Gaussians (bool [N]) a new object id, a class of it, and identity vectors of that class."""
    g = scene.gaussians
    g.object_id[torch.from_numpy(rows)] = object_id
    if len(scene.classifier) and g.features.shape[1] == scene.classifier.weight.shape[1]:
        scene.classifier = with_class(scene.classifier, object_id, g.features.numpy()[~rows])
        g.features[torch.from_numpy(rows)] = torch.from_numpy(code_of(g, scene.classifier, object_id))
    if scene.votes is not None:
        scene.votes.ids[rows] = 0
        scene.votes.ids[rows, 0] = object_id


# --- small things ---------------------------------------------------------------------------------------------------


def no_gaussians(scene: SegmentedMap) -> GaussianTensors:
    """None of them."""
    return copies_of(scene.gaussians, np.zeros(len(scene.gaussians), bool))


def names_of(table: ObjectTable) -> dict[int, str]:
    """By id, of those that have one."""
    return {record.id: record.name for record in table.objects if record.name}


def _observations(table: ObjectTable) -> dict[int, Observation]:
    return {
        r.id: Observation(r.first_frame, r.last_frame, r.views)
        for r in table.objects
        if r.first_frame is not None and r.last_frame is not None
    }


def rebuild_table(
    scene: SegmentedMap, names: Mapping[int, str] | None = None, seen: Mapping[int, Observation] | None = None
) -> None:
    """Lists the objects anew, with the names and observations of the former table unless others are given."""
    table = ObjectTable.build(
        scene.gaussians, scene.classifier, scene.table.supervision,
        names_of(scene.table) if names is None else names, _observations(scene.table) if seen is None else seen,
    )  # fmt: skip
    scene.table = replace(table, history=scene.table.history)


def opacity_centroid(gaussians: GaussianTensors) -> np.ndarray:
    """The mean of the centres, weighted by opacity, float64 [3]."""
    weights = torch.sigmoid(gaussians.opacity_logits).double()
    return (weights @ gaussians.means.double() / weights.sum()).numpy()


def number_text(values: Vector) -> str:
    """Numbers for people."""
    return " ".join(f"{value:g}" for value in values)
