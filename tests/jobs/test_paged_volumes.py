# SPDX-License-Identifier: Apache-2.0
"""`ggslam volumes` with a memory limit writes what it writes without one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.formats.triangle_mesh import read_mesh

NEAR = ("--set", "volumes.tsdf.max_depth=1.8", "--set", "volumes.esdf.max_distance=0.3")
WORDS = ("--voxel", 0.03, "--esdf", "--no-objects", "--set", "volumes.esdf_every=6", *NEAR)
ROBOTS = ("--robot", "low:0.3,0.12", "--robot", "tall:1.2,0.2", "--inflation", "0.6,5")


@pytest.fixture(scope="module")
def whole(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    succeed("volumes", room, "--out", out, *WORDS, *ROBOTS)
    return out


@pytest.fixture(scope="module")
def paged(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("paged") / "out"
    said = succeed("volumes", room, "--out", out, *WORDS, *ROBOTS, "--set", "volumes.budget_mb=1")
    assert "went to disk" in said and " 0 went to disk" not in said
    return out


def triangles(path: Path) -> list[bytes]:
    mesh = read_mesh(path)
    assert mesh is not None
    return sorted(row.tobytes() for row in mesh.vertices[mesh.triangles])


def test_files_are_those_of_everything_in_memory(whole: Path, paged: Path) -> None:
    for name in ("tsdf.npz", "map.pgm", "map.yaml", "floor.yaml"):
        assert (paged / name).read_bytes() == (whole / name).read_bytes(), name
    assert triangles(paged / "mesh.ply") == triangles(whole / "mesh.ply")
    assert not [path for path in paged.iterdir() if path.name.startswith(".")]  # no cells are left


def test_bands_of_robots_are_those_of_everything_in_memory(whole: Path, paged: Path) -> None:
    """Maps and costmaps of two robots, of a volume whose cells went to disk and came back."""
    costs = {}
    for name in ("low", "tall"):
        costs[name] = cv2.imread(str(paged / f"costmap_{name}.png"), cv2.IMREAD_UNCHANGED)
        assert len(np.unique(costs[name])) > 20, "a costmap with all its levels"
        for file in (f"map_{name}.pgm", f"map_{name}.yaml", f"costmap_{name}.png", f"costmap_{name}.yaml"):
            assert (paged / file).read_bytes() == (whole / file).read_bytes(), file
    assert (costs["low"] != costs["tall"]).any()


def test_files_are_made_of_what_is_on_disk(room: Path, tmp_path: Path) -> None:
    """Without a distance field nothing comes back to be written."""
    plain = ("--voxel", 0.02, "--no-objects", *NEAR)
    succeed("volumes", room, "--out", tmp_path / "whole", *plain)
    said = succeed("volumes", room, "--out", tmp_path / "out", *plain, "--set", "volumes.budget_mb=1")
    assert "went to disk" in said and " 0 went to disk" not in said
    assert (tmp_path / "out" / "tsdf.npz").read_bytes() == (tmp_path / "whole" / "tsdf.npz").read_bytes()
    assert triangles(tmp_path / "out" / "mesh.ply") == triangles(tmp_path / "whole" / "mesh.ply")


def test_a_limit_that_nothing_fits_into_is_refused(room: Path, tmp_path: Path) -> None:
    words = ("--set", "memory_limit_mb=20")
    refuse(ggslam("volumes", room, "--out", tmp_path / "a", *words), "memory_limit_mb=20", "expected at least")
    base = tmp_path / "tsdf.npz"
    succeed("volumes", room, "--out", tmp_path / "b", "--voxel", 0.1, "--stop", 2)
    (tmp_path / "b" / "tsdf.npz").rename(base)
    done = ggslam("volumes", room, "--out", tmp_path / "c", "--onto", base, "--set", "volumes.budget_mb=12")
    refuse(done, "budget_mb", "onto")


def test_a_run_that_is_going_on_shares_the_limit(room: Path, tmp_path: Path) -> None:
    few = ("--set", "mapping.iterations_per_frame=1", "--set", "refine_iterations=0", "--set", "identity.enabled=false")
    limit = ("--set", "memory_limit_mb=2000", "--set", "masks.source=none")
    said = succeed("volumes", room, "--live", "--out", tmp_path / "run", "--voxel", 0.06, "--stop", 6, *few, *limit)
    assert "went to disk" in said
    assert np.isfinite(read_mesh(tmp_path / "run" / "volumes" / "mesh.ply").vertices).all()  # type: ignore[union-attr]
