# SPDX-License-Identifier: Apache-2.0
"""movers.json and the points of movers: written, read back, refused where they are damaged; exported."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.formats.ply import read_ply
from ggslam.jobs.export.export_run import export_run
from ggslam.jobs.report.mover_pictures import draw_movers
from ggslam.movers.mover_table import FoundMover
from ggslam.movers.point_files import POINTS_FILE, points_from_arrays, points_to_arrays
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.movers import MoversRecord
from ggslam.scene.arrays import arrays_to_bytes
from ggslam.scene.camera import Camera


def pose(x: float) -> list[list[float]]:
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, 2.0
    return T.tolist()


def values() -> dict:
    """A mover that goes half a metre to the right."""
    frames = [
        {"frame": n, "T_world_mover": pose(0.1 * n), "box_min": [-0.1] * 3, "box_max": [0.1] * 3, "share": 0.02}
        for n in range(6)
    ]
    mover = {
        "id": 7, "name": "mug", "instance": 7, "kind": "rigid", "found": 2, "moves": [[0, 5]], "frames": frames,
        "before": None, "after": None, "displacement": None,
    }  # fmt: skip
    return {"movers": [mover]}


@pytest.fixture
def busy(room_run: RunFolder, tmp_path: Path) -> RunFolder:
    """A run in which a mug moved."""
    path = tmp_path / "busy"
    shutil.copytree(room_run.path, path)
    (path / MoversRecord.FILE).write_text(json.dumps(values()))
    cloud = np.arange(30, dtype=np.float32).reshape(10, 3) / 100
    mover = FoundMover(7, 7, "rigid", 2, [], points=cloud, colors=np.full((10, 3), 0.5, np.float32))
    (path / POINTS_FILE).write_bytes(arrays_to_bytes(**points_to_arrays([mover])))
    return RunFolder.open(path)


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    MoversRecord.of(values()).write(tmp_path)
    (mover,) = MoversRecord.read(tmp_path).movers
    assert mover.moves == [(0, 5)] and mover.title == "mug" and mover.displacement is None
    np.testing.assert_allclose(mover.way()[:, 0], 0.1 * np.arange(6), atol=1e-9)
    here = mover.frame(3)
    assert here is not None and mover.frame(6) is None
    np.testing.assert_allclose([here.corners().min(0), here.corners().max(0)], [[0.2, -0.1, 1.9], [0.4, 0.1, 2.1]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.pop("kind"), "kind"),
        (lambda m: m.update(kind="soft"), "kind"),
        (lambda m: m["frames"][2].update(T_world_mover=[[1, 0], [0, 1]]), "frames.*4x4"),
        (lambda m: m["frames"][2].update(T_world_mover=[[None] * 4] * 4), "frames.*4x4"),
        (lambda m: m["frames"][0].update(box_min=[0, 1]), "box_min"),
        (lambda m: m["frames"][0].update(box_max=[0, 0, 1e300]), r"box_max.*1e\+06"),
        (lambda m: m["frames"][2].update(T_world_mover=[[1e7] * 4] * 4), r"4x4.*1e\+06"),
        (lambda m: m.update(id=65536), "id"),
        (lambda m: m.update(id=-1), "id"),
        (lambda m: m["frames"][0].update(frame=2**31), "frame"),
    ],
)
def test_a_damaged_record_is_refused_with_its_place(tmp_path: Path, change: object, words: str) -> None:
    told = values()
    change(told["movers"][0])  # type: ignore[operator]
    (tmp_path / MoversRecord.FILE).write_text(json.dumps(told))
    with pytest.raises(RunFolderError, match=words) as caught:
        MoversRecord.read(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / MoversRecord.FILE))


@pytest.mark.parametrize("name", ["ids", "offsets", "points", "colors"])
def test_damaged_points_are_refused(name: str) -> None:
    mover = FoundMover(7, 7, "rigid", 2, [], points=np.zeros((4, 3), np.float32), colors=np.zeros((4, 3), np.float32))
    arrays = points_to_arrays([mover])
    assert points_from_arrays(arrays)[7][0].shape == (4, 3)
    with pytest.raises(FormatError):
        points_from_arrays({**arrays, name: arrays[name][:-1]})
    with pytest.raises(FormatError):
        points_from_arrays({key: array for key, array in arrays.items() if key != name})


def test_points_are_exported_in_the_frame_of_the_mover(busy: RunFolder, tmp_path: Path) -> None:
    line = export_run(busy, tmp_path / "out", movers=True)
    assert "7_mug.ply" in line
    rows = read_ply(tmp_path / "out" / "7_mug.ply").elements["vertex"]
    np.testing.assert_allclose(rows["y"], np.arange(1, 30, 3) / 100, rtol=1e-6)
    assert (rows["red"] == 128).all()
    assert MoversRecord.read(tmp_path / "out").movers[0].id == 7


def test_a_run_without_movers_is_refused(room_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=str(room_run.path)):
        export_run(room_run, tmp_path / "out", movers=True)
    done = ggslam("export", str(room_run.path), "--movers", "--out", str(tmp_path / "out"))
    assert done.returncode == 2 and "nothing was found to move" in done.stderr.replace("\n", " ")
    assert not (tmp_path / "out").exists()


def test_what_says_something_of_the_map_is_refused_beside_movers(busy: RunFolder, tmp_path: Path) -> None:
    for more in ({"voxel": 0.01}, {"objects": "all"}, {"format": "ply"}):
        with pytest.raises(ConfigError, match="`movers`"):
            export_run(busy, tmp_path / "out", movers=True, **more)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="folder"):
        export_run(busy, tmp_path / "out.ply", movers=True)


def test_missing_points_are_told(busy: RunFolder, tmp_path: Path) -> None:
    (busy.path / POINTS_FILE).write_bytes(b"PK nothing")
    with pytest.raises(RunFolderError, match=POINTS_FILE):
        export_run(busy, tmp_path / "out", movers=True)


def test_box_and_way_are_drawn_where_they_are_seen() -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    movers, black = MoversRecord.of(values()).movers, np.zeros((48, 64, 3), np.uint8)
    drawn = draw_movers(black, camera, np.eye(4), movers, 2)
    rows, columns = np.nonzero(drawn[24:].any(2))
    assert 28 < columns.min() < 36 and 40 < columns.max() < 48 and rows.max() < 8
    assert not draw_movers(black, camera, np.eye(4), movers, 9).any()
