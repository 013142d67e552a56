# SPDX-License-Identifier: Apache-2.0
"""A format of somebody else: one writer (and reader) in the table, and every command knows it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.formats import table
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.splat_formats import read_splats
from ggslam.formats.splat_reader import read_whole
from ggslam.formats.splat_repair import columns_of
from ggslam.formats.table import Format, writers
from ggslam.formats.writer import PosedViews, Splats, SurfaceMesh, Takes, Writer
from ggslam.runs.folder import RunFolder

DOCS = Path(__file__).parents[2] / "docs"


def write_toy(path: Path, splats: Splats) -> str:
    """Rows of mean, logarithms of the standard deviations, quaternion, opacity's logit and colour."""
    rows = [np.column_stack([p.means, p.log_scales, p.quaternions, p.opacity_logits, p.sh[:, 0]])
            for p in splats.parts()]  # fmt: skip
    np.save(path.open("wb"), np.concatenate(rows))
    return splats.text(path)


def read_toy(path: Path) -> SplatColumns:
    rows = np.load(path)
    return columns_of(rows[:, :3], rows[:, 3:6], rows[:, 6:10], rows[:, 10], rows[:, 11:, None].transpose(0, 2, 1))


def write_corners(path: Path, mesh: SurfaceMesh) -> str:
    np.save(path.open("wb"), mesh.vertices[mesh.triangles])
    return mesh.text(path)


def write_list(folder: Path, views: PosedViews) -> str:
    folder.mkdir()
    names = [view.name for view in views.save(folder / "pictures", None)]
    (folder / "list.txt").write_text("\n".join(names))
    return f"wrote {folder}: {len(names)} pictures"


@pytest.fixture(autouse=True)
def toys(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    toy = Format(
        Writer("toy", (".toy",), Takes.GAUSSIANS, "rows of numbers for tests", write_toy),
        read_whole("toy", lambda path, head: path.suffix == ".toy", read_toy),
    )
    corners = Format(Writer("corners", (".corners",), Takes.MESH, "corners of triangles", write_corners))
    pictures = Format(Writer("pictures", (), Takes.VIEWS, "a list of pictures", write_list))
    monkeypatch.setattr(table, "FORMATS", (*table.FORMATS, toy, corners, pictures))
    yield


def test_gaussians_go_out_and_come_in(room_run: RunFolder, tmp_path: Path) -> None:
    out, gaussians = tmp_path / "made" / "map.toy", room_run.gaussians()
    said = succeed("export", room_run.path, "--out", out)
    assert f"{len(gaussians)} Gaussians" in " ".join(said.split())
    there = read_splats(out)
    np.testing.assert_array_equal(there.means, gaussians.means)
    np.testing.assert_allclose(there.opacity_logits, gaussians.opacity_logits, atol=1e-5)
    np.testing.assert_array_equal(there.sh[:, 0], gaussians.sh[:, 0])
    succeed("export", out, "--out", tmp_path / "back.splat")
    assert (tmp_path / "back.splat").stat().st_size == 32 * len(gaussians)
    succeed("edit", out, "--move", "all", "1 0 0", "--out", tmp_path / "moved.toy")
    np.testing.assert_allclose(read_splats(tmp_path / "moved.toy").means[:, 0], gaussians.means[:, 0] + 1, atol=1e-5)


def test_meshes_and_views_go_out(room_run: RunFolder, tmp_path: Path) -> None:
    succeed("export", room_run.path, "--out", tmp_path / "a.corners", "--voxel", 0.1)
    succeed("export", room_run.path, "--out", tmp_path / "a.ply", "--format", "mesh", "--voxel", 0.1)
    corners = np.load(tmp_path / "a.corners")
    assert corners.shape[1:] == (3, 3) and len(corners) > 100
    assert f"element face {len(corners)}".encode() in (tmp_path / "a.ply").read_bytes()[:2000]
    succeed("export", room_run.path, "--format", "pictures", "--out", tmp_path / "all", "--keyframes")
    names = (tmp_path / "all" / "list.txt").read_text().split()
    assert {p.name for p in (tmp_path / "all" / "pictures").iterdir()} == set(names) and names


def test_help_and_errors_name_it(room_run: RunFolder, tmp_path: Path) -> None:
    shown = " ".join(ggslam("export", "--help").stdout.replace("│", " ").split())
    assert "toy: rows of numbers for tests" in shown and ".toy" in shown and "corners" in shown
    out = ["--out", tmp_path / "map.toy"]
    refuse(ggslam("export", room_run.path, "--format", "dwg", "--out", tmp_path / "x"), "corners, pictures, found")
    refuse(ggslam("export", room_run.path, "--out", tmp_path / "x.dwg"), ".toy")
    refuse(ggslam("export", room_run.path, "--format", "toy", "--out", tmp_path / "x.dwg"), "toy")
    refuse(ggslam("export", room_run.path, *out, "--format", "corners"), "says toy")
    refuse(ggslam("export", room_run.path, *out, "--keyframes"), "colmap, nerfstudio, pictures, not toy")
    refuse(ggslam("export", room_run.path, *out, "--objects", "all"), "not toy")
    assert not list(tmp_path.iterdir())


def test_content_that_does_not_suit_is_refused(room_run: RunFolder, tmp_path: Path) -> None:
    succeed("export", room_run.path, "--out", tmp_path / "map.toy")
    refuse(ggslam("export", tmp_path / "map.toy", "--out", tmp_path / "a.corners"), "format corners needs")
    refuse(ggslam("export", tmp_path / "map.toy", "--format", "pictures", "--out", tmp_path / "a"), "pictures needs")
    succeed("submaps", room_run.path, "--out", tmp_path / "room.grid", "--spacing", 1)
    refuse(ggslam("export", tmp_path / "room.grid", "--out", tmp_path / "b.toy"), "can be written, not toy")
    assert not {p.name for p in tmp_path.iterdir()} & {"a.corners", "a", "b.toy"}


def test_the_page_on_exports_has_every_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # the toys have no page
    rows = [line for line in (DOCS / "export.md").read_text().splitlines() if line.startswith("| `")]
    first_cells = " ".join(row.split("|")[1] for row in rows)
    assert [known.name for known in writers() if f"`{known.name}`" not in first_cells] == []
