# SPDX-License-Identifier: Apache-2.0
"""Finished maps are trained further: a run's as a whole, a store's cell by cell, whoever does it in whatever order."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import ggslam, refuse, succeed
from small_runs import store_of

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.refine import refine_store as refine_store_module
from ggslam.jobs.refine.cell_mapper import CellBox
from ggslam.jobs.refine.cell_training import CellTask, TrainedCell, train_cell
from ggslam.jobs.refine.finished_cells import CellsDone
from ggslam.jobs.refine.refine_run import refine_run
from ggslam.jobs.refine.refine_store import refine_store
from ggslam.jobs.refine.settings import RefineSettings
from ggslam.jobs.refine.training_inputs import StoreCells
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, cell_arrays, gaussians_of_cell
from ggslam.jobs.tasks.engines import Engine
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.submaps.cell_keys import Grid
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store

FEW = RefineSettings(steps=12)


@pytest.fixture(scope="module")
def store(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store_of(room_run, tmp_path_factory)


@pytest.fixture(scope="module")
def refined(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same refined by this process alone."""
    out = tmp_path_factory.mktemp("refined") / "room.grid"
    refine_store(store, out, settings=FEW, engine=Engine(workers=1))
    return out


@pytest.fixture
def copy(store: Path, tmp_path: Path) -> Path:
    copy_store(store, tmp_path / "copy.grid")
    return tmp_path / "copy.grid"


def files_of(store: Path) -> dict[str, bytes]:
    return {str(p.relative_to(store)): p.read_bytes() for p in sorted((store / "cells").rglob("*")) if p.is_file()}


def whole_map(store: Path) -> GaussianMap:
    with GridStore.open(store) as opened:
        keys = [key for key in opened.cells() if GAUSSIANS in opened.cell(key).parts]
        parts = [gaussians_of_cell(opened, key) for key in keys]
    out = GaussianMap(parts[0].sh_degree, parts[0].feature_channels, with_moments=False)
    for part in parts:
        out.append(part.take(torch.arange(len(part))))
    return out


def psnr(gaussians: GaussianMap, run: RunFolder) -> float:
    """Of all keyframes."""
    sequence, rasterizer, errors = open_recording_of(run), CpuRasterizer(), []
    for keyframe in run.keyframes().keyframes:
        frame = sequence.frame(keyframe.frame)
        view = rasterizer.forward(gaussians, frame.camera, inverse(keyframe.T_world_camera), features=False)
        seen = view.image.numpy().transpose(1, 2, 0).clip(0, 1)
        errors.append(float(((seen - frame.color / 255.0) ** 2).mean()))
    return float(np.mean(-10 * np.log10(errors)))


# --- stores ----------------------------------------------------------------------------------------------------------


def test_the_whole_map_gets_better(store: Path, refined: Path, room_run: RunFolder) -> None:
    before, after = whole_map(store), whole_map(refined)
    assert len(before) == len(after) and torch.equal(before.object_id, after.object_id)
    assert psnr(after, room_run) > psnr(before, room_run) + 0.1


def test_gaussians_stay_in_their_cells(refined: Path) -> None:
    with GridStore.open(refined) as opened:
        for key in opened.cells():
            if GAUSSIANS in opened.cell(key).parts:
                means = cell_arrays(opened, key)[0]["means"]
                assert (opened.grid.keys_of(means) == np.array(key)).all()


@pytest.mark.long("two workers that are begun")
def test_two_workers_make_the_same_in_place(copy: Path, refined: Path) -> None:
    outcome = refine_store(copy, settings=FEW, engine=Engine(workers=2))
    assert outcome.trained + outcome.unseen == outcome.cells > 4 and not outcome.failures
    assert files_of(copy) == files_of(refined) and not (copy / "refining").exists()
    assert outcome.after > outcome.before


def backwards(work: Callable, tasks: object, take: Callable) -> None:
    for task in reversed(list(tasks)):  # type: ignore[call-overload]
        take(task, work(task))


class Backwards(Engine):
    """Does the last cell first."""

    def do(self, work: Callable, tasks: object, take: Callable) -> None:  # type: ignore[override]
        backwards(work, tasks, take)


def test_the_order_of_cells_does_not_matter(copy: Path, refined: Path) -> None:
    refine_store(copy, settings=FEW, engine=Backwards())
    with GridStore.open(copy) as a, GridStore.open(refined) as b:
        assert [a.get(key, GAUSSIANS) for key in a.cells() if GAUSSIANS in a.cell(key).parts] == [
            b.get(key, GAUSSIANS) for key in b.cells() if GAUSSIANS in b.cell(key).parts
        ]


class Interrupt(Engine):
    """Is stopped after some cells."""

    def do(self, work: Callable, tasks: object, take: Callable) -> None:  # type: ignore[override]
        for number, task in enumerate(tasks):  # type: ignore[arg-type]
            if number == 3:
                raise KeyboardInterrupt
            take(task, work(task))


def test_a_refinement_that_was_cut_off_goes_on(
    copy: Path, refined: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = files_of(copy)
    with pytest.raises(KeyboardInterrupt):
        refine_store(copy, settings=FEW, engine=Interrupt())
    assert files_of(copy) == before  # as it was until all cells are done
    done = list[TrainedCell]()
    monkeypatch.setattr(refine_store_module, "train_cell", lambda task: done.append(train_cell(task)) or done[-1])
    outcome = refine_store(copy, settings=FEW, engine=Engine(workers=1))
    assert outcome.resumed == 3 and len(done) == outcome.cells - 3
    assert files_of(copy) == files_of(refined)


def test_putting_cells_into_the_store_goes_on(
    copy: Path, refined: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full when all cells are done."""
    put_cells = GridStore.put_cells

    def full(self: GridStore, writes: list) -> None:
        if self.path == copy:
            raise RunFolderError(f"cannot write {copy}: no space left on device")
        put_cells(self, writes)

    with monkeypatch.context() as patch:
        patch.setattr(GridStore, "put_cells", full)
        with pytest.raises(RunFolderError, match="no space left"):
            refine_store(copy, settings=FEW, engine=Engine(workers=1))
    monkeypatch.setattr(refine_store_module, "train_cell", None)  # nothing is trained again
    assert "put into the store" in refine_store(copy, settings=FEW).notes[0]
    assert files_of(copy) == files_of(refined) and not (copy / "refining").exists()


class Killed(BaseException):
    """Stands for a kill that lets nothing be tidied up."""


def test_killed_after_its_last_cell_it_does_not_train_again(
    copy: Path, refined: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(self: CellsDone) -> int:
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(CellsDone, "finish", kill)
        refine_store(copy, settings=FEW, engine=Engine(workers=1))
    monkeypatch.setattr(refine_store_module, "train_cell", None)
    outcome = refine_store(copy, settings=FEW, engine=Engine(workers=1))
    assert outcome.resumed == outcome.cells > 3 and outcome.trained == 0
    assert files_of(copy) == files_of(refined) and not list(copy.glob("*refining*"))


@pytest.mark.parametrize("gone", ["index.sqlite", "cells"])
def test_killed_while_it_tidies_up_it_has_nothing_left_to_do(
    copy: Path, refined: Path, monkeypatch: pytest.MonkeyPatch, gone: str
) -> None:
    """A part of what waited is deleted: nobody takes the rest for work to go on with."""

    def half(path: Path, **named: Any) -> None:
        if "refining" not in path.name:
            return rmtree(path, **named)
        if (path / gone).is_dir():
            rmtree(path / gone)
        else:
            (path / gone).unlink()
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        rmtree = shutil.rmtree
        patch.setattr(shutil, "rmtree", half)
        refine_store(copy, settings=FEW, engine=Engine(workers=1))
    assert files_of(copy) == files_of(refined)
    with monkeypatch.context() as patch:
        patch.setattr(refine_store_module, "train_cell", None)
        assert "put into the store" in refine_store(copy, settings=FEW, engine=Engine(workers=1)).notes[0]
    assert not list(copy.glob("*refining*")) and not list(copy.glob(".refining*"))
    assert files_of(copy) == files_of(refined)
    assert refine_store(copy, settings=FEW, engine=Engine(workers=1)).trained > 3  # whoever asks anew gets more


def test_other_work_is_not_gone_on_with(copy: Path, refined: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        refine_store(copy, settings=replace(FEW, steps=4), engine=Interrupt())
    outcome = refine_store(copy, settings=FEW, engine=Engine(workers=1))
    assert "thrown away" in outcome.notes[0] and not outcome.resumed and files_of(copy) == files_of(refined)


@pytest.mark.parametrize("fault", ["torn", "holes", "cell", "version"])
def test_a_damaged_cell_stays_as_it_is(copy: Path, fault: str) -> None:
    with GridStore.open(copy) as opened:
        keys = [key for key in opened.cells() if GAUSSIANS in opened.cell(key).parts]
        file = copy / "cells" / "_".join(map(str, keys[4])) / str(opened.cell(keys[4]).parts[GAUSSIANS].version)
    if fault == "torn":
        (file / GAUSSIANS).write_bytes(b"torn")
    elif fault == "holes":
        os.truncate(file / GAUSSIANS, 50 << 30)
    else:
        linked = file if fault == "version" else file.parent
        linked.rename(copy.parent / "elsewhere")
        linked.symlink_to(copy.parent / "elsewhere")
    held = (file / GAUSSIANS).stat()
    done = ggslam("refine", copy, "--steps", 2)
    said = "damaged: " if fault in ("torn", "holes") else "is a link"
    assert done.returncode == 2 and said in done.stdout and "as it was" in done.stdout
    with GridStore.open(copy) as opened:
        assert opened.cell(keys[3]).parts[GAUSSIANS].version != opened.cell(keys[4]).parts[GAUSSIANS].version
    now = (file / GAUSSIANS).stat()
    assert (now.st_ino, now.st_size, now.st_mtime_ns) == (held.st_ino, held.st_size, held.st_mtime_ns)


def test_without_its_recording_a_store_is_refused(copy: Path, tmp_path: Path) -> None:
    file = next((copy / "visits").iterdir())
    values = json.loads(file.read_text())
    values["sequence"]["open"]["path"] = str(tmp_path / "gone")
    file.write_text(json.dumps(values))
    refuse(ggslam("refine", copy), "recording of visit", "gone")
    file.write_text("{}")
    refuse(ggslam("refine", copy), str(file), "run is missing")
    file.unlink()
    refuse(ggslam("refine", copy, "--out", tmp_path / "new.grid"), "nothing is known of the recordings")
    assert not (tmp_path / "new.grid").exists()


def test_what_cannot_be_refined_is_refused(copy: Path, room_run: RunFolder, tmp_path: Path) -> None:
    with GridStore.create(tmp_path / "empty.grid"):
        pass
    refuse(ggslam("refine", tmp_path / "empty.grid"), "has no Gaussians")
    copy_store(copy, tmp_path / "there.grid")
    refuse(ggslam("refine", copy, "--out", tmp_path / "there.grid"), "is a store already", "--out")
    refuse(ggslam("refine", copy, "--workers", 0), "--workers")
    refuse(ggslam("refine", copy, "--address", "auto"), "--engine ray")
    refuse(ggslam("refine", copy, "--overwrite"), "are for runs")
    refuse(ggslam("refine", room_run.path, "--workers", 2), "are for grid stores")
    refuse(ggslam("refine", tmp_path), "not a run")


def test_cells_that_nobody_sees_stay(copy: Path) -> None:
    nothing = refine_store(copy, settings=replace(FEW, share=1.0), engine=Engine(workers=1))
    assert nothing.trained == 0 and nothing.unseen == nothing.cells


def test_the_gaussians_around_a_cell_stand_still(store: Path) -> None:
    """The cell's part comes back alone; with a neighbour that differs it is trained to something else."""
    with GridStore.open(store) as opened:
        cells = StoreCells(opened, FEW)
        tasks = [cells.task(key) for key in sorted(cells.versions)]
    task: CellTask = max(tasks, key=lambda t: len(t.halo) * bool(t.views))
    assert task.halo
    alone, beside = train_cell(replace(task, halo=b"")), train_cell(task)
    assert alone.count == beside.count and alone.data != beside.data


def test_a_box_holds_what_its_cell_does() -> None:
    grid, random = Grid(0.3, "xyz"), np.random.default_rng(0)
    points = random.normal(scale=0.4, size=(2000, 3)).astype(np.float32)
    keys = grid.keys_of(points)
    for key in ((0, 0, 0), (-1, 1, 0)):
        box = CellBox.of(grid, key)
        assert (box.holds(points.astype(float)) == (keys == np.array(key)).all(1)).all()
        moved = torch.from_numpy(points.copy())
        box.clamp(moved)
        assert (grid.keys_of(moved.numpy()) == np.array(key)).all()
    flat = CellBox.of(Grid(1.0, "xz"), (2, 0, -1))
    assert flat.holds(np.array([[2.2, 1e5, -0.6]])).all() and not flat.holds(np.array([[2.6, 0, -1.0]])).any()


# --- runs ------------------------------------------------------------------------------------------------------------


def test_a_refined_run_is_a_run(room_run: RunFolder, tmp_path: Path) -> None:
    said = succeed("refine", room_run.path, "--steps", 30, "--out", tmp_path / "better")
    assert "30 steps" in said
    better = RunFolder.open(tmp_path / "better")
    assert psnr(better.gaussians(), room_run) > psnr(room_run.gaussians(), room_run) + 0.3
    assert better.has_objects() and better.object_table().ids() == room_run.object_table().ids()
    assert better.timing().refine_iterations == room_run.timing().refine_iterations + 30
    names = {path.name for path in room_run.path.iterdir() if path.suffix not in (".html", ".lock")}
    assert names - {path.name for path in better.path.iterdir()} <= {"cells", "volumes", "verdict.json", ".lock"}
    assert better.verdict() is None  # the one of another map would be stale
    succeed("verify", tmp_path / "better")


def test_a_run_is_refined_in_place(room_run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(room_run.path, tmp_path / "run")
    refine_run(tmp_path / "run", settings=RefineSettings(steps=2))
    assert RunFolder.open(tmp_path / "run").mark().complete
    assert (tmp_path / "run" / "map.ply").read_bytes() != (room_run.path / "map.ply").read_bytes()


def test_runs_that_cannot_be_refined(room_run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(room_run.path, tmp_path / "run")
    with pytest.raises(ConfigError, match="`out`.*better"):
        refine_run(tmp_path / "run", tmp_path / "run" / "better")
    sequence = RunFolder.open(tmp_path / "run").sequence()
    moved = sequence.open.model_copy(update={"path": str(tmp_path / "gone")})
    sequence.model_copy(update={"open": moved}).write(tmp_path / "run")
    with pytest.raises(GgslamError, match="gone"):
        refine_run(tmp_path / "run", tmp_path / "out")
    assert not (tmp_path / "out").exists()
