# SPDX-License-Identifier: Apache-2.0
"""What of a content can be told: viewers and robots must not get poses, boxes or triangles that are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.messages.contents import Content, Grid, Mesh, Path, Picture, Pose, Splats, Thing, Things, Transforms
from ggslam.scene.poses import is_valid_pose
from ggslam.system.tuning import Tuning


class TextTuning(Tuning):
    """Texts in messages."""

    longest = 500
    """Characters of a name that are sent; the rest is cut off."""


def plain_text(text: str) -> str:
    """A text that every receiver can read: without NUL, which ends texts in CDR, without halves of characters, and
    not too long."""
    return text[: TextTuning.longest].replace("\0", " ").encode("utf-8", "replace").decode("utf-8")


def sound_content(content: Content) -> Content | None:
    """The content without what cannot be told: poses that are none or not finite and what stands at them, triangles
    with a corner that is not finite; None if nothing can be told. Points may be NaN: clouds have a word for that."""
    if isinstance(content, Transforms):
        edges = tuple(edge for edge in content.edges if is_valid_pose(edge[2]))
        return None if content.edges and not edges else replace(content, edges=edges)
    if isinstance(content, Pose):
        return content if is_valid_pose(content.T) else None
    if isinstance(content, Grid):
        return content if is_valid_pose(content.T_frame_origin) and content.cells.size else None
    if isinstance(content, Picture):
        return content if content.image.size else None
    if isinstance(content, Path):
        good = np.isfinite(content.poses).all((1, 2)) & np.isfinite(content.stamps)
        return content if good.all() else replace(content, poses=content.poses[good], stamps=content.stamps[good])
    if isinstance(content, Things):
        return replace(content, things=tuple(thing for thing in content.things if _is_sound(thing)))
    if isinstance(content, Mesh):
        return _with_finite_triangles(content)
    if isinstance(content, Splats):
        return _with_finite_splats(content)
    return content


def _is_sound(thing: Thing) -> bool:
    size = np.asarray(thing.size, np.float64)
    return is_valid_pose(np.asarray(thing.T, np.float64)) and bool(np.isfinite(size).all() and (size >= 0).all())


def _with_finite_triangles(mesh: Mesh) -> Mesh:
    finite = np.isfinite(mesh.vertices).all(1)
    if finite.all():
        return mesh
    return replace(mesh, triangles=mesh.triangles[finite[mesh.triangles].all(1)])


def _with_finite_splats(splats: Splats) -> Splats:
    columns = (splats.means, splats.scales, splats.quaternions, splats.opacities, splats.sh)
    good = np.logical_and.reduce([np.isfinite(c).all(tuple(range(1, c.ndim))) for c in columns])
    if good.all():
        return splats
    return replace(
        splats, means=splats.means[good], scales=splats.scales[good], quaternions=splats.quaternions[good],
        opacities=splats.opacities[good], sh=splats.sh[good], ids=splats.ids[good],
    )  # fmt: skip
