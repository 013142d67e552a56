# SPDX-License-Identifier: Apache-2.0
"""Files and runs to G-PCC streams and back: what `ggslam encode`, `decode` and `inspect` do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ggslam.coding import (
    CodecSettings,
    CodingReport,
    PointCloud,
    decode_box,
    decode_cloud,
    decode_slice,
    encode_cloud,
)
from ggslam.coding.block_encoder import encode_blocks
from ggslam.coding.decoder import CloudInParts, decode_in_parts
from ggslam.coding.listing import StreamListing, list_units
from ggslam.coding.outliers import reach_of
from ggslam.coding.splats import (
    gaussians_of,
    is_splat_cloud,
    means_of,
    rest_range,
    splat_attributes,
    splat_reach,
    splat_settings,
)
from ggslam.coding.study import GridCloud, on_grid
from ggslam.errors import ConfigError, FormatError, NotAStreamError
from ggslam.formats.gaussian_ply import write_gaussian_parts
from ggslam.formats.gaussian_rows import GaussianRows
from ggslam.formats.point_cloud import ColoredCloud, read_point_cloud, write_point_cloud
from ggslam.formats.splat_formats import open_splats, splat_format
from ggslam.formats.voxel_cloud import join_clouds
from ggslam.jobs.encode.attributes import attributes_to_code, restored_attributes
from ggslam.jobs.encode.stream_output import check_stream_output
from ggslam.runs.folder import MARKER, RunFolder
from ggslam.runs.map_file import open_map
from ggslam.runs.opened_points import opened_points
from ggslam.system.atomic import make_folder, write_bytes
from ggslam.system.untrusted_files import read_untrusted

PRESETS = ("pointcloud", "splat")
_RUN_FILES = {"pointcloud": "points.ply", "splat": "map.ply"}
"""What is coded of a run."""
Box = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest corner, metres."""


@dataclass(frozen=True)
class Encoded:
    """A written stream: what became of the cloud, and what the reader should know."""

    path: Path
    report: CodingReport
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Decoded:
    """A written cloud or map."""

    path: Path
    count: int
    what: str


def encode_file(
    source: Path,
    out: Path,
    settings: CodecSettings,
    preset: str = "pointcloud",
    rate: str = "r03",
    ids: bool = True,
) -> Encoded:
    """Codes a cloud or a Gaussian map.

    Args:
        source: a PLY or PCD file, a file of Gaussians (see `formats.splat_formats`), or a run folder: its points.ply
            (pointcloud) or map.ply (splat).
        out: the stream to write.
        settings: every choice of the codec; the preset adds what is coded and how.
        preset: "pointcloud": positions, colours, reflectance, and ids lossless; "splat": whole Gaussians of a 3DGS PLY.
        rate: of the splat preset, r01 to r04.
        ids: whether ids (whole numbers beside position, colour and reflectance) are coded at all.

    Raises:
        FormatError: the input is damaged or has nothing to code.
        ConfigError: impossible settings, or `out` is there and no stream, or would lie in a run's folder.
        RunFolderError: the output cannot be written, or the folder is not a run.
    """
    path = _input_file(source, preset)
    _refuse_itself(path, out)
    check_stream_output(out, [source])
    return _encode(path, out, settings, preset, rate, ids, own=path != source)


def encode_saved_run(
    run: Path, out: Path, settings: CodecSettings, preset: str = "pointcloud", rate: str = "r03", ids: bool = True
) -> Encoded:
    """`encode_file` of a run's folder that is saved but not complete yet, as before it is scored."""
    return _encode(run / _RUN_FILES[preset], out, settings, preset, rate, ids, own=True)


def _encode(
    path: Path, out: Path, settings: CodecSettings, preset: str, rate: str, ids: bool, own: bool
) -> Encoded:  # fmt: skip
    """Codes a file; `own`: it is a run's."""
    notes: list[str] = []
    try:
        if preset == "splat":
            report = _encode_splats(path, out, settings, rate, ids, notes, own)
        else:
            report = _encode_points(path, out, settings, ids, notes)
    except (ConfigError, FormatError) as error:
        raise (error if str(path) in str(error) else type(error)(f"{path}: {error}")) from None
    return Encoded(out, report, notes)


def _encode_points(path: Path, out: Path, settings: CodecSettings, ids: bool, notes: list[str]) -> CodingReport:
    is_cloud = splat_format(path) is None or path.suffix.lower() == ".ply"
    cloud = read_point_cloud(path, tell=False) if is_cloud else _points_of(path)  # the notes tell it
    coded = attributes_to_code(cloud, ids)
    points, settings = coded_points(cloud, settings)
    reach = reach_of([points], settings)
    kept = reach.keep(points)
    notes += coded.notes + reach.notes("point")
    own = {**settings.attributes, **coded.settings}
    settings = replace(reach.settings, attributes=own, metadata=coded.metadata)
    encoded = encode_cloud(points[kept], {name: values[kept] for name, values in coded.values.items()}, settings)
    make_folder(out.parent)
    write_bytes(out, encoded.data)
    return encoded.report


def _points_of(path: Path) -> ColoredCloud:
    """The points of Gaussians, sampled as a run's are."""
    sampled = join_clouds(opened_points(open_map(path)))
    if not len(sampled):
        raise FormatError(f"{path}: its Gaussians are too faint for points; `preset` splat codes them whole")
    return ColoredCloud(
        sampled.points, sampled.colors, grid=sampled.grid, voxel_size=sampled.voxel_size, origin=sampled.origin
    )


def _encode_splats(
    path: Path, out: Path, settings: CodecSettings, rate: str, ids: bool, notes: list[str], own: bool
) -> CodingReport:
    """Codes Gaussians; those of a 3DGS PLY need not fit into memory. `own`: they are a run's, of which none is bad."""
    if own:
        rows = GaussianRows(path)
    else:
        opened = open_splats(path)
        rows = opened.rows
        notes += opened.notes
    if not len(rows):
        raise FormatError(f"{path}: no Gaussians")
    with_ids = ids and any(bool(block.object_id.any()) for block in rows.blocks())
    rest = rest_range(rows.blocks())
    settings = splat_settings(settings, rate, splat_attributes(rows.like, with_ids), rest)
    reach = splat_reach(rows.blocks, len(rows), settings, rate)

    def blocks() -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        for block in rows.blocks():
            points, attributes = means_of(block), splat_attributes(block, with_ids, rest=rest)
            kept = reach.keep(points)
            yield points[kept], {name: values[kept] for name, values in attributes.items()}

    make_folder(out.parent)
    report = encode_blocks(blocks(), reach.settings, out)
    notes += reach.notes("Gaussian")
    return report


def study_cloud(source: Path, settings: CodecSettings) -> GridCloud:
    """The cloud of a file or run on its grid, for sweeps.

    Raises:
        FormatError: the input is damaged or has no colours.
    """
    path = _input_file(source, "pointcloud")
    cloud = read_point_cloud(path)
    if cloud.colors is None:
        raise FormatError(f"{path}: no colours, which a sweep needs")
    if cloud.voxel_size is not None:  # in metres, as the pictures and tables are
        settings = replace(settings, voxel_size=settings.voxel_size or cloud.voxel_size)
        return on_grid(cloud.points, cloud.colors, settings)
    points, settings = coded_points(cloud, settings)
    reach = reach_of([points], settings)
    kept = reach.keep(points)
    return on_grid(points[kept], cloud.colors[kept], reach.settings)


def decode_file(
    source: Path, out: Path, slice_id: int | None = None, box: Box | None = None, threads: int | None = None
) -> Decoded:
    """Decodes a stream, or one slice or box of it, into a PLY (or PCD) file; a stream of Gaussians into a 3DGS PLY.

    Raises:
        FormatError: the stream is damaged, uses a tool that is not supported, has no such slice, or no point in the
            box.
        ConfigError: both a slice and a box are asked for.
        RunFolderError: the output cannot be written.
    """
    if slice_id is not None and box is not None:
        raise ConfigError("choose a slice or a box, not both")
    if out.suffix.lower() not in (".ply", ".pcd"):
        raise ConfigError(f"{out}: expected a name that ends in .ply or .pcd")
    _refuse_itself(source, out)
    data = read_untrusted(source)
    try:
        if slice_id is None and box is None and (splats := _splats_in_parts(data, threads)) is not None:
            return _write_splats(splats, out)
        cloud = _decode_part(data, slice_id, box, threads)
        if is_splat_cloud(cloud):
            if not len(cloud):
                raise FormatError("no Gaussians in the box")
            return _write_splats(CloudInParts(len(cloud), cloud, iter([cloud])), out)
        if not len(cloud):
            raise FormatError("no points in the box")
        attributes = restored_attributes(cloud)
    except FormatError as error:
        raise FormatError(f"{source}: {error}") from None
    make_folder(out.parent)
    points, comments = _place(cloud)
    write_point_cloud(out, points, attributes, comments if out.suffix.lower() != ".pcd" else ())
    return Decoded(out, len(cloud), "points")


def _splats_in_parts(data: bytes, threads: int | None) -> CloudInParts | None:
    """The Gaussians of a stream; None if it is one of points."""
    cloud = decode_in_parts(data, threads)
    return cloud if is_splat_cloud(cloud.like) else None


def _write_splats(cloud: CloudInParts, out: Path) -> Decoded:
    """Writes Gaussians as they are decoded."""
    like = gaussians_of(cloud.like)
    if out.suffix.lower() != ".ply":
        raise ConfigError(f"{out}: Gaussians are written as .ply")
    make_folder(out.parent)
    extra = ("object_id",) if "object_id" in cloud.like.attributes else ()
    write_gaussian_parts(out, cloud.count, map(gaussians_of, cloud.parts), like, extra)
    return Decoded(out, cloud.count, "Gaussians")


def list_stream(path: Path) -> StreamListing:
    """All units of a stream file.

    Raises:
        FormatError: the file cannot be read or is no G-PCC stream at all.
    """
    listing = list_units(read_untrusted(path))
    if not listing.units:
        reason = listing.problems[0] if listing.problems else "it is empty"
        raise NotAStreamError(path, f"not a G-PCC stream: {reason}")
    return listing


def _input_file(source: Path, preset: str) -> Path:
    if preset not in PRESETS:
        raise ConfigError(f"preset: expected one of {', '.join(PRESETS)}, found '{preset}'")
    if not source.is_dir() or (not (source / MARKER).is_file() and splat_format(source) is not None):
        return source
    return RunFolder.open(source).path / _RUN_FILES[preset]


def coded_points(cloud: ColoredCloud, settings: CodecSettings) -> tuple[np.ndarray, CodecSettings]:
    """Positions as the encoder shall see them, and the settings that fit them.

    Clouds on a grid are coded as whole voxels, so that lossless geometry gives back exactly their points: those that
    ggslam voxelised (the stream tells where the grid lies), and those whose coordinates are whole numbers, as of the
    usual test clouds. Others are metres; the settings choose their voxels. So do they where they name a voxel size.
    """
    if settings.box is None and settings.voxel_size in (None, cloud.voxel_size):
        if cloud.grid is not None and cloud.voxel_size is not None and cloud.origin is not None:
            corner, shift = _corner(cloud.origin, cloud.voxel_size)
            return cloud.grid + corner, replace(settings, voxel_size=None, unit=cloud.voxel_size, shift=shift)
        small = settings.voxel_size is None and np.abs(cloud.points).max() < 1 << 30
        if small and (cloud.points == np.rint(cloud.points)).all():
            return cloud.points.astype(np.int32), settings
    return cloud.points, settings


def _corner(origin: np.ndarray, voxel_size: float) -> tuple[np.ndarray, tuple[float, float, float]]:
    """A grid's origin in whole voxels, int32 [3], and what is left of it in metres."""
    corner = np.rint(origin / voxel_size)
    if np.abs(corner).max() >= 1 << 30:
        corner = np.zeros(3)
    left = origin - corner * voxel_size
    left[np.abs(left) < 1e-6 * voxel_size] = 0
    return corner.astype(np.int32), (float(left[0]), float(left[1]), float(left[2]))


def _decode_part(data: bytes, slice_id: int | None, box: Box | None, threads: int | None) -> PointCloud:
    if slice_id is not None:
        return decode_slice(data, slice_id)
    if box is None:
        return decode_cloud(data, threads)
    return decode_box(data, *box)


def _place(cloud: PointCloud) -> tuple[np.ndarray, list[str]]:
    """Positions to write, and the header comments of a cloud that is on its grid still."""
    quantization = cloud.quantization
    points, voxel_size = cloud.points, quantization.voxel_size
    if not quantization.metres or quantization.centre != 0:
        return _narrow(points, voxel_size), []
    place = " ".join(repr(float(value)) for value in quantization.first)
    return _narrow(points, voxel_size), ["x y z are metres", f"voxel_size {voxel_size!r}", f"origin {place}"]


def _narrow(points: np.ndarray, voxel_size: float) -> np.ndarray:
    """float32 unless that moves a point by more than a hundredth of a voxel."""
    narrow = points.astype(np.float32)
    return narrow if np.abs(points - narrow).max(initial=0) < 0.01 * voxel_size else points


def _refuse_itself(source: Path, out: Path) -> None:
    if source.exists() and out.exists() and out.samefile(source):
        raise ConfigError(f"{out}: is the input itself")

