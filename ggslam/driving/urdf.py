# SPDX-License-Identifier: Apache-2.0
"""Reads the shape of a robot from a URDF file: boxes, cylinders and spheres on links that fixed joints hold together.

http://wiki.ros.org/urdf/XML. Of a link the collision geometry counts, or the visual one where there is none. Documents
with a DTD, and so with entities, are refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from ggslam.driving.body import BodyShape
from ggslam.errors import FormatError
from ggslam.scene.poses import inverse
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted


class UrdfTuning(Tuning):
    """Limits of a file."""

    max_bytes = 4 << 20
    """Largest file."""
    max_depth = 64
    """Most elements within one another."""
    max_m = 1000.0
    """Largest number of metres."""


class _Refused(Exception):
    """What is wrong with a document."""


def read_urdf(path: str | Path, frame: str) -> tuple[BodyShape, ...]:
    """The shapes of a robot, as its sensor has them.

    Args:
        path: of the file.
        frame: link of the sensor; of a camera the optical one (x right, y down, z forward).

    Raises:
        FormatError: the file cannot be read, or does not describe such a robot; names it and the reason.
    """
    data = read_untrusted(path, UrdfTuning.max_bytes, FormatError)
    try:
        root = _parse(data)
        if root.tag != "robot":
            _refuse(f"expected a <robot>, found a <{root.tag}>")
        places = _places(root)
        if frame not in places:
            _refuse(f"no link {frame!r}; there are {', '.join(sorted(places)[:20])}")
        T_sensor_root = inverse(places[frame])
        links = [(link, T_sensor_root @ places[_name(link)]) for link in root.findall("link")]
        shapes = [shape for link, T_sensor_link in links for shape in _shapes(link, T_sensor_link)]
        if not shapes:
            _refuse("no link has a box, a cylinder or a sphere")
        return tuple(shapes)
    except (_Refused, expat.ExpatError) as error:
        raise FormatError(f"{path}: {error}") from None


def _refuse(reason: str) -> NoReturn:
    raise _Refused(reason)


def _parse(data: bytes) -> Element:
    """The document's root."""
    builder, parser, depth = TreeBuilder(), expat.ParserCreate(), 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > UrdfTuning.max_depth:
            _refuse(f"more than {UrdfTuning.max_depth} elements within one another")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def doctype(*_: object) -> None:
        _refuse("has a DTD, which may define entities: refused")

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = start, end, doctype
    parser.Parse(data, True)
    return builder.close()


def _name(element: Element) -> str:
    name = element.get("name")
    return name if name else _refuse(f"a <{element.tag}> without a name")


def _places(root: Element) -> dict[str, np.ndarray]:
    """T_root_link [4, 4] by link."""
    links = [_name(link) for link in root.findall("link")]
    for name in links:
        if links.count(name) > 1:
            _refuse(f"two links {name!r}")
    joints: dict[str, tuple[str, np.ndarray]] = {}
    for joint in root.findall("joint"):
        name, kind = _name(joint), joint.get("type")
        if kind != "fixed":
            _refuse(
                f"joint {name!r}: expected a fixed one, found {kind!r}: leave out parts that move"
            )
        parent, child = (_link_of(joint, which, links) for which in ("parent", "child"))
        if child in joints:
            _refuse(f"joint {name!r}: link {child!r} has two parents")
        joints[child] = parent, _origin(joint)
    if not links:
        _refuse("has no <link>; of a xacro file make a URDF first")
    tops = [name for name in links if name not in joints]
    if len(tops) != 1:
        _refuse(f"expected one link without a parent, found {len(tops)}: {', '.join(tops[:5])}")
    places = {tops[0]: np.eye(4)}
    while len(places) < len(links):
        new = {child: places[parent] @ T for child, (parent, T) in joints.items() if parent in places}
        if len(new) + 1 == len(places):
            _refuse("joints lead in a circle")
        places |= new
    return places


def _link_of(joint: Element, which: str, links: list[str]) -> str:
    found = joint.find(which)
    link = None if found is None else found.get("link")
    if link not in links:
        _refuse(f"joint {joint.get('name')!r}: no {which} link {link!r}")
    return str(link)


def _origin(element: Element) -> np.ndarray:
    """T [4, 4] of an element's <origin>: rotation about x, y, z in this order, about fixed axes."""
    found, T = element.find("origin"), np.eye(4)
    if found is None:
        return T
    roll, pitch, yaw = _numbers(found, "rpy", 3, "0 0 0")
    (a, b), (c, d), (e, f) = ((math.cos(angle), math.sin(angle)) for angle in (roll, pitch, yaw))
    T[:3, :3] = [
        [e * c, e * d * b - f * a, e * d * a + f * b],
        [f * c, f * d * b + e * a, f * d * a - e * b],
        [-d, c * b, c * a],
    ]
    T[:3, 3] = _numbers(found, "xyz", 3, "0 0 0")
    return T


def _shapes(link: Element, T_sensor_link: np.ndarray) -> Iterator[BodyShape]:
    for part in link.findall("collision") or link.findall("visual"):
        geometry = part.find("geometry")
        solids = [] if geometry is None else list(geometry)
        if len(solids) != 1:
            _refuse(f"link {link.get('name')!r}: expected a <geometry> with one shape")
        kind, half = _solid(solids[0], str(link.get("name")))
        yield BodyShape(kind, half, T_sensor_link @ _origin(part))


def _solid(solid: Element, link: str) -> tuple[Literal["box", "cylinder", "sphere"], tuple[float, float, float]]:
    """Kind and half extents."""
    if solid.tag == "box":
        x, y, z = (_positive(size, link) / 2 for size in _numbers(solid, "size", 3))
        return "box", (x, y, z)
    if solid.tag == "cylinder":
        (radius,), (length,) = _numbers(solid, "radius", 1), _numbers(solid, "length", 1)
        radius = _positive(radius, link)
        return "cylinder", (radius, radius, _positive(length, link) / 2)
    if solid.tag == "sphere":
        radius = _positive(_numbers(solid, "radius", 1)[0], link)
        return "sphere", (radius, radius, radius)
    _refuse(f"link {link!r}: expected a box, a cylinder or a sphere, found a <{solid.tag}>")


def _positive(size: float, link: str) -> float:
    return size if size > 0 else _refuse(f"link {link!r}: expected a size above 0, found {size:g}")


def _numbers(element: Element, attribute: str, count: int, default: str | None = None) -> list[float]:
    text = element.get(attribute, default)
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= UrdfTuning.max_m for value in values):
        found = "none" if text is None else repr(text)
        _refuse(f"<{element.tag}>: {attribute}: expected {quantity(count, 'number')} within {UrdfTuning.max_m:g}, "
                f"found {found}")  # fmt: skip
    return values
