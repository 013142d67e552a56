# SPDX-License-Identifier: Apache-2.0
"""Things and meshes as entities of foxglove.SceneUpdate."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ggslam.messages.contents import Mesh, Thing
from ggslam.messages.foxglove_package import color, foxglove_messages, pose, timestamp, vector
from ggslam.messages.protobuf_rows import COLOR_FIELDS, POINT_FIELDS, double_rows, field, packed_uint32
from ggslam.messages.sound_content import plain_text
from ggslam.messages.thing_looks import ThingTuning, arrow_pose, label, label_place, speed


def scene_message(entities: Iterable[bytes], gone: Iterable[str] = (), after: float = 0.0) -> bytes:
    """foxglove.SceneUpdate: entities, and the ids of those that are gone; these are deleted if they are older than
    `after`."""
    kinds = foxglove_messages()
    when = timestamp(after)
    matching = kinds.SceneEntityDeletionType.MatchingId
    deletions = [kinds.SceneEntityDeletion(timestamp=when, type=matching, id=name) for name in gone]
    return bytes(kinds.SceneUpdate(deletions=deletions).encode()) + b"".join(field(2, entity) for entity in entities)


def thing_entity(
    frame: str, thing: Thing, stamp: float, up: tuple[float, float, float] | None = None
) -> bytes:
    """foxglove.SceneEntity: a box, its name, and an arrow if it moves."""
    kinds = foxglove_messages()
    place = np.eye(4)
    place[:3, 3] = label_place(thing, up)
    text = kinds.TextPrimitive(
        pose=pose(place), billboard=True, font_size=ThingTuning.text_m, color=color((255, 255, 255)), text=label(thing)
    )
    box = kinds.CubePrimitive(
        pose=pose(thing.T), size=vector(thing.size), color=color(thing.rgb, ThingTuning.box_alpha)
    )
    facts = {"name": thing.name, "score": f"{thing.score:g}", "note": thing.note}
    if thing.velocity is not None:
        facts["velocity"] = " ".join(f"{value:g}" for value in thing.velocity)
    entity = kinds.SceneEntity(
        timestamp=timestamp(stamp), frame_id=plain_text(frame), id=str(thing.id),
        metadata=[kinds.KeyValuePair(key=key, value=plain_text(value)) for key, value in facts.items()],
        cubes=[box], texts=[text], arrows=_arrows(thing),
    )  # fmt: skip
    return bytes(entity.encode())


def _arrows(thing: Thing) -> list[object]:
    if not speed(thing):
        return []
    long, thick = speed(thing) * ThingTuning.arrow_s, ThingTuning.arrow_m
    head = min(long / 2, 2 * thick)
    arrow = foxglove_messages().ArrowPrimitive(
        pose=pose(arrow_pose(thing)), shaft_length=long - head, shaft_diameter=thick, head_length=head,
        head_diameter=2 * thick, color=color(thing.rgb),
    )  # fmt: skip
    return [arrow]


def mesh_id(mesh: Mesh) -> str:
    """The id of a part's entity."""
    return plain_text(mesh.part) or "mesh"


def mesh_entity(mesh: Mesh, stamp: float) -> bytes:
    """foxglove.SceneEntity of a part of a mesh: one list of triangles, with vertices and indices."""
    kinds = foxglove_messages()
    gray = round(ThingTuning.gray * 255)
    head = kinds.TriangleListPrimitive(pose=pose(np.eye(4)), color=color((gray, gray, gray)))
    parts = [bytes(head.encode()), double_rows(2, mesh.vertices, POINT_FIELDS)]
    if mesh.rgb is not None:
        rgba = np.column_stack([mesh.rgb / 255, np.ones(len(mesh.rgb))])
        parts.append(double_rows(4, rgba, COLOR_FIELDS))
    parts.append(packed_uint32(5, mesh.triangles.reshape(-1)))
    entity = kinds.SceneEntity(timestamp=timestamp(stamp), frame_id=plain_text(mesh.frame), id=mesh_id(mesh))
    return bytes(entity.encode()) + field(12, b"".join(parts))
