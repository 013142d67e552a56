# SPDX-License-Identifier: Apache-2.0
"""More of what fuzz.py reads: states, stores and records, whose sums somebody who means harm would repair.

Their readers get a copy in which checksums and lengths are right again, so that what lies behind them is reached.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=2", "refine_iterations=2"]
FRAMES = 8


class _CutOff(BaseException):
    """Stands for a kill."""


def _copied(path: Path, to: Path) -> Path:
    """A copy of a folder, pipes in it included."""

    def copy(source: str, target: str) -> str:
        if Path(source).is_fifo():
            os.mkfifo(target)
            return target
        return str(shutil.copy2(source, target))

    return Path(shutil.copytree(path, to, copy_function=copy))


# --- checkpoints -----------------------------------------------------------------------------------------------------


def cut_off_runs(folder: Path) -> list[Path]:
    """Runs that were killed after a checkpoint, beside their recording."""
    from ggslam.jobs.progress import SilentObserver
    from ggslam.jobs.run.pipeline import RunRequest, execute
    from ggslam.runs.recordings import SequenceRequest
    from ggslam.synthetic.writer import write_synthetic_sequence

    class Killer(SilentObserver):
        def frame(self, report: Any) -> None:
            if report.frame.frame_index == FRAMES - 3:
                raise _CutOff

    write_synthetic_sequence(folder / "room", frames=FRAMES, width=64, height=48)
    request = RunRequest(SequenceRequest(folder / "room"), folder / "cut", overrides=FEW, checkpoint_every=2,
                         evaluate=False)  # fmt: skip
    with suppress(_CutOff):
        execute(request, Killer())
    for path in (folder / "cut").iterdir():
        if path.name != "checkpoints":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return [folder / "cut"]


def read_checkpoint(path: Path) -> Any:
    """Goes on with a run: every fourth input to its end, the others for a frame, which takes a tenth of the time."""
    from ggslam.jobs.progress import SilentObserver
    from ggslam.jobs.run.pipeline import resume

    class Killer(SilentObserver):
        def frame(self, report: Any) -> None:
            raise _CutOff

    with tempfile.TemporaryDirectory() as name:
        run = _copied(path, Path(name) / "run")
        repair_checkpoints(run / "checkpoints")
        whole = zlib.crc32(str(path).encode()) % 4 == 0
        with suppress(_CutOff):
            return len(resume(run, SilentObserver() if whole else Killer()).result.frames)
        return None


def repair_checkpoints(folder: Path) -> None:
    """Sums and lengths of states, and what they say of the files of kept arrays, made right."""
    sizes = {}
    for path in sorted(folder.glob("kept-*.bin")):
        data = repaired_array_file(path.read_bytes()) if path.is_file() else b""
        if len(data) > 4:
            path.write_bytes(data)
            sizes[int(path.stem[5:])] = [len(data), struct.unpack("<I", data[-4:])[0]]
    for path in sorted(folder.glob("state-*.bin")):
        if path.is_file():
            path.write_bytes(repaired_array_file(path.read_bytes(), sizes))


def repaired_array_file(data: bytes, sizes: dict[int, list[int]] | None = None) -> bytes:
    """An array file (`system.array_file`) whose length and sum are right; as it is if it is too damaged for that."""
    start = data.find(b"{", 8)
    try:
        header, length = json.JSONDecoder().raw_decode(data[start:].decode("latin-1"))
    except (ValueError, RecursionError):
        return data
    said_length = struct.unpack("<Q", data[start - 8 : start])[0]
    arrays = data[start + (said_length if length <= said_length <= length + 64 else length) : -4]
    with suppress(Exception):
        for kept in header["values"]["kept"]:
            kept[1:] = (sizes or {})[kept[0]]
    said = json.dumps(header, separators=(",", ":")).encode()
    said += b" " * (-len(said) % 64)
    body = data[: start - 8] + struct.pack("<Q", len(said)) + said + arrays
    return body + struct.pack("<I", zlib.crc32(body))


# --- stores ----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _filled_store() -> Path:
    """A store of a small run, with a visit, objects and places; kept for all makers."""
    from typer.testing import CliRunner

    from ggslam.cli.main import app  # the command is what fills stores whole

    place = Path(tempfile.mkdtemp(prefix="ggslam-fuzz-"))
    for words in (
        ["synth", place / "room", "--frames", FRAMES, "--width", 96, "--height", 72],
        ["run", place / "room", "--out", place / "run", "--no-eval", *(w for s in FEW for w in ("--set", s))],
        ["submaps", place / "run", "--out", place / "store"],
        ["encode", place / "store", place / "cells.ggc"],
    ):
        ended = CliRunner().invoke(app, [str(word) for word in words])
        if ended.exit_code:
            raise RuntimeError(f"{words}: {ended.output}")
    return place


def stores(folder: Path) -> list[Path]:
    """A store."""
    return [Path(shutil.copytree(_filled_store() / "store", folder / "store"))]


def read_store(path: Path) -> Any:
    """All of a store, as listing, changing and looking places up read it."""
    from ggslam.jobs.submaps.fill import list_store
    from ggslam.submaps.grid import GridStore
    from ggslam.submaps.store_objects import read_objects

    repair_store(path)
    listed = list_store(path)
    with GridStore.open(path) as store:
        for key in store.cells():
            _read_cell(store, key)
        read_objects(store)
    return listed


def _read_cell(store: Any, key: Any) -> None:
    from ggslam.errors import FormatError
    from ggslam.localization.surface import load_surface

    for name in store.cell(key).parts:
        store.get(key, name)
    with suppress(KeyError, FormatError):
        load_surface(store, key)


def repair_store(path: Path) -> None:
    """Sizes and sums of all parts as the index says them, made right."""
    with suppress(Exception), closing(sqlite3.connect(path / "index.sqlite")) as connection:
        rows = connection.execute("SELECT x, y, z, name, version FROM parts").fetchall()
        for *key, name, version in rows:
            data = (path / "cells" / "_".join(map(str, key)) / str(version) / name).read_bytes()
            said = (len(data), zlib.crc32(data), *key, name)
            connection.execute("UPDATE parts SET bytes=?, crc=? WHERE x=? AND y=? AND z=? AND name=?", said)
        connection.commit()


def index_scripts(folder: Path) -> list[Path]:
    """The index of a store as the SQL that makes it: what changes there makes whole indices of other content."""
    connection = sqlite3.connect(_filled_store() / "store" / "index.sqlite")
    lines = [line for line in connection.iterdump() if "sqlite_" not in line]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    connection.close()
    ids = [f"PRAGMA application_id={application};", f"PRAGMA user_version={version};"]
    (folder / "index.sql").write_text("\n".join([*ids, *lines]))
    return [folder / "index.sql"]


def read_index_script(path: Path) -> Any:
    """A store whose index such a script made."""
    with tempfile.TemporaryDirectory() as name:
        store = Path(name) / "store"
        shutil.copytree(_filled_store() / "store", store)
        for old in store.glob("index.sqlite*"):
            old.unlink()
        connection = sqlite3.connect(store / "index.sqlite", isolation_level=None)
        connection.set_authorizer(lambda action, *_: sqlite3.SQLITE_DENY if action == 24 else sqlite3.SQLITE_OK)
        for line in path.read_bytes().decode("latin-1").split(";\n"):
            with suppress(sqlite3.Error, sqlite3.Warning, ValueError):
                connection.execute(line)
        connection.close()
        return read_store(store)


def part_files(name: str) -> Callable[[Path], list[Path]]:
    """Maker of the parts of this name of a store's cells."""

    def make(folder: Path) -> list[Path]:
        found = sorted((_filled_store() / "store" / "cells").glob(f"*/*/{name}"))[:3]
        return [Path(shutil.copyfile(path, folder / f"{k}-{name}")) for k, path in enumerate(found)]

    return make


def read_part(name: str, use: Callable[[Any, Any], Any]) -> Callable[[Path], Any]:
    """Reader of a part: it is put into a store of its own and used."""

    def read(path: Path) -> Any:
        from ggslam.submaps.grid import GridStore, SubmapSettings

        folder = tempfile.TemporaryDirectory()
        with folder, GridStore.create(Path(folder.name) / "store", SubmapSettings()) as store:
            store.put((0, 0, 0), {name: path.read_bytes()})
            return use(store, (0, 0, 0))

    return read


def use_places(store: Any, key: Any) -> Any:
    """Looks a view up among the places of a store."""
    from ggslam.localization.places import StoredPlaces, stored_views
    from ggslam.scene.camera import Camera

    camera = _camera_of_store(Camera)
    places = StoredPlaces(store, camera)
    views = stored_views(store, key, camera)
    return [places.query(view.place, 3) for view in views[:2]]


@lru_cache(maxsize=1)
def _camera_of_store(kind: Any) -> Any:
    from ggslam.runs.folder import RunFolder

    return RunFolder.open(_filled_store() / "run").sequence().camera


def use_surface(store: Any, key: Any) -> Any:
    """The target that a scan is aligned to."""
    from ggslam.localization.surface import SCAN_TARGET, SurfaceLoader
    from ggslam.native.loader import NativeContext

    return SurfaceLoader(SCAN_TARGET, NativeContext(1))(store, key)


def use_gaussians(store: Any, key: Any) -> Any:
    """The Gaussians of a cell."""
    from ggslam.jobs.submaps.cell_gaussians import gaussians_of_cell

    return gaussians_of_cell(store, key)


def coded_cells(folder: Path) -> list[Path]:
    """A file of coded cells."""
    return [Path(shutil.copyfile(_filled_store() / "cells.ggc", folder / "cells.ggc"))]


def read_coded_cells(path: Path) -> Any:
    """Decodes it into a store."""
    from ggslam.jobs.encode.coded_cells import decode_store

    with tempfile.TemporaryDirectory() as name:
        repaired = Path(name) / path.name
        repair_members(path, repaired, "cells.json", ("cells", "files"))
        return decode_store(repaired, Path(name) / "store")


def repair_members(path: Path, out: Path, head_name: str, groups: tuple[str, ...]) -> None:
    """Sizes and sums of the members of an archive as its head says them, made right."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        head = json.loads(members[head_name])
        for group in groups:
            for name, said in head[group].items():
                if name in members:
                    said.update(bytes=len(members[name]), sha256=hashlib.sha256(members[name]).hexdigest())
    except Exception:  # too damaged for that
        out.write_bytes(path.read_bytes())
        return
    members[head_name] = json.dumps(head).encode()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def visit_files(folder: Path) -> list[Path]:
    """What a store remembers of a visit."""
    found = sorted((_filled_store() / "store" / "visits").glob("*.json"))
    return [Path(shutil.copyfile(path, folder / path.name)) for path in found]


def read_visit_file(path: Path) -> Any:
    """The visit, its settings and cameras."""
    from ggslam.runs.records.visit import VisitRecord

    visit = VisitRecord.parse(path.read_bytes(), str(path))
    visit.settings()
    return [visit.camera_of(keyframe) for keyframe in visit.keyframes]


def store_objects(folder: Path) -> list[Path]:
    """The objects that a store knows."""
    return [Path(shutil.copyfile(_filled_store() / "store" / "objects.json", folder / "objects.json"))]


def read_store_objects(path: Path) -> Any:
    """Objects and events."""
    from ggslam.submaps.store_objects import parse_objects

    found = parse_objects(path.read_bytes(), str(path))
    return [event.motion() for visit in found.visits for event in visit.events], found.present()


# --- records of runs -------------------------------------------------------------------------------------------------

_POSE = np.eye(4).tolist()
_BOX = {"center": [0.0, 0, 1], "axes": np.eye(3).tolist(), "size": [1.0, 1, 1]}
_SIDE = {"ids": [3], "not_there": 0.5}
RECORDS: dict[str, Any] = {
    "changes.json": {
        "old": "a", "new": "b", "unseen": [{"name": "mug", "ids": [1]}],
        "changes": [
            {"kind": "moved", "name": "mug", "confidence": 0.9, "old": _SIDE, "new": _SIDE, "T_new_old": _POSE,
             "turn_known": True, "moved_m": 0.3, "turned_deg": 4.0, "picture": "change_00.png"},
            {"kind": "added", "name": "box", "confidence": 0.5, "new": _SIDE},
        ],
    },
    "movers.json": {"movers": [{
        "id": 1, "name": "cup", "instance": 4, "kind": "rigid", "found": 3, "moves": [[2, 5]],
        "frames": [{"frame": 3, "T_world_mover": _POSE, "box_min": [0, 0, 0], "box_max": [1, 1, 1], "share": 0.5}],
        "displacement": {"T_new_old": _POSE, "distance_m": 0.4, "turn_deg": 2.0},
    }]},
    "loops.json": {
        "seconds": 1.5, "lost": [{"first": 3, "frames": 2, "seconds": 0.1, "after": 5}],
        "events": [{"kind": "closed", "frame": 9, "keyframe": 4, "old_keyframe": 1, "moved_m": 0.02}],
    },
}  # fmt: skip


def records(folder: Path) -> list[Path]:
    """Records that only some runs have, each in a folder."""
    for name, content in RECORDS.items():
        place = folder / Path(name).stem
        place.mkdir()
        (place / name).write_text(json.dumps(content))
    return sorted(folder.iterdir())


def read_record(path: Path) -> Any:
    """What commands do with them."""
    from ggslam.jobs.changes.saved_changes import motion_words, read_changes, sentence_of
    from ggslam.runs.records.loops import LoopsRecord
    from ggslam.runs.records.movers import MoversRecord

    if path.name == "changes":
        shown = read_changes(path)
        return [(sentence_of(change), motion_words(change)) for change in shown.record.changes]
    if path.name == "movers":
        return [(mover.title, mover.way()) for mover in MoversRecord.read(path).movers]
    return LoopsRecord.read(path).notes()


def mover_points(folder: Path) -> list[Path]:
    """Points of movers."""
    arrays = {
        "ids": np.array([1, 4], np.int32), "offsets": np.array([0, 3, 7], np.int64),
        "points": np.zeros((7, 3), np.float32), "colors": np.zeros((7, 3), np.uint8),
    }  # fmt: skip
    np.savez(folder / "mover_points.npz", **arrays)
    return [folder / "mover_points.npz"]


def read_mover_points(path: Path) -> Any:
    """Points of movers."""
    from ggslam.movers.point_files import points_from_arrays
    from ggslam.scene.arrays import read_all_arrays

    return points_from_arrays(read_all_arrays(path, "points of movers"))


def verified_runs(folder: Path) -> list[Path]:
    """Runs with a manifest, and with a saving that was interrupted."""
    run = Path(shutil.copytree(_filled_store() / "run", folder / "run"))
    half = Path(shutil.copytree(run, folder / "half"))
    staged = half / ".staged-999999-0123abcd"
    staged.mkdir()
    shutil.copyfile(half / "run.json", staged / "run.json")
    mark = json.loads((half / "run.json").read_text())
    mark["saving"] = {"from": staged.name, "stale": ["report.html"]}
    (half / "run.json").write_text(json.dumps(mark))
    return [run, half]


def read_verified(path: Path) -> Any:
    """What `ggslam verify` says."""
    from ggslam.runs.verification import verify_run

    with tempfile.TemporaryDirectory() as name:
        return verify_run(_copied(path, Path(name) / "run")).lines()


def whole_runs(folder: Path) -> list[Path]:
    """A run with objects."""
    return [Path(shutil.copytree(_filled_store() / "run", folder / "run"))]


def read_more_of_run(path: Path) -> Any:
    """What reports, views and exports ask a run for."""
    from ggslam.jobs.report.gather import load_run
    from ggslam.runs.folder import RunFolder

    folder = RunFolder.open(path)
    return folder.votes(), folder.object_table(), folder.classifier(), load_run(folder)


# --- volumes, recordings ---------------------------------------------------------------------------------------------


def tsdf_files(folder: Path) -> list[Path]:
    """Signed distances of a wall."""
    from ggslam.scene.camera import Camera
    from ggslam.volumes.settings import TsdfSettings
    from ggslam.volumes.tsdf import TsdfMap
    from ggslam.volumes.tsdf_file import save_tsdf

    tsdf = TsdfMap(TsdfSettings(voxel=0.1))
    tsdf.integrate(np.full((24, 32), 1.5, np.float32), Camera(32, 24, 30.0, 30.0, 15.5, 11.5), np.eye(4))
    save_tsdf(folder / "tsdf.npz", tsdf)
    return [folder / "tsdf.npz"]


def read_tsdf(path: Path) -> Any:
    """Distances, their surface, and the field of distances to it."""
    from ggslam.volumes.mesh import extract_mesh
    from ggslam.volumes.tsdf_file import load_tsdf

    tsdf = load_tsdf(path, frozen=False)
    tsdf.decay()
    return len(extract_mesh(tsdf).vertices)


def rig_files(folder: Path) -> list[Path]:
    """A rig's description alone."""
    import yaml

    cameras = [{"name": name, "recording": name, "T_rig_camera": np.eye(4).reshape(-1).tolist(), "time_offset": 0.1}
               for name in ("front", "back")]  # fmt: skip
    (folder / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras, "tolerance": 0.05}))
    return [folder / "rig.yaml"]


def read_rig(path: Path) -> Any:
    """The cameras of a rig."""
    from ggslam.sequences.rig_file import read_rig_file

    return read_rig_file(path)


def urdf_files(folder: Path) -> list[Path]:
    """A robot of three links."""
    solids = ('<box size="0.6 0.4 0.2"/>', '<cylinder radius="0.02" length="0.5"/>', '<sphere radius="0.1"/>')
    links = [
        f'<link name="l{k}"><collision><origin xyz="0 0 {k}" rpy="0 1 0"/><geometry>{solid}</geometry></collision>'
        for k, solid in enumerate(solids)
    ]
    links = [f"{link}</link>" for link in links]
    joints = [
        f'<joint name="j{k}" type="fixed"><parent link="l{k - 1}"/><child link="l{k}"/><origin xyz="1 0 0"/></joint>'
        for k in (1, 2)
    ]
    (folder / "robot.urdf").write_text("\n".join(['<?xml version="1.0"?>', "<robot>", *links, *joints, "</robot>"]))
    return [folder / "robot.urdf"]


def read_urdf_file(path: Path) -> Any:
    """Its shapes, and what they hide."""
    from ggslam.driving.body import Body
    from ggslam.driving.urdf import read_urdf

    return Body(read_urdf(path, "l0")).hides(np.eye(3))


def id_tables(folder: Path) -> list[Path]:
    """Ids of masks as DEVA lists them, beside the masks."""
    import cv2

    (folder / "masks").mkdir()
    cv2.imwrite(str(folder / "masks" / "000000.png"), np.full((12, 16, 3), (3, 2, 1), np.uint8))
    said = {"annotations": [{"file_name": "000000.jpg", "segments_info": [{"id": 66051}, {"id": 7}]}]}
    (folder / "masks" / "pred.json").write_text(json.dumps(said))
    return [folder / "masks"]


def read_id_table(path: Path) -> Any:
    """Codes of a folder of masks."""
    from ggslam.sequences.mask_ids import read_id_table as read

    return read(sorted(path.glob("*.png")) or [path / "000000.png"])


def videos(folder: Path) -> list[Path]:
    """The boxes of a video whose edit list hides its first frame (ISO/IEC 14496-12)."""

    def box(kind: bytes, *inside: bytes) -> bytes:
        content = b"".join(inside)
        return struct.pack(">I4s", 8 + len(content), kind) + content

    edits = box(b"edts", box(b"elst", struct.pack(">IIIiI", 0, 1, 4000, 1000, 1 << 16)))
    head = box(b"mdhd", struct.pack(">IIIIIHH", 0, 0, 0, 30000, 5000, 0, 0))
    kind = box(b"hdlr", struct.pack(">II4s", 0, 0, b"vide") + bytes(13))
    table = box(b"stbl", box(b"stts", struct.pack(">IIII", 0, 1, 5, 1000)),
                box(b"ctts", struct.pack(">IIII", 0, 1, 5, 0)))  # fmt: skip
    movie = box(b"moov", box(b"trak", edits, box(b"mdia", head, kind, box(b"minf", table))))
    (folder / "a.mp4").write_bytes(box(b"ftyp", b"isom" + bytes(4)) + movie)
    return [folder / "a.mp4"]


def read_edit_list(path: Path) -> Any:
    """Frames that are hidden."""
    from ggslam.sequences.edit_list import count_hidden_frames

    return count_hidden_frames(path)
