# SPDX-License-Identifier: Apache-2.0
"""`map.ggz`: a run's map in one file that is small enough to send, with all that another machine needs to merge it.

A zip archive whose members are stored as they are:

    container.json   {"format": "ggslam map", "version": 2, "ggslam": version that wrote it, "gaussians": their number,
                     "rate": of the map, "files": {member: {"bytes", "sha256"}}}
    map.bin          a G-PCC stream of Gaussians (`ggslam decode` reads it), in slices; attribute `birth` is the number
                     of the keyframe that inserted a Gaussian, plus 1, `object_id` its object
    places.bin       places.npz of the run, without `birth`, see `scene.packed_arrays`; in version 1 places.npz
    run.json, keyframes.json, trajectory.txt, config.yaml, sequence.json, timing.json and, where the run has them,
    loops.json, ground_truth.txt, objects.json, classifier.npz, as in the run's folder; those that get smaller
    so as NAME.xz

Votes, clouds, scores and pictures stay behind. Identity vectors become the codes of their objects.
"""

from __future__ import annotations

import hashlib
import io
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ggslam import __version__
from ggslam.coding import CodecSettings, decode_cloud
from ggslam.coding.block_encoder import encode_blocks
from ggslam.coding.splats import (
    BIRTH,
    gaussians_of,
    is_splat_cloud,
    means_of,
    rest_range,
    splat_attributes,
    splat_reach,
    splat_settings,
)
from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.gaussian_rows import GaussianRows
from ggslam.merging.joint_map import with_channels
from ggslam.objects.encoding import code_of
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.publishing import publish_run
from ggslam.runs.records.container import CONTAINER_FORMAT, CONTAINER_VERSION, ContainerRecord
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.movers import MOVER_FILES
from ggslam.runs.records.run_json import FileRecord, RunRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.runs.saving_parts import save_points
from ggslam.runs.writing import RUN_FILES, TRUTH_FILE
from ggslam.scene.arrays import ArrayLimits, arrays_of, arrays_to_bytes, read_all_arrays
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.scene.packed_arrays import pack_arrays, pack_bytes, unpack_arrays, unpack_bytes
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.system.atomic import atomic_write, make_folder, write_bytes
from ggslam.system.hidden_folder import hidden_beside
from ggslam.system.untrusted_files import read_untrusted
from ggslam.system.zip_files import ZIP_DAMAGE, open_zip

SUFFIX = ".ggz"
HEAD, MAP, _PLACES, _XZ = "container.json", "map.bin", "places.bin", ".xz"
_CLASSIFIER, TABLE = "classifier.npz", "objects.json"
_NEEDED = (
    RunRecord.FILE, KeyframesRecord.FILE, "trajectory.txt", "config.yaml", SequenceRecord.FILE, TimingRecord.FILE,
)  # fmt: skip
_PERHAPS = (LoopsRecord.FILE, TRUTH_FILE, *MOVER_FILES, TABLE, _CLASSIFIER)
_MEMBERS = frozenset((HEAD, MAP, _PLACES, PLACES_FILE, *_NEEDED, *_PERHAPS))
_MOST_KEYFRAMES: Final = (1 << 16) - 2
"""Largest number of a keyframe: 16 bits hold it plus 1."""


@dataclass(frozen=True)
class WrittenContainer:
    """A written container.

    Attributes:
        path: the file.
        gaussians: of its map.
        sizes: bytes by member.
        run_bytes: that map.ply and the same files take in the run's folder.
        notes: what the reader should know.
    """

    path: Path
    gaussians: int
    sizes: dict[str, int] = field(default_factory=dict)
    run_bytes: int = 0
    notes: list[str] = field(default_factory=list)


def is_container(path: str | Path) -> bool:
    """Whether a file is called like one."""
    return Path(path).suffix.lower() == SUFFIX


def write_container(folder: RunFolder, out: Path, rate: str, settings: CodecSettings) -> WrittenContainer:
    """Puts a run's map into a file.

    Args:
        folder: the run.
        out: the file.
        rate: quality of the map, r01 to r04.
        settings: slices and threads.

    Raises:
        RunFolderError: the run has no places (it was made without loops, or edited since), or the file cannot be
            written.
        ConfigError: the run has more keyframes than the file can count.
    """
    places_file = folder.path / PLACES_FILE
    if not places_file.is_file():
        raise RunFolderError(f"{places_file}: missing: a run made without loops, or edited since, has no places")
    places = read_all_arrays(places_file, "the places of a run")
    births = places.pop("birth", None)
    rows = GaussianRows(folder.path / "map.ply")
    if births is None or births.shape != (len(rows),) or births.max(initial=0) > _MOST_KEYFRAMES:
        raise RunFolderError(f"{places_file}: not of this map, which has {len(rows)} Gaussians")
    with_objects = folder.has_objects()
    optional = _PERHAPS if with_objects else [name for name in _PERHAPS if name not in (TABLE, _CLASSIFIER)]
    names = [*_NEEDED, *(name for name in optional if (folder.path / name).is_file())]
    make_folder(out.parent)
    with hidden_beside(out) as folder_of_stream:
        make_folder(folder_of_stream)
        stream = folder_of_stream / MAP
        count, notes = _encode_map(rows, births, with_objects, rate, settings, stream)
        members = dict(_smallest(n, read_untrusted(folder.path / n)) for n in names)
        members |= {_PLACES: pack_arrays(places), MAP: read_untrusted(stream)}
        head = ContainerRecord(
            format=CONTAINER_FORMAT, version=CONTAINER_VERSION, ggslam=__version__, gaussians=count, rate=rate,
            files={n: FileRecord(bytes=len(b), sha256=hashlib.sha256(b).hexdigest()) for n, b in members.items()},
        )  # fmt: skip
        with atomic_write(out) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
            for member, content in {HEAD: head.model_dump_json(indent=1).encode(), **members}.items():
                archive.writestr(zipfile.ZipInfo(member), content)
    sizes = {n: len(b) for n, b in members.items()}
    plain = sum((folder.path / n).stat().st_size for n in (*names, PLACES_FILE, "map.ply"))
    return WrittenContainer(out, count, sizes, plain, notes)


def _smallest(name: str, content: bytes) -> tuple[str, bytes]:
    """A member as it is, or as .xz."""
    packed = pack_bytes(content)
    return (name + _XZ, packed) if len(packed) < len(content) else (name, content)


def _encode_map(
    rows: GaussianRows, births: np.ndarray, with_objects: bool, rate: str, settings: CodecSettings, out: Path
) -> tuple[int, list[str]]:
    """Writes the stream; returns how many Gaussians are in it, and what the reader should know."""
    rest = rest_range(rows.blocks())
    chosen = splat_settings(settings, rate, splat_attributes(rows.like, with_objects, births[:0]), rest)
    reach = splat_reach(rows.blocks, len(rows), chosen, rate)

    def blocks() -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        begin = 0
        for block in rows.blocks():
            own = births[begin : begin + len(block)]
            begin += len(block)
            points, attributes = means_of(block), splat_attributes(block, with_objects, own, rest)
            kept = reach.keep(points)
            yield points[kept], {name: values[kept] for name, values in attributes.items()}

    report = encode_blocks(blocks(), reach.settings, out)
    return report.points, reach.notes("Gaussian")


def read_container(path: Path, out: Path, overwrite: bool = False, threads: int | None = None) -> RunFolder:
    """Makes a run folder of a container.

    Args:
        path: the file.
        out: the folder.
        overwrite: replace a run that is there.
        threads: to decode with.

    Raises:
        FormatError: it is none, damaged, or of a later version.
        RunFolderError: the folder cannot be written.
    """
    members = open_container(path).members
    folder = RunFolder.create(out, overwrite)

    def write(staged: Path) -> RunRecord:
        try:
            return _write_run(path, members, staged, threads)
        except (FormatError, RunFolderError) as error:
            if error.exit_code == 2 and f"{out}/" in str(error):  # a member that is not what its name says
                raise FormatError(str(error).replace(f"{out}/", f"{path}: ")) from None
            raise

    try:
        publish_run(folder.path, write, RUN_FILES, f"{out}: the run cannot be written")
    except BaseException:
        folder.discard()
        raise
    return RunFolder.open(out)


def read_contained_map(path: Path) -> tuple[GaussianMap, dict[int, str] | None, KeyframesRecord, SequenceRecord]:
    """The map in a container, without making a run of it: Gaussians, names of objects by id (None: there are no
    objects), and the records of the run's keyframes and recording.

    Raises:
        FormatError: it is none, damaged, or of a later version.
    """
    members = open_container(path).members
    try:
        cloud = decode_cloud(members[MAP], None)
        if not is_splat_cloud(cloud):
            raise FormatError(f"{MAP}: holds no map")
        with tempfile.TemporaryDirectory() as name:
            for member in {KeyframesRecord.FILE, SequenceRecord.FILE, TABLE} & set(members):
                write_bytes(Path(name) / member, members[member])
            keyframes, sequence = KeyframesRecord.read(Path(name)), SequenceRecord.read(Path(name))
            table = ObjectTable.load(Path(name) / TABLE) if TABLE in members else None
    except (FormatError, RunFolderError, ConfigError) as error:
        raise FormatError(f"{path}: {error}") from None
    names = None if table is None else {record.id: record.name or "" for record in table.objects}
    return gaussians_of(cloud), names, keyframes, sequence


@dataclass(frozen=True)
class Container:
    """A container in memory.

    Attributes:
        head: what it says of itself.
        sizes: bytes of the members as they lie in the file.
        members: their content by the names of a run's files, expanded.
    """

    head: ContainerRecord
    sizes: dict[str, int]
    members: dict[str, bytes]


def open_container(path: Path) -> Container:
    """All members of a container, each what the head says of it. They are stored, so none is larger than the file, but
    .xz ones.

    Raises:
        FormatError: it is none, damaged, or of a later version.
    """
    try:
        with open_zip(path) as archive:
            found = archive.infolist()
            names = [info.filename for info in found]
            plain = [n.removesuffix(_XZ) for n in names]
            odd = [n for n in names if n.removesuffix(_XZ) not in _MEMBERS] or [n for n in plain if plain.count(n) > 1]
            if odd or any(info.compress_type != zipfile.ZIP_STORED for info in found):
                raise FormatError(f"{path}: no map of ggslam: holds {odd[0] if odd else 'compressed members'}")
            members = {info.filename: archive.read(info) for info in found}
    except ZIP_DAMAGE as error:
        raise FormatError(f"{path}: no whole container of a map: {error}") from None
    sizes = {name: len(content) for name, content in members.items()}
    head = _head(path, members.pop(HEAD, b""))
    for name, content in members.items():
        told = head.files.get(name)
        if told is None or told.sha256 != hashlib.sha256(content).hexdigest():
            raise FormatError(f"{path}: {name} is damaged: its checksum is not that in {HEAD}")
    left = max(ArrayLimits.max_bytes, ArrayLimits.max_ratio * sum(sizes.values()))
    expanded = dict[str, bytes]()
    for member, content in members.items():
        name, inner = _expand(path, member, content, left)
        left -= len(inner) - len(content)
        expanded[name] = inner
    members = expanded
    for name in (MAP, _PLACES, *_NEEDED):
        if name not in members and not (name == _PLACES and PLACES_FILE in members):
            raise FormatError(f"{path}: holds no {name}")
    return Container(head, sizes, members)


def _expand(path: Path, name: str, content: bytes, left: int) -> tuple[str, bytes]:
    """The name and bytes of a member, of at most `left` bytes."""
    if not name.endswith(_XZ):
        return name, content
    try:
        return name.removesuffix(_XZ), unpack_bytes(content, min(ArrayLimits.max_bytes, left))
    except FormatError as error:
        raise FormatError(f"{path}: {name}: {error}") from None


def _places(path: Path, members: dict[str, bytes]) -> dict[str, np.ndarray]:
    if _PLACES not in members:  # of version 1
        held = io.BytesIO(members[PLACES_FILE])
        return arrays_of(held, f"{path}: {PLACES_FILE}: damaged", lambda found: {n: found[n] for n in found.files})
    try:
        return unpack_arrays(members[_PLACES])
    except FormatError as error:
        raise FormatError(f"{path}: {_PLACES}: {error}") from None


def _head(path: Path, content: bytes) -> ContainerRecord:
    try:
        head = ContainerRecord.parse(content)
    except ValueError as error:
        raise FormatError(f"{path}: {HEAD}: not the head of a map's container: {error}") from None
    if head.version > CONTAINER_VERSION:
        known = f"this ggslam reads up to {CONTAINER_VERSION}: use a newer one"
        raise FormatError(f"{path}: is of version {head.version}; {known}")
    return head


def _write_run(path: Path, members: dict[str, bytes], staged: Path, threads: int | None) -> RunRecord:
    for name in (*_NEEDED, *_PERHAPS):
        if name in members and name != RunRecord.FILE:
            write_bytes(staged / name, members[name])
    try:
        cloud = decode_cloud(members[MAP], threads)
    except (FormatError, ConfigError) as error:
        raise FormatError(f"{path}: {MAP}: {error}") from None
    if not is_splat_cloud(cloud) or BIRTH not in cloud.attributes:
        raise FormatError(f"{path}: {MAP}: holds no map with its keyframes' numbers")
    gaussians, with_objects = gaussians_of(cloud), {_CLASSIFIER, TABLE} <= set(members)
    if with_objects:
        gaussians = _with_codes(gaussians, IdentityClassifier.from_file(staged / _CLASSIFIER))
    write_gaussian_ply(staged / "map.ply", gaussians, ("object_id", "identity") if with_objects else ())
    arrays = _places(path, members)
    births = gaussians.birth_keyframe.numpy().astype(np.int32)
    write_bytes(staged / PLACES_FILE, arrays_to_bytes(**{**arrays, "birth": births}))
    save_points(staged)
    write_bytes(staged / RunRecord.FILE, members[RunRecord.FILE])  # the mark of the new run takes its place
    mark = RunRecord.read(staged)
    lossy = f"coded for sending ({path.name}) and decoded: places and colours are rounded"
    return mark.model_copy(update={"files": None, "missing": [], "edits": [*mark.edits, lossy]})


def _with_codes(gaussians: GaussianMap, classifier: IdentityClassifier) -> GaussianMap:
    """The map with an identity vector for each Gaussian that the classifier reads as its object."""
    out = with_channels(gaussians, gaussians.sh_degree, classifier.weight.shape[1])
    for number in classifier.class_ids.tolist():
        own = out.object_id == number
        if bool(own.any()):
            out.features[own] = torch.from_numpy(code_of(out, classifier, number))
    return out
