# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as PLY files in the layout of the reference 3DGS code, which every splat viewer reads.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023. Per vertex, all float32:
`x y z` (metres), `nx ny nz` (zero), `f_dc_0..2` (degree-0 colour coefficients), `f_rest_*` (higher degrees, all of red,
then green, then blue), `opacity` (logit), `scale_0..2` (natural logarithm of metres), `rot_0..3` (quaternion wxyz).
On request, properties that viewers pass over: `object_id` (whole numbers) and `identity_0..F-1`. They are float32, too:
several readers take a file with a property of another type for damaged, or read other numbers than stand in it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ggslam.errors import FormatError, InputError
from ggslam.formats.ply import read_ply, write_ply_parts
from ggslam.formats.splat_columns import MAX_FLOAT_ID
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.given_map import given_map
from ggslam.system.atomic import write_bytes
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

EXTRAS = ("object_id", "identity")
_MEANS, _NORMALS = ["x", "y", "z"], ["nx", "ny", "nz"]
_COLORS = [f"f_dc_{i}" for i in range(3)]
_SCALES, _ROTATIONS = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]


class PlyTuning(Tuning):
    """How a PLY is written."""

    rows_at_once = 1 << 16
    """Rows that are built at a time, so that a large map is not in memory twice."""


_REQUIRED = [*_MEANS, *_COLORS, "opacity", *_SCALES, *_ROTATIONS]


def write_gaussian_ply(
    path: str | Path, gaussians: GaussianMap, extra: Collection[str] = (), comments: Sequence[str] = ()
) -> None:
    """Writes a map, atomically. Quaternions are normalised on the way, since not every viewer does.

    Args:
        path: the file to write.
        gaussians: the map (any device), or a model.
        extra: which additional properties to write, of `EXTRAS`.
        comments: single ASCII lines for the header.

    Raises:
        InputError: an unknown extra, or no map.
        FormatError: an object id above 2^24.
        RunFolderError: the file cannot be written.
    """
    gaussians = given_map(gaussians)
    write_gaussian_parts(path, len(gaussians), [gaussians], gaussians, extra, comments)


def write_gaussian_parts(
    path: str | Path, count: int, parts: Iterable[GaussianMap], like: GaussianMap, extra: Collection[str] = (),
    comments: Sequence[str] = (),
) -> None:  # fmt: skip
    """Writes a map that comes in parts, which need never be in memory all at once.

    Args:
        path, extra, comments: as in `write_gaussian_ply`.
        count: Gaussians of all parts together.
        parts: in the order of the file.
        like: a map with the channels of the parts, empty perhaps.

    Raises:
        InputError: an unknown extra, or another number of Gaussians than `count`.
        FormatError: an object id above 2^24.
        RunFolderError: the file cannot be written.
    """
    unknown = set(extra) - set(EXTRAS)
    if unknown:
        raise InputError(f"unknown extra properties {sorted(unknown)}, expected some of {EXTRAS}")
    empty = GaussianMap(like.sh_degree, like.features.shape[1], with_moments=False)
    rows = (
        _vertices(path, part, extra, slice(begin, min(begin + PlyTuning.rows_at_once, len(part))))
        for part in parts for begin in range(0, len(part), PlyTuning.rows_at_once)
    )  # fmt: skip
    write_ply_parts(path, "vertex", count, rows, _vertices(path, empty, extra).dtype, comments)


def _vertices(
    path: str | Path, gaussians: GaussianMap, extra: Collection[str], rows_of_map: slice = slice(0, 0)
) -> np.ndarray:
    """Rows of a map as they are stored, a structured array [n]."""
    means, sh = gaussians.means[rows_of_map], gaussians.sh[rows_of_map]
    count, rest = len(means), sh.shape[1] - 1
    quaternions = torch.nn.functional.normalize(gaussians.quaternions[rows_of_map], dim=1)
    columns: dict[str, np.ndarray] = {}
    _add(columns, _MEANS, means)
    _add(columns, _NORMALS, torch.zeros(count, 3))
    _add(columns, _COLORS, sh[:, 0])
    channel_major = sh[:, 1:].transpose(1, 2).reshape(count, 3 * rest)
    _add(columns, [f"f_rest_{i}" for i in range(3 * rest)], channel_major)
    _add(columns, ["opacity"], gaussians.opacity_logits[rows_of_map, None])
    _add(columns, _SCALES, gaussians.log_scales[rows_of_map])
    _add(columns, _ROTATIONS, quaternions)
    if "object_id" in extra:
        ids = gaussians.object_id[rows_of_map]
        if count and int(ids.abs().max()) > MAX_FLOAT_ID:
            raise FormatError(f"{path}: object ids are at most {MAX_FLOAT_ID} in a PLY of Gaussians")
        _add(columns, ["object_id"], ids[:, None].float())
    if "identity" in extra:
        _add(columns, [f"identity_{i}" for i in range(gaussians.features.shape[1])], gaussians.features[rows_of_map])
    rows = np.empty(count, [(name, column.dtype.str) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _add(columns: dict[str, np.ndarray], names: Sequence[str], values: torch.Tensor) -> None:
    columns.update(zip(names, values.detach().cpu().numpy().T, strict=True))


def read_gaussian_ply(path: str | Path, device: torch.device | str = "cpu", with_moments: bool = True) -> GaussianMap:
    """Reads a map written here or by other 3DGS software (SH degree 0 to 3, property order free, extras kept).

    Args:
        path: the file.
        device: where the map shall live.
        with_moments: whether the map gets room for the optimizer's moments (to be optimised further).

    Raises:
        FormatError: no PLY file, no Gaussians in it, properties missing, or values that are not finite.
    """
    return gaussians_of_vertices(path, read_ply(path).elements.get("vertex"), device, with_moments)


def object_ids(path: str | Path, vertex: np.ndarray, first: int = 0) -> np.ndarray:
    """The property `object_id`, of whatever type, as int32 [N]; arguments as of `gaussians_of_vertices`.

    Raises:
        FormatError: it is not a whole number of 32 bits.
    """
    stored = vertex["object_id"]
    with np.errstate(invalid="ignore"):
        whole = stored.astype(np.int32)
    if not np.array_equal(whole, stored):
        row = int(np.argmax(whole != stored))
        raise FormatError(f"{path}: 'object_id' of vertex {first + row} is {stored[row]}, expected a whole number")
    return whole


def gaussians_of_vertices(
    path: str | Path, vertex: np.ndarray | None, device: torch.device | str = "cpu", with_moments: bool = True,
    first: int = 0,
) -> GaussianMap:  # fmt: skip
    """The map in the rows of a PLY file, or in some of them (structured array, None: the file has none), of which the
    first has the number `first` in the file; `path`, arguments and errors as in `read_gaussian_ply`."""
    names = (vertex.dtype.names or ()) if vertex is not None else ()
    missing = [name for name in _REQUIRED if name not in names]
    if vertex is None or missing:
        raise FormatError(f"{path} holds no Gaussians: the properties {missing} of 'vertex' are missing")
    # PlayCanvas' compressed layout and others have the names but pack them into integers: refused by `_floats`.
    rest, features = _names_in_order(path, names, "f_rest_"), _names_in_order(path, names, "identity_")
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(len(rest))
    if degree is None:
        raise FormatError(f"{path}: {len(rest)} properties f_rest_*, expected 0, 9, 24 or 45 (SH degree 0 to 3)")
    out = GaussianMap(degree, len(features), torch.device(device), with_moments)
    growth, out.growth = out.growth, 0.0  # at first no more room than for what is there: of small cells many are kept
    out.insert(
        means=_floats(path, first, vertex, _MEANS),
        quaternions=_floats(path, first, vertex, _ROTATIONS),
        log_scales=_floats(path, first, vertex, _SCALES),
        opacity_logits=_floats(path, first, vertex, ["opacity"])[:, 0],
        rgb=torch.zeros(len(vertex), 3),
        features=_floats(path, first, vertex, features),
        object_id=torch.from_numpy(object_ids(path, vertex, first)) if "object_id" in names else None,
    )
    out.sh[:, 0] = _floats(path, first, vertex, _COLORS).to(out.sh)
    channel_major = _floats(path, first, vertex, rest).reshape(len(vertex), 3, len(rest) // 3)
    out.sh[:, 1:] = channel_major.transpose(1, 2).to(out.sh)
    out.growth = growth
    norms = out.quaternions.norm(dim=1)
    if (norms < 1e-6).any():
        raise FormatError(f"{path}: the quaternion of vertex {first + int(norms.argmin())} is zero")
    return out


def _names_in_order(path: str | Path, names: Sequence[str], prefix: str) -> list[str]:
    """The properties prefix0, prefix1, ... in numerical order; there must be no gap."""
    found = [name for name in names if name.startswith(prefix)]
    expected = [f"{prefix}{i}" for i in range(len(found))]
    if set(found) != set(expected):
        raise FormatError(f"{path}: the properties {prefix}* are not numbered 0 to {len(found) - 1}: {sorted(found)}")
    return expected


def _floats(path: str | Path, first: int, vertex: np.ndarray, names: Sequence[str]) -> torch.Tensor:
    """Columns as float32 [N, len(names)], all finite."""
    out = np.empty((len(vertex), len(names)), np.float32)
    for column, name in enumerate(names):
        if vertex.dtype[name].kind != "f":
            raise FormatError(f"{path}: property '{name}' is {vertex.dtype[name]}, expected a floating-point number")
        out[:, column] = vertex[name]
        bad = ~np.isfinite(out[:, column])
        if bad.any():
            row = int(bad.argmax())
            where = f"property '{name}' of vertex {first + row}"
            raise FormatError(f"{path}: {where} is {vertex[name][row]}, expected a number")
    return torch.from_numpy(out)


def _write(path: Path, splats: Splats) -> str:
    """With object ids and identities where the content has them, and the classifier beside the file."""
    identities = ("identity",) if splats.classifier is not None else ()
    extra = () if splats.names is None else ("object_id", *identities)
    write_gaussian_parts(path, splats.count, splats.parts(), splats.like, extra)
    beside = ""
    if splats.classifier is not None:
        classifier = path.with_name(f"{path.stem}_classifier.npz")
        write_bytes(classifier, splats.classifier().to_bytes())
        beside = f" with object ids and identities, and {classifier.name}"
    return f"wrote {path}: {quantity(splats.count, 'Gaussian')}{splats.note or beside}"


WRITER = Writer(
    "ply", (".ply",), Takes.GAUSSIANS, "Gaussians as 3DGS stores them", _write, any_name=True, by_object=True
)
SEGMENTED = replace(
    WRITER, name="segmented", takes=Takes.OBJECT_COLORS, text="the same in the colours of their objects"
)
